"""Measures ROS 2 service calls from Python, with rosasync and with its alternatives.

``python -m benchmarks --help`` lists what can be measured. Each contestant is one file in
``benchmarks/contestants``.
"""
