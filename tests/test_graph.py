"""The ROS graph: servers that appear, vanish, or do not fit."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from rosasync import AsyncServiceProxy, Limits, ProxyState, ServiceUnavailable, Session
from rosasync._client.mismatch import MISMATCH_DELAY
from rosasync.testing import VirtualClock
from tests.support.checks import assert_clean, check_call
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge


TRIGGER = "std_srvs/srv/Trigger"
MISMATCH = "is served as std_srvs/srv/SetBool by node /stock_server"


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return what rosasync has warned of."""
    return [
        record.getMessage()
        for record in caplog.records
        if record.name.startswith("rosasync") and record.levelno == logging.WARNING
    ]


async def seen(session: Session, name: str) -> None:
    """Wait until the session's node sees this service of the stock server's node."""

    def listed() -> bool:
        if "stock_server" not in session.node.get_node_names():
            return False
        services = session.node.get_service_names_and_types_by_node("stock_server", "/")
        # The node's list and the endpoints arrive by different topics.
        return (
            name in [service for service, _ in services] and session.node.count_services(name) > 0
        )

    await until(listed)


class TestUnavailable:
    """The message says what the graph shows instead."""

    async def test_nothing(self, session: Session) -> None:
        with pytest.raises(ServiceUnavailable, match="/echo") as caught:
            await session.call(ECHO, "echo", timeout=2 * TICK)
        assert caught.value.srv_name == "/echo"
        assert caught.value.srv_type == ECHO
        assert caught.value.elapsed > 0
        statistics = session.pool.statistics()
        assert (statistics.timed_out, statistics.in_flight, statistics.waiting) == (1, 0, 0)

    async def test_the_name_under_another_type(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/enable", "std_srvs/srv/SetBool")
        await seen(session, "/enable")
        with pytest.raises(ServiceUnavailable, match="std_srvs/srv/SetBool"):
            await session.call("std_srvs/srv/Trigger", "/enable", timeout=4 * TICK)

    async def test_a_similar_name(self, session: Session, server: ServerProcess) -> None:
        await server.serve("/arm/enable")
        await seen(session, "/arm/enable")
        with pytest.raises(ServiceUnavailable, match="/arm/enable"):
            await session.call(ECHO, "/arm/enabel", timeout=4 * TICK)

    async def test_a_qos_that_does_not_match(self, session: Session, echo: str) -> None:
        await seen(session, echo)
        best_effort = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.BEST_EFFORT)
        with pytest.raises(ServiceUnavailable, match="(?i)qos"):
            await session.call(ECHO, echo, qos=best_effort, timeout=4 * TICK)
        await check_call(session, echo, "the default matches")

    async def test_at_once_where_nobody_wants_to_wait(
        self, session: Session, server: ServerProcess
    ) -> None:
        async with asyncio.timeout(LIMIT / 4):
            with pytest.raises(ServiceUnavailable):
                await session.call(ECHO, "/echo", wait=False, timeout=None)
        await server.serve("/echo")
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        await check_call(session, "/echo", "there", wait=False)
        await server.stop("/echo")
        await until(lambda: not session.service_is_ready(ECHO, "/echo"))
        with pytest.raises(ServiceUnavailable):
            await session.call(ECHO, "/echo", wait=False, timeout=None)
        await assert_clean(session)


Wait = Callable[[Session, str], Coroutine[Any, Any, object]]


async def by_call(session: Session, name: str) -> None:
    await session.call(TRIGGER, name, timeout=None)


async def by_lease(session: Session, name: str) -> None:
    async with session.pool.lease(TRIGGER, name, timeout=None):
        pass


async def by_wait(session: Session, name: str) -> None:
    await session.wait_for_service(TRIGGER, name)


async def by_proxy_call(session: Session, name: str) -> None:
    AsyncServiceProxy(session, TRIGGER, name).call_service(timeout=None)


async def by_proxy_wait(session: Session, name: str) -> None:
    AsyncServiceProxy(session, TRIGGER, name).wait_for_service()


async def by_warming(session: Session, name: str) -> None:
    await session.pool.warm(TRIGGER, name)


WAITS: list[Wait] = [by_call, by_lease, by_wait, by_proxy_call, by_proxy_wait, by_warming]


class TestAnotherType:
    """A server of another type: who does not want to wait fails at once, who waits is warned."""

    @pytest.fixture
    async def mismatched(self, session: Session, server: ServerProcess) -> Session:
        await server.serve("/enable", "std_srvs/srv/SetBool")
        await seen(session, "/enable")
        return session

    async def test_without_waiting(self, mismatched: Session) -> None:
        proxy = AsyncServiceProxy(mismatched, TRIGGER, "/enable")
        async with asyncio.timeout(LIMIT):
            with pytest.raises(ServiceUnavailable, match=MISMATCH):
                await mismatched.call(TRIGGER, "/enable", wait=False, timeout=None)
            proxy.call_service(wait=False, timeout=None)
            await until(lambda: proxy.get_state() is ProxyState.TIMEOUT)
        assert [type(error) for error in proxy.get_errors()] == [ServiceUnavailable]
        await assert_clean(mismatched)

    @pytest.mark.slow
    @pytest.mark.parametrize("wait", WAITS)
    async def test_a_warning_once(
        self, mismatched: Session, caplog: pytest.LogCaptureFixture, wait: Wait
    ) -> None:
        waiting = [asyncio.create_task(wait(mismatched, "/enable")) for _ in range(3)]
        await until(lambda: warnings_of(caplog))
        await asyncio.sleep(10 * TICK)
        [warning] = warnings_of(caplog)
        assert re.match(
            f"/enable: callers wait for .* {TRIGGER}, but this name {MISMATCH}", warning
        )
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)

    async def test_no_warning_before_a_second_has_passed(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        fake_graph.serve("std_srvs/srv/SetBool", "/enable", lambda request: None)
        clock = VirtualClock()
        async with fake_graph.session() as session:
            waiting = session.start(TRIGGER, "/enable", timeout=None)
            await clock.advance(0.9 * MISMATCH_DELAY)
            assert warnings_of(caplog) == []
            await clock.advance(MISMATCH_DELAY)
            assert len(warnings_of(caplog)) == 1
            waiting.cancel()

    async def test_no_warning_while_there_is_no_server_or_a_fitting_one(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        clock = VirtualClock()
        fake_graph.serve(TRIGGER, "/busy", lambda request: None)
        fake_graph.serve("std_srvs/srv/SetBool", "/busy", lambda request: None)
        async with fake_graph.session(limits=Limits(in_flight=1)) as session:
            with fake_graph.drop_responses():
                calls = [
                    session.start(TRIGGER, name, timeout=None)
                    for name in ("/absent", "/busy", "/busy")
                ]
                await clock.advance(5 * MISMATCH_DELAY)
            assert warnings_of(caplog) == []
            for call in calls:
                call.cancel()

    async def test_another_warning_for_another_type(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        clock = VirtualClock()
        async with fake_graph.session() as session:
            waiting = session.start(TRIGGER, "/enable", timeout=None)
            for kind in ("std_srvs/srv/SetBool", "std_srvs/srv/Empty"):
                server = fake_graph.serve(kind, "/enable", lambda request: None)
                await clock.advance(3 * MISMATCH_DELAY)
                assert kind in warnings_of(caplog)[-1]
                server.close()
            assert len(warnings_of(caplog)) == 2
            waiting.cancel()


class TestAppearing:
    """Servers that start after the call."""

    async def test_the_waiting_call_is_sent_when_it_appears(
        self, session: Session, server: ServerProcess
    ) -> None:
        calls = [session.start(ECHO, "/echo", request_of(str(n)), timeout=LIMIT) for n in range(30)]
        watch = asyncio.create_task(session.wait_for_service(ECHO, "/echo"))
        await asyncio.sleep(2 * TICK)
        assert not any(task.done() for task in (*calls, watch))
        await server.serve("/echo")
        await watch
        assert [answer_to(await task) for task in calls] == [str(n) for n in range(30)]
        assert await server.received("/echo") == [str(n) for n in range(30)]
        assert session.pool.statistics().created == 1

    async def test_another_type_of_the_name_is_not_it(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/enable", "std_srvs/srv/SetBool")
        task = session.start("std_srvs/srv/Trigger", "/enable", timeout=LIMIT)
        await seen(session, "/enable")
        await asyncio.sleep(2 * TICK)
        assert not task.done()
        await server.stop("/enable")
        async with ServerProcess() as other:
            await other.serve("/enable", "std_srvs/srv/Trigger")
            assert (await task).success
            await session.aclose()

    async def test_the_first_call_of_many_new_sessions_is_answered(
        self, bridge: Bridge, echo: str
    ) -> None:
        """The first response after the match is the one that gets lost in rclpy."""
        for number in range(5):
            async with Session("brief", bridge=bridge, timeout=2 * LIMIT) as session:
                await check_call(session, echo, str(number))


class TestSeveralServers:
    """Two servers of one name: both run every request."""

    async def test_a_warning_once_for_each_name(
        self, session: Session, server: ServerProcess, caplog: pytest.LogCaptureFixture
    ) -> None:
        await server.serve("/twins", copies=2)
        await server.serve("/triplets", copies=3)
        await server.serve("/single")
        for name in ("/twins", "/triplets", "/single"):
            expected = {"/twins": 2, "/triplets": 3}.get(name, 1)
            await until(
                lambda name=name, n=expected: session.node.count_services(name) == n  # type: ignore[misc]
            )
            for number in range(5):
                await check_call(session, name, str(number))
        warnings = warnings_of(caplog)
        assert len(warnings) == 2, warnings
        assert "/twins" in warnings[0]
        assert "/triplets" in warnings[1]
        await server.answered("/triplets", 15)
        await assert_clean(session)

    async def test_one_that_comes_later_is_warned_of(
        self, session: Session, server: ServerProcess, caplog: pytest.LogCaptureFixture
    ) -> None:
        await server.serve("/echo")
        await check_call(session, "/echo", "one")
        assert not caplog.records
        await server.serve("/echo")
        await until(lambda: session.node.count_services("/echo") == 2)
        async with asyncio.timeout(LIMIT):
            # The session learns of it a moment later than its node, and warns with the next call.
            while not any("/echo" in record.getMessage() for record in caplog.records):
                await check_call(session, "/echo", "two")
