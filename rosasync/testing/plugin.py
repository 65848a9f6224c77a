"""The pytest plugin of rosasync: fixtures for a graph in memory or on real ROS.

pytest imports it at every start, also in projects that do not use it. So it imports rclpy only in
the fixtures.
"""

from __future__ import annotations

import importlib.util
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from rosasync.testing import FakeGraph, Graph, VirtualClock

__all__ = ["fake_graph", "ros_domain", "ros_graph", "virtual_clock"]

REAL_SETTLE = 0.1
"""Seconds for which a virtual clock waits for responses on real ROS, before each step."""


def _async_fixture(function: Any) -> Any:
    """Make an async fixture, for pytest-asyncio in its strict mode too."""
    if importlib.util.find_spec("pytest_asyncio") is None:
        return pytest.fixture(function)
    import pytest_asyncio

    return pytest_asyncio.fixture(function)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--rosasync-graph``."""
    parser.getgroup("rosasync").addoption(
        "--rosasync-graph",
        choices=("memory", "real"),
        default="memory",
        help="what the fixture ros_graph is, unless a test is parametrised: a graph in memory, or "
        "real ROS in a domain of its own",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker."""
    config.addinivalue_line(
        "markers",
        "rosasync(strict=True): whether ros_graph fails a test that calls a service without a "
        "server, or never calls a server",
    )


@pytest.fixture
def fake_graph() -> FakeGraph:
    """An empty graph in memory, for tests of rosasync itself."""
    from rosasync.testing.graph import FakeGraph

    return FakeGraph()


@pytest.fixture(scope="session")
def ros_domain() -> int:
    """A ROS domain that only this test run uses; see `rosasync._ros.domain.isolate`."""
    from rosasync._ros.domain import isolate_once

    return isolate_once()


@_async_fixture
async def ros_graph(request: pytest.FixtureRequest) -> AsyncIterator[Graph]:
    """An open, strict graph: in memory, or on real ROS as its parameter or the option says."""
    from rosasync.testing import Graph

    marker = request.node.get_closest_marker("rosasync")
    strict = True if marker is None else marker.kwargs.get("strict", True)
    kind = getattr(request, "param", None) or request.config.getoption("--rosasync-graph")
    async with Graph(kind, strict=strict) as graph:
        yield graph


@pytest.fixture
def virtual_clock(request: pytest.FixtureRequest) -> VirtualClock:
    """A clock that moves the time of the test's loop forward."""
    from rosasync.testing import VirtualClock

    real = (
        "ros_graph" in request.fixturenames and request.getfixturevalue("ros_graph").kind == "real"
    )
    return VirtualClock(settle=REAL_SETTLE if real else 0.0)
