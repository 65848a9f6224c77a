"""The pytest plugin of rosasync: fixtures for a graph in memory or on real ROS.

pytest imports it at every start, also in projects that do not use it. So it imports rclpy only in
the fixtures.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from rosasync.testing import Graph, VirtualClock

__all__ = ["ros_domain", "ros_graph", "virtual_clock"]

REAL_SETTLE = 0.1
"""Seconds for which a virtual clock waits for responses on real ROS, before each step."""


LOOP_SCOPES = ("function", "class", "module", "package", "session")
"""How long a loop of pytest-asyncio may live."""

INSTALLED = Path(__file__).parents[2].name in ("site-packages", "dist-packages")
"""Whether rosasync is installed. In a clone of it, the tests are about its own frames."""

KIND = pytest.StashKey[Any]()
"""Where the parameter of ``ros_graph`` is kept for the fixture that opens the graph."""

ENDED_EARLY = pytest.StashKey[bool]()
"""Where it is kept that the body of a test has raised."""


def _async_fixture(loop_scope: str) -> Callable[[Any], Any]:
    """Return the decorator of an async fixture, for pytest-asyncio in its strict mode too."""
    name = _in_loop(loop_scope)
    if importlib.util.find_spec("pytest_asyncio") is None:
        return pytest.fixture(name=name)
    import pytest_asyncio

    make: Any = pytest_asyncio.fixture
    if "loop_scope" in inspect.signature(make).parameters:
        make = partial(make, loop_scope=loop_scope)
    # Older ones, before 0.24, have one loop for each test.
    return make(name=name)  # type: ignore[no-any-return]


def _in_loop(loop_scope: str) -> str:
    """Return the name of the fixture that opens the graph in a loop of this scope."""
    return f"_ros_graph_in_{loop_scope}_loop"


def _loop_scope(request: pytest.FixtureRequest) -> str:
    """Return how long the loop of a test lives, as its mark or the configuration says."""
    marker = request.node.get_closest_marker("asyncio")
    if marker is not None and (scope := marker.kwargs.get("loop_scope")):
        return str(scope)
    try:
        return str(request.config.getini("asyncio_default_test_loop_scope"))
    except ValueError:
        return "function"


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


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> None:
    """Keep whether a test has failed, for the end of its graph, and shorten its traceback."""
    if call.excinfo is None:
        return
    if call.when == "call":
        item.stash[ENDED_EARLY] = True
    if INSTALLED:
        _hide_library()


def _hide_library() -> None:
    """Let pytest leave the frames of rosasync out of its tracebacks, unless with --full-trace."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == "rosasync":
            vars(module)["__tracebackhide__"] = True


@pytest.fixture(scope="session")
def ros_domain() -> int:
    """A ROS domain that only this test run uses; see `rosasync._ros.domain.isolate`."""
    from rosasync._ros.domain import isolate_once

    return isolate_once()


@pytest.fixture
def ros_graph(request: pytest.FixtureRequest) -> Graph:
    """An open, strict graph: in memory, or on real ROS as its parameter or the option says.

    It is open in the loop of the test, whatever ``loop_scope`` that has.
    """
    request.node.stash[KIND] = getattr(request, "param", None)
    graph: Graph = request.getfixturevalue(_in_loop(_loop_scope(request)))
    return graph


def _graph_fixture(loop_scope: str) -> Any:
    @_async_fixture(loop_scope)
    async def graph(request: pytest.FixtureRequest) -> AsyncIterator[Graph]:
        from rosasync.testing import Graph

        marker = request.node.get_closest_marker("rosasync")
        strict = True if marker is None else marker.kwargs.get("strict", True)
        kind = request.node.stash[KIND] or request.config.getoption("--rosasync-graph")
        async with Graph(kind, strict=strict) as graph:
            yield graph
            if request.node.stash.get(ENDED_EARLY, False):
                # What the rest of the test would have called is not what is wrong.
                graph.strict = False

    return graph


# One for each scope, because pytest-asyncio binds a fixture to a scope when it is declared.
for _scope in LOOP_SCOPES:
    globals()[_in_loop(_scope)] = _graph_fixture(_scope)


@pytest.fixture
def virtual_clock(request: pytest.FixtureRequest) -> VirtualClock:
    """A clock that moves the time of the test's loop forward."""
    from rosasync.testing import VirtualClock

    real = (
        "ros_graph" in request.fixturenames and request.getfixturevalue("ros_graph").kind == "real"
    )
    return VirtualClock(settle=REAL_SETTLE if real else 0.0)
