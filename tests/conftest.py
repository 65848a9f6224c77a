"""What all tests share: a ROS domain for this run alone, stock servers, both bridges."""

from __future__ import annotations

import asyncio
import gc
import importlib
import logging
import os
import signal
import threading
import warnings
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Literal

import pytest
import uvloop
from hypothesis import HealthCheck, settings

from rosasync import Limits, Session
from rosasync._client import response_times
from rosasync._ros.domain import isolate
from rosasync._ros.shared_memory import unfinished_ports
from tests.faults.table import pytest_terminal_summary
from tests.support.action_servers import ActionServerProcess
from tests.support.child import Unanswered
from tests.support.clients import ClientProcess
from tests.support.fake_graph import FakeGraph
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT

__all__ = ["pytest_terminal_summary"]

isolate()

# The same examples in every run, however slow the machine. `--hypothesis-profile=default` draws
# others each time.
settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    print_blob=True,
)
settings.load_profile("repeatable")

# A shell that starts this in the background ignores SIGINT, and child processes inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

with warnings.catch_warnings():
    # lark, one of rclpy's dependencies, still imports sre_parse, which is deprecated.
    warnings.simplefilter("ignore", DeprecationWarning)
    importlib.import_module("rosidl_generator_py")

Bridge = Literal["direct", "executor"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--soak-minutes",
        type=float,
        default=1.0,
        help="minutes for which the soak of tests/faults runs on each bridge",
    )


def pytest_asyncio_loop_factories(
    item: pytest.Item,
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Run on asyncio's own loop, and on uvloop too if the mark ``asyncio`` names it."""
    marker = item.get_closest_marker("asyncio")
    if marker is not None and "loop_factories" in marker.kwargs:
        return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
    return {"asyncio": asyncio.new_event_loop}


@pytest.fixture(autouse=True)
def nothing_left_behind(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Fail a test that leaves a thread behind, or an exception that asyncio only logged."""
    # A process that an earlier test killed may have left one, and the next would wait for it.
    for port in unfinished_ports(int(os.environ["ROS_DOMAIN_ID"])):
        port.unlink(missing_ok=True)
    before = set(threading.enumerate())
    yield
    left = set(threading.enumerate()) - before
    if left:
        # rclpy's MultiThreadedExecutor ends its threads when it is collected.
        gc.collect()
    # The threads in which asyncio waits for a child process end a moment after the process.
    for thread in left:
        thread.join(LIMIT)
    assert set(threading.enumerate()) <= before
    records = [*caplog.get_records("setup"), *caplog.get_records("call")]
    errors = [r for r in records if r.name == "asyncio" and r.levelno >= logging.ERROR]
    assert not errors, "\n".join(r.getMessage() for r in errors[:3])


@pytest.fixture
def fake_graph() -> FakeGraph:
    """An empty graph in memory, with faults of all servers at once."""
    return FakeGraph()


@pytest.fixture
async def sessions(fake_graph: FakeGraph) -> AsyncIterator[tuple[Session, Session]]:
    """The sessions of a client and of a server, in one graph in memory."""
    async with fake_graph.session(timeout=LIMIT) as client, fake_graph.session() as server:
        yield client, server


@pytest.fixture(params=["direct", "executor"])
def bridge(request: pytest.FixtureRequest) -> Bridge:
    """Each of the two bridges."""
    kind: Bridge = request.param
    return kind


@pytest.fixture
async def session(bridge: Bridge) -> AsyncIterator[Session]:
    """An open session, on each bridge."""
    async with Session("test_client", bridge=bridge, timeout=2 * LIMIT) as session:
        yield session
    assert session.closed


@pytest.fixture
async def patient_session(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[Session]:
    """A session in which abandoned requests keep their places, however slow the machine is."""
    monkeypatch.setattr(response_times, "PATIENCE_INITIAL", LIMIT)
    limits = Limits(grace=4 * LIMIT)
    async with Session("patient", bridge=bridge, limits=limits, timeout=2 * LIMIT) as session:
        yield session


class _Processes:
    """The processes that are kept for the whole run: starting one takes longer than most tests."""

    def __init__(self) -> None:
        self._server: ServerProcess | None = None
        self._client: ClientProcess | None = None
        self._actions: ActionServerProcess | None = None
        self._lamp: ServerProcess | None = None

    def server(self) -> ServerProcess:
        if self._server is None or not self._server.alive:
            self._server = ServerProcess()
        return self._server

    def client(self) -> ClientProcess:
        if self._client is None or not self._client.alive:
            self._client = ClientProcess()
        return self._client

    def actions(self) -> ActionServerProcess:
        if self._actions is None or not self._actions.alive:
            self._actions = ActionServerProcess()
        return self._actions

    def lamp(self) -> ServerProcess:
        if self._lamp is None or not self._lamp.works():
            self._lamp = ServerProcess("lamp_server")
            self._lamp.serve_now("/lamp/switch", "std_srvs/srv/SetBool")
            self._lamp.serve_now("/lamp/silent", "std_srvs/srv/SetBool", delay="never")
            self._lamp.serve_now("/lamp/text")
            self._lamp.serve_now("/lamp/twice", "std_srvs/srv/SetBool", copies=2)
        return self._lamp

    def close(self) -> None:
        for child in (self._server, self._client, self._actions, self._lamp):
            if child is not None and child.alive:
                child.close()


@pytest.fixture(scope="session")
def processes() -> Iterator[_Processes]:
    """The processes of the run."""
    processes = _Processes()
    yield processes
    processes.close()


@pytest.fixture
def server(processes: _Processes) -> Iterator[ServerProcess]:
    """A process of stock servers, without any service yet."""
    server = processes.server()
    yield server
    if server.alive:
        # If it hangs in the middleware, it has been ended, and the next test gets another.
        with suppress(Unanswered):
            server.clear_now()


@pytest.fixture
def action_server(processes: _Processes) -> Iterator[ActionServerProcess]:
    """A process of stock action servers, without any server yet."""
    server = processes.actions()
    yield server
    if server.alive:
        with suppress(Unanswered):
            server.clear_now()


@pytest.fixture
def lamp(processes: _Processes) -> ServerProcess:
    """A process of stock servers for the command line: the tutorial's lamp, and others.

    ``/lamp/silent`` never answers, ``/lamp/text`` echoes, ``/lamp/twice`` has two servers.
    """
    return processes.lamp()


@contextmanager
def _another_domain() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
            patch.setenv(name, os.environ[name])
        isolate()
        yield


@pytest.fixture(scope="module")
def own_domain() -> Iterator[None]:
    """A ROS domain for one module: its child processes see no node of another test."""
    with _another_domain():
        yield


@pytest.fixture
def lonely_echo() -> Iterator[str]:
    """The name of a stock service that echoes, in a ROS domain for one test."""
    with _another_domain(), ServerProcess() as server:
        server.serve_now("/echo")
        yield "/echo"


@pytest.fixture
def client_process(processes: _Processes) -> ClientProcess:
    """A process of stock clients."""
    return processes.client()


@pytest.fixture
async def echo(server: ServerProcess) -> str:
    """The name of a stock service of default QoS that echoes."""
    await server.serve("/echo")
    return "/echo"
