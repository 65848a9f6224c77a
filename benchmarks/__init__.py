"""How fast are ROS 2 service calls from Python, this library's and everybody else's?

``python -m benchmarks --help`` says what can be measured; each contestant is one file in
``benchmarks/contestants``.
"""
