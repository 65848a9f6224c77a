"""Tests of nodes that call or serve: a graph in memory or on real ROS, faults, time, recordings.

pytest loads the fixtures ``ros_graph``, ``virtual_clock`` and ``ros_domain`` by itself. With
another test runner, use `Graph` and `VirtualClock`.
"""

from __future__ import annotations

from rosasync.testing.clock import VirtualClock
from rosasync.testing.recording import RecordedCall, Recording
from rosasync.testing.ros_graph import Graph
from rosasync.testing.stub import StubCall, StubServer
from rosasync.testing.stub_action import StubActionServer, StubGoal

__all__ = [
    "Graph",
    "RecordedCall",
    "Recording",
    "StubActionServer",
    "StubCall",
    "StubGoal",
    "StubServer",
    "VirtualClock",
]

pytest_plugins = ["rosasync.testing.plugin"]
