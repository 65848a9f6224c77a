"""Cancellation and endings: each row of the contract, at each await of a call."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Coroutine
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
import rclpy
from diagnostic_msgs.srv import AddDiagnostics
from rclpy.signals import SignalHandlerOptions

from rosasync import (
    ContextShutdown,
    Limits,
    QueueTimeout,
    ResponseTimeout,
    Retry,
    RosasyncError,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
)
from rosasync._client import response_times
from rosasync._client.graph_watch import POLL_CONTEXT
from tests.support.checks import assert_clean, check_call, pending_in_rclpy
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.servers import ServerProcess
from tests.support.steps import every_victim
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge


@pytest.fixture
async def narrow(bridge: Bridge, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Session]:
    """A session with one place for each service, which no request gives back by being slow."""
    monkeypatch.setattr(response_times, "PATIENCE_INITIAL", LIMIT)
    limits = Limits(clients=1, in_flight=1, grace=LIMIT)
    async with Session("narrow", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        yield session


def call(session: Session, name: str, text: str, **options: Any) -> asyncio.Task[Any]:
    """Start a call of the echoing type."""
    return session.start(ECHO, name, request_of(text), **options)


async def waiting(session: Session, callers: int) -> None:
    """Wait until this number of callers is queued."""
    await until(lambda: session.pool.statistics().waiting == callers)


class TestWhileWaitingForAClient:
    """Nothing was sent; a client granted in the same turn goes to the next caller."""

    async def test_cancelled(self, narrow: Session, server: ServerProcess) -> None:
        await server.serve("/echo", delay="hold")
        first = call(narrow, "/echo", "first")
        await server.received("/echo", 1)
        victim = call(narrow, "/echo", "victim")
        last = call(narrow, "/echo", "last")
        await waiting(narrow, 2)
        victim.cancel()
        with pytest.raises(asyncio.CancelledError):
            await victim
        await waiting(narrow, 1)
        await server.release("/echo")
        assert answer_to(await first) == "first"
        assert await server.received("/echo", 2) == ["first", "last"]
        await server.release("/echo")
        assert answer_to(await last) == "last"
        statistics = narrow.pool.statistics()
        assert (statistics.completed, statistics.cancelled) == (2, 1)
        await assert_clean(narrow)

    async def test_timed_out(self, narrow: Session, server: ServerProcess) -> None:
        await server.serve("/echo", delay="hold")
        first = call(narrow, "/echo", "first")
        await server.received("/echo", 1)
        with pytest.raises(QueueTimeout) as caught:
            await call(narrow, "/echo", "late", timeout=2 * TICK)
        assert caught.value.srv_name == "/echo"
        assert caught.value.srv_type == ECHO
        assert caught.value.elapsed > 0
        assert isinstance(caught.value, TimeoutError)
        await server.release("/echo")
        await first
        await check_call_held(narrow, server, "next")
        assert await server.received("/echo") == ["first", "next"]
        await assert_clean(narrow)

    async def test_at_each_await_the_next_in_line_gets_it(
        self, narrow: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        sent = ["first"]
        first = call(narrow, "/echo", "first")
        await server.received("/echo", 1)

        def make() -> Coroutine[Any, Any, Any]:
            return narrow.call(ECHO, "/echo", request_of("victim"))

        async for victim in every_victim(make):
            await asyncio.sleep(0)
            last = call(narrow, "/echo", repr(victim))
            await until(
                lambda v=victim: narrow.pool.statistics().waiting == 2 - v.task.done()  # type: ignore[misc]
            )
            await server.release("/echo")
            await first
            await asyncio.sleep(0)
            if victim.suspensions > 1 or not victim.cancelled:
                sent.append("victim")
                await server.received("/echo", len(sent))
                await server.release("/echo")
            await asyncio.wait([victim.task])
            assert victim.task.cancelled() == victim.cancelled, victim
            sent.append(repr(victim))
            assert await server.received("/echo", len(sent)) == sent, victim
            first = last
        await server.release("/echo")
        await first
        await assert_clean(narrow)


async def check_call_held(session: Session, server: ServerProcess, text: str) -> None:
    """Call a service that holds its responses, and release the response."""
    before = len(await server.received("/echo"))
    task = call(session, "/echo", text)
    await server.received("/echo", before + 1)
    await server.release("/echo")
    assert answer_to(await task) == text


class TestWhileWaitingForAServer:
    """Nothing was sent; other waiting callers are not affected."""

    async def test_cancelled(self, session: Session, server: ServerProcess) -> None:
        victim, other = call(session, "/echo", "victim"), call(session, "/echo", "other")
        watch = asyncio.create_task(session.wait_for_service(ECHO, "/echo"))
        doomed = asyncio.create_task(session.wait_for_service(ECHO, "/echo"))
        await asyncio.sleep(TICK)
        for task in (victim, doomed):
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        assert not other.done()
        assert not watch.done()
        await server.serve("/echo")
        await watch
        assert answer_to(await other) == "other"
        assert await server.received("/echo") == ["other"]
        await assert_clean(session)

    async def test_timed_out(self, session: Session, server: ServerProcess) -> None:
        other = call(session, "/echo", "other")
        with pytest.raises(ServiceUnavailable) as caught:
            await call(session, "/echo", "late", timeout=2 * TICK)
        assert isinstance(caught.value, TimeoutError)
        assert caught.value.elapsed > 0
        await server.serve("/echo")
        assert answer_to(await other) == "other"
        assert await server.received("/echo") == ["other"]

    async def test_at_each_await(self, session: Session, server: ServerProcess) -> None:
        names = [f"/echo_{number}" for number in range(100)]
        calls = 0

        def make() -> Coroutine[Any, Any, Any]:
            nonlocal calls
            calls += 1
            return session.call(ECHO, names[calls], request_of("victim"))

        async for victim in every_victim(make):
            name = names[calls]
            await asyncio.sleep(0)
            other = call(session, name, "other")
            await asyncio.sleep(0)
            await server.serve(name)
            await asyncio.wait([victim.task])
            assert victim.task.cancelled() == victim.cancelled, victim
            assert answer_to(await other) == "other"
            sent = ["other"]
            if victim.moment == "as it wakes" or not victim.cancelled:
                sent.insert(0, "victim")
            assert await server.received(name) == sent, victim
        await assert_clean(session)


class TestAfterSending:
    """The server may still run it; the place in the window comes back with the late response."""

    @pytest.mark.parametrize("way", ["cancelled", "timed out"])
    async def test_the_place_comes_back_with_the_late_response(
        self, narrow: Session, server: ServerProcess, way: str
    ) -> None:
        await server.serve("/echo", delay="hold")
        await narrow.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        await give_up(narrow, server, way)
        statistics = narrow.pool.statistics()
        assert (statistics.in_flight, statistics.abandoned, statistics.late) == (0, 1, 0)
        assert (statistics.cancelled, statistics.timed_out) == (
            (1, 0) if way == "cancelled" else (0, 1)
        )
        following = call(narrow, "/echo", "following")
        await waiting(narrow, 1)
        assert await server.received("/echo", 1) == ["given up"]
        await server.release("/echo")
        assert await server.received("/echo", 2) == ["given up", "following"]
        statistics = narrow.pool.statistics()
        assert (statistics.in_flight, statistics.abandoned, statistics.late) == (1, 0, 1)
        await server.release("/echo")
        assert answer_to(await following) == "following"
        await assert_clean(narrow)

    @pytest.mark.parametrize("way", ["cancelled", "timed out"])
    async def test_or_after_the_grace_period(
        self,
        bridge: Bridge,
        server: ServerProcess,
        way: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(response_times, "PATIENCE_INITIAL", LIMIT)
        await server.serve("/echo", delay="hold")
        limits = Limits(in_flight=1, grace=20 * TICK)
        async with Session("graceful", bridge=bridge, limits=limits, timeout=LIMIT) as session:
            await session.wait_for_service(ECHO, "/echo")
            await give_up(session, server, way)
            # In the turn in which the caller learns of its end: the grace period has just begun.
            following = call(session, "/echo", "following")
            statistics = session.pool.statistics()
            assert (statistics.abandoned, statistics.waiting) == (1, 1)
            await server.received("/echo", 2)
            assert session.pool.statistics().abandoned == 0
            await server.release("/echo", newest=True)
            assert answer_to(await following) == "following"
            await server.answered("/echo", 2)
            await assert_clean(session)
            await check_call_held(session, server, "after the late response")

    async def test_a_timeout_says_what_was_called(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="never")
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        with pytest.raises(ResponseTimeout, match="/echo") as caught:
            await session.call(ECHO, "/echo", timeout=10 * TICK)
        assert caught.value.srv_name == "/echo"
        assert caught.value.srv_type == ECHO
        assert caught.value.elapsed > 0
        assert isinstance(caught.value, TimeoutError)

    async def test_at_each_await_of_a_warm_call(self, session: Session, echo: str) -> None:
        await check_call(session, echo, "warm")
        cancelled = 0

        def make() -> Coroutine[Any, Any, Any]:
            return session.call(ECHO, echo, request_of("victim"))

        async for victim in every_victim(make):
            await asyncio.wait([victim.task])
            assert victim.task.cancelled() == victim.cancelled, victim
            cancelled += victim.cancelled
            await check_call(session, echo, repr(victim))
        await assert_clean(session)
        statistics = session.pool.statistics()
        assert statistics.cancelled == cancelled > 0
        assert statistics.created == 1

    async def test_at_each_await_of_a_lease(self, narrow: Session, echo: str) -> None:
        async def leased() -> None:
            async with narrow.pool.lease(ECHO, echo) as client:
                await client.call(request_of("one"))
                await client.call(request_of("two"))

        await leased()
        async for victim in every_victim(leased):
            await asyncio.wait([victim.task])
            assert victim.task.cancelled() == victim.cancelled, victim
            await check_call(narrow, echo, repr(victim))
        await assert_clean(narrow)

    async def test_a_response_between_the_cancel_and_the_wake_up(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        loop = asyncio.get_running_loop()
        for number in range(5):
            task = call(session, "/echo", "victim")
            await server.received("/echo", number + 1)
            # When the response arrives, the cancellation is already scheduled. So the task resumes
            # after both.
            loop.call_soon(task.cancel)
            server.ask_now("release", name="/echo", count=None, newest=False)
            time.sleep(TICK)  # noqa: ASYNC251
            with pytest.raises(asyncio.CancelledError):
                await task
        await assert_clean(session)
        await server.change("/echo", None)
        await check_call(session, "/echo", "afterwards")
        statistics = session.pool.statistics()
        assert (statistics.cancelled, statistics.late, statistics.completed) == (5, 5, 1)


async def give_up(session: Session, server: ServerProcess, way: str) -> None:
    """Make a call, and cancel it or let it time out after it was sent."""
    task = call(session, "/echo", "given up", timeout=LIMIT if way == "cancelled" else 6 * TICK)
    if way == "cancelled":
        await server.received("/echo", 1)
        task.cancel()
    with pytest.raises(asyncio.CancelledError if way == "cancelled" else ResponseTimeout):
        await task


Ways = dict[str, asyncio.Task[Any]]


async def wait_in_every_way(session: Session, server: ServerProcess) -> Ways:
    """Start a task for each way to wait, in a session with one place for each service."""
    await server.serve("/echo", delay="hold")
    ways: Ways = {"for a response": call(session, "/echo", "out", timeout=None)}
    await server.received("/echo", 1)

    async def lease() -> None:
        async with session.pool.lease(ECHO, "/echo", timeout=None):
            pytest.fail("there is no client to lease")

    absent = partial(session.call, ECHO, "/absent", timeout=None)
    ways |= {
        "for a client": call(session, "/echo", "waits", timeout=None),
        "for a lease": asyncio.create_task(lease()),
        "for a server": asyncio.create_task(absent()),
        "for a service": asyncio.create_task(session.wait_for_service(ECHO, "/absent")),
        "bound": asyncio.create_task(session.client(ECHO, "/absent").wait(None)),
    }
    await until(lambda: session.pool.statistics().waiting >= 2)
    await asyncio.sleep(TICK)
    assert not [name for name, task in ways.items() if task.done()]
    return ways


async def assert_all_raise(ways: Ways, error: type[RosasyncError]) -> None:
    """Assert that every task ends with this error, and none with a cancellation."""
    await asyncio.wait(ways.values(), timeout=LIMIT)
    endings = {
        name: "cancelled" if task.cancelled() else task.exception() if task.done() else "pending"
        for name, task in ways.items()
    }
    assert {name: type(ending) for name, ending in endings.items()} == dict.fromkeys(ways, error)


class TestSessionClosed:
    """Callers get SessionClosed, never CancelledError."""

    async def test_while_callers_wait_in_every_way(
        self, narrow: Session, server: ServerProcess
    ) -> None:
        ways = await wait_in_every_way(narrow, server)
        await narrow.aclose()
        await assert_all_raise(ways, SessionClosed)

    async def test_by_the_block_that_opened_it(self, bridge: Bridge, server: ServerProcess) -> None:
        await server.serve("/echo", delay="hold")
        async with Session("brief", bridge=bridge) as session:
            task = call(session, "/echo", "out")
            await server.received("/echo", 1)
        with pytest.raises(SessionClosed):
            await task

    async def test_from_one_of_its_own_callers(self, narrow: Session, echo: str) -> None:
        async def caller() -> None:
            await check_call(narrow, echo, "text")
            await narrow.aclose()

        await asyncio.create_task(caller())
        assert narrow.closed

    async def test_at_each_await_of_its_callers(self, bridge: Bridge, echo: str) -> None:
        for turns in range(8):
            session = Session("brief", bridge=bridge, timeout=2 * LIMIT)
            await session.__aenter__()
            warm = session.start(ECHO, echo, request_of("warm"))
            if turns % 2:
                await warm
            task = call(session, echo, "text")
            for _ in range(turns // 2):
                await asyncio.sleep(0)
            await session.aclose()
            for ending in await asyncio.gather(task, warm, return_exceptions=True):
                assert isinstance(ending, AddDiagnostics.Response | SessionClosed), turns


async def shut_down(context: Any) -> None:
    """Shut a context down as a signal handler or another library would: from another thread."""
    await asyncio.to_thread(context.shutdown)


class TestContextShutDown:
    """Callers get ContextShutdown within a second, if the machine is not busy."""

    def test_the_context_is_polled_often_enough(self) -> None:
        assert POLL_CONTEXT < 1.0

    async def test_while_callers_wait_in_every_way(
        self, narrow: Session, server: ServerProcess
    ) -> None:
        ways = await wait_in_every_way(narrow, server)
        await shut_down(narrow.node.context)
        await assert_all_raise(ways, ContextShutdown)
        with pytest.raises(ContextShutdown):
            await narrow.call(ECHO, "/echo")
        await narrow.aclose()
        with pytest.raises((SessionClosed, ContextShutdown)):
            await narrow.call(ECHO, "/echo")

    async def test_of_a_borrowed_node(self, bridge: Bridge, server: ServerProcess) -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("lender")
        try:
            async with Session(
                node, bridge=bridge, limits=Limits(in_flight=1), timeout=LIMIT
            ) as session:
                ways = await wait_in_every_way(session, server)
                await asyncio.to_thread(rclpy.shutdown)
                await assert_all_raise(ways, ContextShutdown)
        finally:
            rclpy.try_shutdown()
            node.destroy_node()

    async def test_while_nobody_calls(self, session: Session, echo: str) -> None:
        await check_call(session, echo, "text")
        await shut_down(session.node.context)
        with pytest.raises(ContextShutdown):
            await session.call(ECHO, echo)


class TestLastServerGone:
    """Callers get ServerGone as soon as the graph says so."""

    async def test_destroyed_with_calls_out_and_back_again(
        self, session: Session, server: ServerProcess
    ) -> None:
        for round_ in range(3):
            await server.serve("/echo", delay="hold")
            calls = [call(session, "/echo", str(n), timeout=None) for n in range(10)]
            await server.received("/echo", 10 * (round_ + 1))
            await server.stop("/echo")
            for task in calls:
                with pytest.raises(ServerGone, match="/echo") as caught:
                    await task
                assert isinstance(caught.value, ConnectionError)
                assert caught.value.srv_name == "/echo"
            await assert_clean(session)
        await server.serve("/echo")
        await check_call(session, "/echo", "back", timeout=LIMIT)
        statistics = session.pool.statistics()
        assert statistics.clients == statistics.created == 1
        await assert_clean(session)

    async def test_who_waits_in_line_goes_on_waiting(
        self, narrow: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        out = call(narrow, "/echo", "out")
        await server.received("/echo", 1)
        inline = call(narrow, "/echo", "in line")
        await waiting(narrow, 1)
        await server.stop("/echo")
        with pytest.raises(ServerGone):
            await out
        assert not inline.done()
        await server.serve("/echo")
        assert answer_to(await inline) == "in line"
        await assert_clean(narrow)

    async def test_not_while_another_server_is_there(
        self, session: Session, server: ServerProcess
    ) -> None:
        async with ServerProcess() as other:
            await server.serve("/echo", delay="hold")
            await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
            task = call(session, "/echo", "kept")
            await server.received("/echo", 1)
            await other.serve("/echo", delay="never")
            await until(lambda: session.node.count_services("/echo") == 2)
            await other.stop("/echo")
            await until(lambda: session.node.count_services("/echo") == 1)
            await server.release("/echo")
            assert answer_to(await task) == "kept"

    async def test_killed_with_calls_out_and_another_in_its_place(
        self, session: Session, server: ServerProcess
    ) -> None:
        # Longer than a busy machine may hold it up.
        async with ServerProcess(lease=4) as mortal:
            await mortal.serve("/echo", delay="hold")
            calls = [call(session, "/echo", str(n), timeout=None) for n in range(10)]
            await mortal.received("/echo", 10)
            with pytest.raises(QueueTimeout):
                await call(session, "/echo", "impatient", timeout=4 * TICK)
            await asyncio.to_thread(mortal.kill)
            for task in calls:
                with pytest.raises(ServerGone):
                    await task
        await assert_clean(session)
        await server.serve("/echo")
        await check_call(session, "/echo", "another one", timeout=LIMIT)
        statistics = session.pool.statistics()
        assert statistics.clients == statistics.created == 1

    async def test_another_starts_before_the_killed_one_is_missed(
        self, session: Session, server: ServerProcess
    ) -> None:
        async with ServerProcess() as mortal:
            await mortal.serve("/echo")
            await check_call(session, "/echo", "first", timeout=LIMIT)
            await asyncio.to_thread(mortal.kill)
        await server.serve("/echo")
        await until(lambda: session.node.count_services("/echo") == 2)
        # What is sent before the middleware has matched the client with it reaches no server.
        await check_call(session, "/echo", "matched", timeout=LIMIT, retry=Retry(after=LIMIT / 4))
        for number in range(20):
            await check_call(session, "/echo", str(number), timeout=LIMIT)
        assert session.pool.statistics().created == 1


async def test_100_calls_ended_in_each_way_leave_nothing_in_rclpy(
    bridge: Bridge, server: ServerProcess
) -> None:
    await server.serve("/echo", delay="never")
    limits = Limits(in_flight=300, grace=TICK)
    async with Session("forgetful", bridge=bridge, limits=limits) as session:
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        tasks = [call(session, "/echo", "late", timeout=4 * TICK) for _ in range(100)]
        cancelled = [call(session, "/echo", "cancelled") for _ in range(100)]
        await server.received("/echo", 10)
        for task in cancelled:
            task.cancel()
        await asyncio.gather(*tasks, *cancelled, return_exceptions=True)
        await until(lambda: session.pool.statistics().abandoned == 0)
        await until(lambda: pending_in_rclpy(session) == 0)
        gone = [call(session, "/echo", "gone", timeout=None) for _ in range(10)]
        await server.received("/echo", 20)
        await server.stop("/echo")
        for task in gone:
            with pytest.raises(ServerGone):
                await task
        assert pending_in_rclpy(session) == 0
        await assert_clean(session)
