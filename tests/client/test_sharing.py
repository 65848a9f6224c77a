"""Sessions that share a server's queue, and servers that are replaced."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import Limits, ResponseTimeout, Retry, ServerGone, Session
from tests.support.echo import ECHO, request_of
from tests.support.plain import Echo, echo
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.fake_graph import FakeGraph


def in_flight(session: Session) -> int:
    return session.pool.statistics().in_flight


def window(session: Session) -> int:
    return session.pool.statistics().window


@pytest.mark.parametrize(
    ("in_flight", "depth", "clients", "window"),
    [
        (10, 10, 1, 10),
        (10, 10, 2, 5),
        (10, 10, 3, 3),
        (10, 10, 16, 1),
        (2, 10, 2, 2),
        (1, 10, 8, 1),
        (10, None, 16, 10),
        (10, 100, 4, 10),
        (200, 10, 1, 200),
        (200, 10, 4, 50),
        (10, 10, 0, 10),
    ],
)
def test_the_window_is_a_share_of_the_servers_queue(
    in_flight: int, depth: int | None, clients: int, window: int
) -> None:
    assert Limits(in_flight=in_flight, server_depth=depth).window(clients) == window


@pytest.mark.parametrize("depth", [0, -1, 2.5, "10", True])
def test_a_depth_is_a_positive_whole_number(depth: Any) -> None:
    with pytest.raises((TypeError, ValueError), match="server_depth"):
        Limits(server_depth=depth)


@pytest.mark.parametrize(("sessions", "share"), [(1, 10), (2, 5), (4, 2), (12, 1)])
async def test_each_of_several_sessions_keeps_to_its_share(
    fake_graph: FakeGraph, sessions: int, share: int
) -> None:
    # With more clients than places in the queue, each still has one.
    server = fake_graph.serve(Echo, "/echo", echo, depth=max(10, sessions))
    async with AsyncExitStack() as stack:
        opened = [await stack.enter_async_context(fake_graph.session()) for _ in range(sessions)]
        for session in opened:
            await session.call(Echo, "/echo", Echo.Request(0))
        await until(lambda: {window(session) for session in opened} == {share})
        with fake_graph.hold_requests():
            tasks = [
                session.start(Echo, "/echo", Echo.Request(n))
                for n in range(20)
                for session in opened
            ]
            await until(lambda: all(in_flight(session) == share for session in opened))
            await asyncio.sleep(0)
            assert [in_flight(session) for session in opened] == [share] * sessions
        await asyncio.gather(*tasks)
    assert server.lost == 0


async def test_the_share_grows_when_another_session_ends(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        async with fake_graph.session() as other:
            for each in (session, other):
                await each.call(Echo, "/echo", Echo.Request(0))
            with fake_graph.hold_requests():
                tasks = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(20)]
                await until(lambda: in_flight(session) == 5)
                await other.aclose()
                await until(lambda: in_flight(session) == 10)
        await asyncio.gather(*tasks)


async def test_two_sessions_share_a_stock_servers_queue(
    bridge: Bridge, server: ServerProcess
) -> None:
    await server.serve("/shared", delay="hold")
    async with (
        Session("first", bridge=bridge, timeout=LIMIT) as first,
        Session("second", bridge=bridge, timeout=LIMIT) as second,
    ):
        for session in (first, second):
            await session.wait_for_service(ECHO, "/shared", timeout=LIMIT)
        await until(lambda: window(first) == window(second) == 5)
        tasks = [
            session.start(ECHO, "/shared", request_of(f"{session.node.get_name()} {n}"))
            for n in range(15)
            for session in (first, second)
        ]
        await until(lambda: in_flight(first) == in_flight(second) == 5)
        await server.received("/shared", 10)
        assert in_flight(first) == in_flight(second) == 5
        # Every request that was sent is answered: the queue of ten has held them all.
        for received in range(10, 31, 10):
            await server.release("/shared", 10)
            if received < 30:
                await server.received("/shared", received + 10)
        await asyncio.gather(*tasks)


async def test_an_answer_gives_back_the_places_of_earlier_abandoned_requests(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=4, grace=1000.0)) as session:
        await session.call(Echo, "/echo", Echo.Request(0))
        with fake_graph.drop_requests():
            for _ in range(3):
                with pytest.raises(ResponseTimeout):
                    await session.call(Echo, "/echo", timeout=TICK / 5)
        assert session.pool.statistics().abandoned == 3
        assert (await session.call(Echo, "/echo", Echo.Request(1))).value == 1
        assert session.pool.statistics().abandoned == 0


async def test_a_call_ends_when_its_server_is_replaced(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        with fake_graph.hold_requests():
            call = session.start(Echo, "/echo", Echo.Request(1), timeout=None)
            await until(lambda: in_flight(session) == 1)
            await asyncio.sleep(0)
            fake_graph.serve(Echo, "/echo", echo)
            server.close()
            with pytest.raises(ServerGone):
                await asyncio.wait_for(call, LIMIT)
        assert (await session.call(Echo, "/echo", Echo.Request(2))).value == 2
        total = session.pool.statistics()
        assert (total.in_flight, total.abandoned) == (0, 0)


async def test_a_call_to_the_successor_does_not_end_with_its_predecessor(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        await session.call(Echo, "/echo", Echo.Request(0))
        await asyncio.sleep(0)
        successor = fake_graph.serve(Echo, "/echo", echo)
        server.close()
        with fake_graph.hold_requests():
            call = session.start(Echo, "/echo", Echo.Request(1), timeout=LIMIT)
            for _ in range(3):
                fake_graph.changed()
                await asyncio.sleep(TICK)
            assert not call.done()
        assert (await call).value == 1
        assert len(successor.received) == 1


async def test_a_call_that_both_servers_have_goes_on(fake_graph: FakeGraph) -> None:
    first, second = (fake_graph.serve(Echo, "/echo", echo) for _ in range(2))
    async with fake_graph.session() as session:
        with fake_graph.hold_requests():
            call = session.start(Echo, "/echo", Echo.Request(1), timeout=LIMIT)
            await until(lambda: in_flight(session) == 1)
            await asyncio.sleep(0)
            first.close()
            await asyncio.sleep(2 * TICK)
            assert not call.done()
        assert (await call).value == 1
        assert second.received


async def test_abandoned_requests_of_a_server_that_was_replaced_hold_no_place(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=1, grace=1000.0)) as session:
        await session.call(Echo, "/echo", Echo.Request(0))
        with fake_graph.drop_requests(), pytest.raises(ResponseTimeout):
            await session.call(Echo, "/echo", timeout=TICK / 5)
        assert session.pool.statistics().abandoned == 1
        fake_graph.serve(Echo, "/echo", echo)
        server.close()
        assert (await session.call(Echo, "/echo", Echo.Request(1), timeout=LIMIT)).value == 1


async def test_a_call_ends_when_its_stock_server_is_replaced(
    bridge: Bridge, server: ServerProcess
) -> None:
    await server.serve("/replaced", delay="hold")
    # In a process of its own: inside one process, Fast DDS may never connect a client that has a
    # server already with the server's successor.
    successor = ServerProcess()
    try:
        async with Session("caller", bridge=bridge) as session:
            await session.wait_for_service(ECHO, "/replaced", timeout=LIMIT)
            call = session.start(ECHO, "/replaced", request_of("x"), timeout=None)
            await server.received("/replaced", 1)
            await successor.serve("/replaced")
            service = session.core.arguments.service(ECHO, "/replaced", None)
            await until(lambda: len(session.core.node.queries.find_servers(service)) == 2)
            await server.stop("/replaced")
            with pytest.raises(ServerGone):
                await asyncio.wait_for(call, LIMIT)
            # The middleware may report a match while the predecessor's is the only one: the request
            # is then lost (rmw_fastrtps issue 842).
            retry = Retry(attempts=40, after=5 * TICK, backoff=1.0)
            await session.call(ECHO, "/replaced", request_of("y"), timeout=LIMIT, retry=retry)
    finally:
        successor.close()
