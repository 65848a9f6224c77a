"""One service in the pool, on fake ports: no caller affects another."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rosasync import (
    ContextShutdown,
    Limits,
    QueueTimeout,
    ResponseTimeout,
    Retry,
    RosasyncError,
    ServerGone,
    Session,
    SessionClosed,
)
from rosasync._client.graph_watch import POLL_MAX
from rosasync._core.ports import PortDestroyed
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph
from tests.support.plain import Echo, echo
from tests.support.times import LIMIT, TICK, until


async def ask(session: Session, value: object, **options: Any) -> object:
    response = await session.call(Echo, "/echo", Echo.Request(value), **options)
    return response.value


def the_client(graph: FakeGraph) -> MemoryClient:
    ((client,),) = ([*node.clients] for node in graph.nodes)
    return client


@contextlib.contextmanager
def sends(graph: FakeGraph, send: Callable[[Any], int]) -> Iterator[None]:
    """Send with this function instead, in this block."""
    port: Any = the_client(graph)
    port.send = send
    try:
        yield
    finally:
        del port.send


async def test_a_send_that_fails_gives_its_place_back(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1)) as session:
        assert await ask(session, 0) == 0

        def refuse(request: object) -> int:
            raise OverflowError("does not fit")

        with sends(fake_graph, refuse):
            for retry in (None, Retry()):
                with pytest.raises(OverflowError, match="does not fit"):
                    await ask(session, 1, retry=retry)
        assert await ask(session, 2) == 2
        total = session.pool.statistics()
        assert (total.in_flight, total.abandoned, total.failed) == (0, 0, 2)


async def test_a_queued_send_that_fails_does_not_end_those_behind_it(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1)) as session:
        assert await ask(session, 0) == 0
        send = the_client(fake_graph).send

        def refuse_odd(request: Any) -> int:
            if request.value % 2:
                raise OverflowError("odd")
            return send(request)

        with sends(fake_graph, refuse_odd):
            calls = [ask(session, n) for n in range(10)]
            ended = await asyncio.gather(*calls, return_exceptions=True)
        assert [type(e) if isinstance(e, Exception) else e for e in ended] == [
            n if n % 2 == 0 else OverflowError for n in range(10)
        ]


async def test_a_lease_taken_in_the_turn_of_an_error_is_not_lost(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1)) as session:
        with fake_graph.hold_requests():
            first = session.start(Echo, "/echo", Echo.Request(0))
            tasks = [asyncio.create_task(ask(session, n)) for n in (1, 2)]
            await until(lambda: session.pool.statistics().waiting == 2)
            tasks[0].cancel()
        await first
        assert await tasks[1] == 2
        assert await ask(session, 3) == 3


@pytest.mark.parametrize("turns", range(3))
async def test_a_call_that_was_cancelled_is_not_sent_when_its_server_comes(
    fake_graph: FakeGraph, turns: int
) -> None:
    async with fake_graph.session() as session:
        task = session.start(Echo, "/echo", Echo.Request(1))
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        server = fake_graph.serve(Echo, "/echo", echo)
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await ask(session, 2) == 2
    assert [request.value for request in server.received] == [2]


async def test_a_call_that_was_cancelled_in_the_turn_of_a_free_place_is_not_sent(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1)) as session:
        await ask(session, 0)
        with fake_graph.drop_requests():
            out = session.start(Echo, "/echo", Echo.Request(1))
        first = session.start(Echo, "/echo", Echo.Request(2))
        port = the_client(fake_graph)
        port.deliver(port.sent[-1], Echo.Response(1))
        # The assignment is already scheduled, ahead of the first step of this task.
        second = session.start(Echo, "/echo", Echo.Request(3))
        first.cancel()
        third = session.start(Echo, "/echo", Echo.Request(4))
        third.cancel()
        assert [task.value for task in await asyncio.gather(out, second)] == [1, 3]
        await asyncio.wait([first, third])
        assert first.cancelled()
        assert third.cancelled()
    assert [request.value for request in server.received] == [0, 3]


async def test_a_message_changed_after_start_was_sent_as_it_was(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=2)) as session:
        await session.wait_for_service(Echo, "/echo")
        request = Echo.Request()
        tasks = []
        for number in range(4):  # Two are sent, two have to wait.
            request.value = [number]
            tasks.append(session.start(Echo, "/echo", request))
            request.value.clear()
            request.value = None
        answers = [(await task).value for task in tasks]
    # Those that are sent at once are converted by rclpy; the fake port keeps the message itself.
    assert answers[2:] == [[2], [3]]
    assert len(server.received) == 4


async def test_a_retried_message_is_copied(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        await session.wait_for_service(Echo, "/echo")
        request = Echo.Request("first")
        with fake_graph.drop_responses():
            task = session.start(Echo, "/echo", request, retry=Retry(10, TICK, 1.0))
            request.value = "changed"
            await until(lambda: server.received)
        assert (await task).value == "first"


async def test_callers_share_what_clients_there_are_if_no_more_can_be_created(
    fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(clients=4, in_flight=1)) as session:
        assert await ask(session, 0) == 0
        node: Any = session.node

        def refuse(*_: object) -> None:
            raise OSError(24, "Too many open files")

        node.open_client, open_client = refuse, node.open_client
        with caplog.at_level(logging.WARNING, logger="rosasync"):
            assert await asyncio.gather(*(ask(session, n) for n in range(9))) == list(range(9))
        assert [r.getMessage().partition(":")[0] for r in caplog.records] == ["/echo"]
        assert "no further client" in caplog.text
        node.open_client = open_client
        await asyncio.gather(*(ask(session, n) for n in range(9)))
        assert session.pool.statistics().clients == 4


async def test_without_any_client_the_error_is_the_callers(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        node: Any = session.node

        def refuse(*_: object) -> None:
            raise OSError(24, "Too many open files")

        node.open_client, open_client = refuse, node.open_client
        with pytest.raises(OSError, match="Too many"):
            await ask(session, 1)
        node.open_client = open_client
        assert await ask(session, 1) == 1


def raise_destroyed(*_: object) -> Any:
    raise PortDestroyed("destroyed")


async def test_a_client_destroyed_by_other_means_is_replaced(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        assert await ask(session, 0) == 0
        with (
            sends(fake_graph, raise_destroyed),
            pytest.raises(ContextShutdown, match="/echo: the client was destroyed"),
        ):
            await ask(session, 1)
        assert await ask(session, 2) == 2
        total = session.pool.statistics()
        assert (total.clients, total.created, total.in_flight) == (1, 2, 0)


async def test_calls_of_a_client_destroyed_by_other_means_end(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1)) as session:
        assert await ask(session, 0) == 0
        with fake_graph.hold_requests():
            out = session.start(Echo, "/echo", Echo.Request(1))
            waiting = session.start(Echo, "/echo", Echo.Request(2))
            monkeypatch.setattr(the_client(fake_graph), "ready", raise_destroyed)
            fake_graph.changed()
            with pytest.raises(ContextShutdown):
                await out
        assert (await waiting).value == 2


@pytest.mark.parametrize("limits", [Limits(idle=0.0), Limits(idle=TICK, clients=3, in_flight=1)])
async def test_idle_clients_are_evicted_and_come_back(
    fake_graph: FakeGraph, limits: Limits
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=limits) as session:
        for _ in range(2):
            await asyncio.gather(*(ask(session, n) for n in range(5)))
            await until(lambda: session.pool.statistics().clients == 0)


async def test_a_client_that_waits_for_a_server_is_not_evicted(fake_graph: FakeGraph) -> None:
    async with fake_graph.session(limits=Limits(idle=TICK / 10)) as session:
        task = session.start(Echo, "/echo", Echo.Request(1), timeout=LIMIT)
        await asyncio.sleep(2 * TICK)
        assert session.pool.statistics().created == 1
        fake_graph.serve(Echo, "/echo", echo)
        assert (await task).value == 1


async def test_a_server_of_another_type_does_not_hide_that_the_last_has_gone(
    fake_graph: FakeGraph,
) -> None:
    class Other:
        class Request: ...

        class Response: ...

    server = fake_graph.serve(Echo, "/echo", echo)
    fake_graph.serve(Other, "/echo", lambda request: Other.Response())
    async with fake_graph.session() as session:
        with fake_graph.drop_responses():
            task = session.start(Echo, "/echo", Echo.Request(1), timeout=None)
            await until(lambda: server.received)
            server.close()
            with pytest.raises(ServerGone):
                await asyncio.wait_for(task, LIMIT)


async def test_a_server_of_another_type_is_not_warned_of(
    fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    class Other:
        class Request: ...

        class Response: ...

    fake_graph.serve(Echo, "/echo", echo)
    fake_graph.serve(Other, "/echo", lambda request: Other.Response())
    async with fake_graph.session() as session:
        with caplog.at_level(logging.WARNING, logger="rosasync"):
            assert await ask(session, 1) == 1
    assert not caplog.records


@pytest.fixture
async def polls(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The delays of all polls for a match, from now on."""
    loop = asyncio.get_running_loop()
    call_later = loop.call_later
    delays: list[float] = []

    def spy(delay: float, callback: Any, *args: Any) -> Any:
        if callback.__name__ == "_poll":
            delays.append(delay)
        return call_later(delay, callback, *args)

    monkeypatch.setattr(loop, "call_later", spy)
    return delays


@pytest.mark.parametrize("graph_events", [True, False])
async def test_a_match_without_an_event_is_polled_for_at_short_intervals(
    graph_events: bool, polls: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = FakeGraph(graph_events=graph_events)
    graph.serve(Echo, "/echo", echo)
    async with graph.session() as session:
        monkeypatch.setattr(MemoryClient, "ready", lambda client: len(polls) > 8)
        assert await ask(session, 1) == 1
    # The first starts with the call, and the creation of the client replaces it at once.
    waits = polls[1:9]
    assert max(waits) <= POLL_MAX
    # A match that takes long is noticed after a fraction of that time.
    assert waits[-1] < sum(waits) / 4


async def test_a_poll_that_fails_is_not_the_last(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    failures: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda _, context: failures.append(context))
    fake_graph.serve(Echo, "/echo", echo)

    def ready(client: MemoryClient) -> bool:
        if len(failures) < 3:
            raise RosasyncError("rclpy failed")
        return True

    async with fake_graph.session() as session:
        monkeypatch.setattr(MemoryClient, "ready", ready)
        assert await ask(session, 1, timeout=LIMIT) == 1
    assert len(failures) == 3


async def test_a_call_that_outlives_its_lease_keeps_its_place(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1, idle=TICK / 10)) as session:
        with fake_graph.hold_requests():
            async with session.pool.lease(Echo, "/echo") as leased:
                call = asyncio.create_task(leased.call(Echo.Request(1), timeout=LIMIT))
                await until(lambda: session.pool.statistics().in_flight)
            with pytest.raises(QueueTimeout):
                await ask(session, 2, timeout=2 * TICK)
            assert the_client(fake_graph).most == 1
        assert (await call).value == 1
        assert await ask(session, 3) == 3


async def test_a_leased_call_whose_place_comes_in_the_turn_of_the_end_is_not_sent(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with (
        fake_graph.session(limits=Limits(in_flight=1)) as session,
        session.pool.lease(Echo, "/echo") as leased,
    ):
        client = the_client(fake_graph)
        with fake_graph.drop_responses(), pytest.raises(ResponseTimeout):
            await leased.call(Echo.Request(1), timeout=TICK / 10)
        waiting = asyncio.create_task(leased.call(Echo.Request(2), timeout=None))
        await asyncio.sleep(0)
        # The late response gives the place back, and the next turn would send the second request.
        client.deliver(1, Echo.Response())
        session.pool.end(lambda: SessionClosed("the session is closed"))
        with pytest.raises(SessionClosed):
            await asyncio.wait_for(waiting, LIMIT)
        assert client.sent == [1]


async def test_a_lease_granted_in_the_turn_of_the_end_is_none(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        service = session.pool.service(Echo, "/echo", None)
        waiting = asyncio.create_task(service.lease(None))
        await until(lambda: session.pool.statistics().waiting)
        fake_graph.serve(Echo, "/echo", echo)
        session.pool.end(lambda: SessionClosed("the session is closed"))
        with pytest.raises(SessionClosed):
            await waiting


async def test_warming_ends_if_clients_are_evicted_at_once(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(clients=3, idle=0.0)) as session:
        await asyncio.wait_for(session.pool.warm(Echo, "/echo", 3), LIMIT)
        assert session.pool.statistics().created <= 3


async def test_no_timer_of_a_superseded_attempt_outlives_its_client(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    timers: list[asyncio.TimerHandle] = []
    call_at = loop.call_at

    def spy(when: float, callback: Any, *args: Any, **options: Any) -> asyncio.TimerHandle:
        timers.append(call_at(when, callback, *args, **options))
        return timers[-1]

    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(grace=LIMIT)) as session:
        await session.wait_for_service(Echo, "/echo")
        monkeypatch.setattr(loop, "call_at", spy)
        with fake_graph.drop_responses():
            task = session.start(Echo, "/echo", Echo.Request(1), retry=Retry(2, TICK))
            await until(lambda: the_client(fake_graph).sent)
        assert (await task).value == 1
        assert session.pool.statistics().retried == 1
    assert not [t for t in timers if t.when() > loop.time() and not t.cancelled()]


def test_servers_of_the_fake_graph_are_told_apart() -> None:
    graph = FakeGraph()
    first, second = (graph.serve(Echo, "/echo", echo) for _ in range(2))
    second.close()
    assert len(graph.servers) == 1
    assert graph.servers[0] is first


async def test_a_call_whose_error_cannot_be_explained_is_counted(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        node: Any = session.node

        def explain_missing(_: object) -> str:
            raise ContextShutdown

        node.queries.explain_missing = explain_missing
        with pytest.raises(ContextShutdown):
            await ask(session, 1, timeout=TICK / 10)
        assert session.pool.statistics().failed == 1


async def test_who_asks_whether_a_server_is_there_uses_the_client(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        assert not session.service_is_ready(Echo, "/echo")
        (client,) = session.pool.service(Echo, "/echo", None).clients
        created = client.idle_since
        await asyncio.sleep(TICK / 10)
        assert not session.service_is_ready(Echo, "/echo")
        assert client.idle_since > created


def test_calls_that_are_collected_with_a_closed_loop_are_silent(fake_graph: FakeGraph) -> None:
    async def leave() -> Session:
        session = fake_graph.session(limits=Limits(in_flight=1))
        await session.__aenter__()
        await session.wait_for_service(Echo, "/echo")
        with fake_graph.drop_requests():
            calls.extend(session.start(Echo, "/echo", timeout=None) for _ in range(3))
            await asyncio.sleep(0)
        return session

    calls: list[asyncio.Task[Any]] = []
    fake_graph.serve(Echo, "/echo", echo)
    loop = asyncio.new_event_loop()
    # asyncio itself reports pending tasks that are destroyed.
    loop.set_exception_handler(lambda _, context: None)
    session = loop.run_until_complete(leave())
    for call in calls:
        call.cancel()
    del call
    loop.close()
    calls.clear()
    # An error in a coroutine that is collected would fail this test.
    gc.collect()
    assert session.pool.statistics().in_flight == 0
    with pytest.warns(ResourceWarning, match="unclosed"):
        session.core.abandon(session)
