"""Tests without a middleware: a ROS graph in memory, and a pytest plugin with fixtures for it.

``pytest_plugins = ["rosasync.testing"]`` in a ``conftest.py`` loads the fixtures ``fake_graph`` and
``ros_domain``.
"""

from __future__ import annotations

from rosasync.testing.graph import FakeClient, FakeGraph, FakeNode, FakeServer, FakeService

__all__ = ["FakeClient", "FakeGraph", "FakeNode", "FakeServer", "FakeService"]

pytest_plugins = ["rosasync.testing.plugin"]
