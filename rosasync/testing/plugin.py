"""The pytest plugin: fixtures for a graph in memory and for an unused ROS domain."""

from __future__ import annotations

import pytest

from rosasync.ros.domain import isolate
from rosasync.testing.graph import FakeGraph

__all__ = ["fake_graph", "ros_domain"]


@pytest.fixture
def fake_graph() -> FakeGraph:
    """An empty graph in memory."""
    return FakeGraph()


@pytest.fixture(scope="session")
def ros_domain() -> int:
    """A ROS domain that only this test run uses; see `rosasync.ros.domain.isolate`."""
    return isolate()
