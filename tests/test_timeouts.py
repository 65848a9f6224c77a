"""Timeouts: None is no deadline, left out is the session's, for a wait no deadline; everywhere."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from typing import Any

import py_trees
import pytest
from py_trees.behaviour import Behaviour
from py_trees.common import Status

from rosasync import (
    AsyncServiceProxy,
    CallError,
    Limits,
    ProxyState,
    QueueTimeout,
    ServiceUnavailable,
    Session,
)
from rosasync.behaviours import CallService, WaitForService
from rosasync.lifecycle import LifecycleClient, TransitionTimeout
from rosasync.parameters import ParameterClient
from tests.support.echo import ECHO, service_class
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.times import LIMIT, TICK, until

ABSENT, SILENT = "/absent", "/silent"
Way = Callable[..., Coroutine[Any, Any, None]]


async def session_call(session: Session, **options: Any) -> None:
    await session.call(ECHO, ABSENT, **options)


async def session_call_sent(session: Session, **options: Any) -> None:
    await session.call(ECHO, SILENT, **options)


async def session_call_without_waiting(session: Session, **options: Any) -> None:
    await session.call(ECHO, SILENT, wait=False, **options)


async def session_start(session: Session, **options: Any) -> None:
    await session.start(ECHO, ABSENT, **options)


async def client_call(session: Session, **options: Any) -> None:
    await session.client(ECHO, ABSENT).call(**options)


async def client_start(session: Session, **options: Any) -> None:
    await session.client(ECHO, ABSENT).start(**options)


async def client_of_its_own_timeout(session: Session, **options: Any) -> None:
    await session.client(ECHO, ABSENT, **options).call()


async def lease(session: Session, **options: Any) -> None:
    async with session.pool.lease(ECHO, ABSENT, **options):
        pytest.fail("there is no server")


async def leased_call(session: Session, **options: Any) -> None:
    async with session.pool.lease(ECHO, SILENT, timeout=None) as client:
        await client.call(**options)


async def portal_call(session: Session, **options: Any) -> None:
    await asyncio.to_thread(lambda: session.from_thread.call(ECHO, ABSENT, **options))


async def portal_submit(session: Session, **options: Any) -> None:
    await asyncio.wrap_future(
        await asyncio.to_thread(lambda: session.from_thread.submit(ECHO, ABSENT, **options))
    )


async def proxy_call(session: Session, **options: Any) -> None:
    proxy = AsyncServiceProxy(session, ECHO, ABSENT)
    proxy.call_service(**options)
    await ended(proxy)


async def proxy_call_by_position(session: Session, **options: Any) -> None:
    proxy = AsyncServiceProxy(session, ECHO, SILENT)
    proxy.call_service(None, *options.values())
    await ended(proxy)


async def behaviour_call(session: Session, **options: Any) -> None:
    await ticked(CallService("call", ECHO, ABSENT, **options), session)


async def parameters(session: Session, **options: Any) -> None:
    await ParameterClient(session, ABSENT).get("name", **options)


async def parameters_of_their_own_timeout(session: Session, **options: Any) -> None:
    await ParameterClient(session, ABSENT, **options).get("name")


async def lifecycle(session: Session, **options: Any) -> None:
    await LifecycleClient(session, ABSENT).state(**options)


async def lifecycle_change(session: Session, **options: Any) -> None:
    await LifecycleClient(session, ABSENT).configure(**options)


async def session_wait(session: Session, **options: Any) -> None:
    await session.wait_for_service(ECHO, ABSENT, **options)


async def client_wait(session: Session, **options: Any) -> None:
    await session.client(ECHO, ABSENT).wait(**options)


async def proxy_wait(session: Session, **options: Any) -> None:
    proxy = AsyncServiceProxy(session, ECHO, ABSENT)
    proxy.wait_for_service(**options)
    await ended(proxy)


async def behaviour_wait(session: Session, **options: Any) -> None:
    await ticked(WaitForService("wait", ECHO, ABSENT, **options), session)


CALLS: list[Way] = [
    session_call,
    session_call_sent,
    session_call_without_waiting,
    session_start,
    client_call,
    client_start,
    client_of_its_own_timeout,
    lease,
    leased_call,
    portal_call,
    portal_submit,
    proxy_call,
    proxy_call_by_position,
    behaviour_call,
    parameters,
    parameters_of_their_own_timeout,
    lifecycle,
    lifecycle_change,
]
WAITS: list[Way] = [session_wait, client_wait, proxy_wait, behaviour_wait]


async def ended(proxy: AsyncServiceProxy[Any, Any]) -> None:
    """Wait until the operation of a proxy has ended, and raise its error."""
    pending = (ProxyState.RUNNING, ProxyState.WAITING)
    await until(lambda: proxy.get_state() not in pending)
    for error in proxy.get_errors():
        raise error


async def ticked(behaviour: Behaviour, session: Session) -> None:
    """Tick until the run of a behaviour has ended, and raise the error of its proxy."""
    py_trees.trees.setup(behaviour, session=session)
    behaviour.tick_once()
    while behaviour.status is Status.RUNNING:
        await asyncio.sleep(TICK / 10)
        behaviour.tick_once()
    await ended(behaviour.proxy)


@pytest.fixture
def graph(fake_graph: FakeGraph) -> FakeGraph:
    """A graph with a server that never answers."""
    fake_graph.serve(ECHO, SILENT, lambda request: service_class(ECHO).Response())
    fake_graph.dropping_responses = True
    return fake_graph


@pytest.mark.parametrize(
    ("way", "options"),
    [
        *((way, {}) for way in CALLS),
        *((way, {"timeout": ...}) for way in (*CALLS, *WAITS)),
    ],
)
async def test_the_sessions_timeout_holds(
    graph: FakeGraph, way: Way, options: dict[str, Any]
) -> None:
    async with graph.session(timeout=TICK) as session, asyncio.timeout(LIMIT):
        with pytest.raises(TimeoutError, match="/absent|/silent"):
            await way(session, **options)


@pytest.mark.parametrize(
    ("way", "options"),
    [
        *((way, {"timeout": None}) for way in (*CALLS, *WAITS)),
        *((way, {}) for way in WAITS),
    ],
)
async def test_there_is_no_deadline(graph: FakeGraph, way: Way, options: dict[str, Any]) -> None:
    async with graph.session(timeout=TICK) as session:
        task = asyncio.create_task(way(session, **options))
        reference = session.start(ECHO, ABSENT)
        await until(reference.done)
        await asyncio.sleep(2 * TICK)
        assert isinstance(reference.exception(), TimeoutError)
        assert not task.done()
        task.cancel()
    await asyncio.wait([task])


@pytest.mark.parametrize("way", CALLS)
async def test_a_session_without_a_timeout_has_none(graph: FakeGraph, way: Way) -> None:
    async with graph.session(timeout=None) as session:
        task = asyncio.create_task(way(session))
        await asyncio.sleep(2 * TICK)
        assert not task.done()
        task.cancel()
    await asyncio.wait([task])


@pytest.mark.parametrize("timeout", [0, -0.001, -math.inf])
@pytest.mark.parametrize(
    ("way", "error"),
    [*((way, QueueTimeout) for way in CALLS), *((way, ServiceUnavailable) for way in WAITS)],
)
async def test_without_any_time_left_nothing_is_sent(
    graph: FakeGraph, way: Way, error: type[CallError], timeout: float
) -> None:
    (server,) = graph.servers
    assert isinstance(server, FakeServer)
    async with graph.session() as session, asyncio.timeout(LIMIT):
        with pytest.raises((error, TransitionTimeout)):
            await way(session, timeout=timeout)
        assert server.received == []
        assert [port.sent for node in graph.nodes for port in node.clients if port.sent] == []


@pytest.mark.parametrize("timeout", [0, -1.0])
async def test_a_wait_without_any_time_left_for_a_server_that_is_there(
    graph: FakeGraph, timeout: float
) -> None:
    async with graph.session() as session:
        await session.wait_for_service(ECHO, SILENT)
        assert await session.wait_for_service(ECHO, SILENT, timeout=timeout)
        await session.client(ECHO, SILENT).wait(timeout)


@pytest.mark.parametrize(
    "way", [session_call, session_start, client_call, client_start, portal_call]
)
async def test_a_wait_for_a_server_of_some_seconds(graph: FakeGraph, way: Way) -> None:
    async with graph.session(timeout=None) as session, asyncio.timeout(LIMIT):
        with pytest.raises(ServiceUnavailable):
            await way(session, wait=TICK)


async def test_a_server_that_comes_within_the_wait_gets_the_call(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        first = session.start(ECHO, "/echo", wait=LIMIT)
        second = session.start(ECHO, "/echo")
        await asyncio.sleep(TICK)
        server = fake_graph.serve(ECHO, "/echo", lambda request: service_class(ECHO).Response())
        await asyncio.gather(first, second)
        assert len(server.received) == 2


async def test_the_wait_for_a_server_does_not_bound_the_wait_for_a_place(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(ECHO, "/echo", lambda request: service_class(ECHO).Response())
    async with fake_graph.session(limits=Limits(in_flight=1), timeout=LIMIT) as session:
        with fake_graph.hold_requests():
            calls = [session.start(ECHO, "/echo", wait=TICK) for _ in range(3)]
            await asyncio.sleep(3 * TICK)
            assert not any(call.done() for call in calls)
        await asyncio.gather(*calls)
    assert len(server.received) == 3


@pytest.mark.parametrize("wait", [0, 0.0, -1.0, False])
async def test_no_wait_for_a_server_at_all(fake_graph: FakeGraph, wait: float) -> None:
    async with fake_graph.session(timeout=None) as session, asyncio.timeout(LIMIT):
        with pytest.raises(ServiceUnavailable):
            await session.call(ECHO, "/echo", wait=wait)


@pytest.mark.parametrize(("wait", "error"), [(math.nan, ValueError), ("1", TypeError)])
async def test_a_wait_that_is_not_a_number(
    fake_graph: FakeGraph, wait: Any, error: type[Exception]
) -> None:
    async with fake_graph.session() as session:
        with pytest.raises(error, match="wait"):
            await session.call(ECHO, "/echo", wait=wait)
