"""The pool on fake ports: the order in which callers get clients, and what remains afterwards."""

from __future__ import annotations

import asyncio
import logging
import random
import sys
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import pytest

from rosasync import (
    ContextShutdown,
    Limits,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    Retry,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync._client import response_times
from rosasync.testing import VirtualClock
from rosasync.testing._memory.graph import MemoryNode, MemoryQueries
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph
from tests.support.plain import Echo, echo
from tests.support.times import LIMIT, TICK, until


@asynccontextmanager
async def opened(
    graph: FakeGraph, limits: Limits | None = None, **options: Any
) -> AsyncIterator[Session]:
    async with graph.session(limits=limits, **options) as session:
        yield session


async def ask(session: Session, value: object, **options: Any) -> object:
    response = await session.call(Echo, "/echo", Echo.Request(value), **options)
    return response.value


def clients(graph: FakeGraph) -> list[MemoryClient]:
    return [client for node in graph.nodes for client in node.clients]


async def test_each_caller_gets_the_answer_to_its_own_request(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        assert await asyncio.gather(*(ask(session, i) for i in range(100))) == list(range(100))
        total = session.pool.statistics()
    assert (total.completed, total.in_flight, total.waiting, total.peak) == (100, 0, 0, 10)


async def test_one_client_carries_ten(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        with fake_graph.hold_requests():
            tasks = [asyncio.create_task(ask(session, i)) for i in range(30)]
            await until(lambda: session.pool.statistics().in_flight == 10)
            assert session.pool.statistics().waiting == 20
        await asyncio.gather(*tasks)
        assert [client.most for client in clients(fake_graph)] == [10]
    assert server.lost == 0


async def test_exclusive_clients_grow_on_demand_and_none_carries_two(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(clients=8, in_flight=1)) as session:
        await ask(session, 0)
        assert session.pool.statistics().clients == 1
        with fake_graph.hold_requests():
            tasks = [asyncio.create_task(ask(session, i)) for i in range(9)]
            await until(lambda: session.pool.statistics().in_flight == 8)
            assert session.pool.statistics().waiting == 1
        await asyncio.gather(*tasks)
        assert [client.most for client in clients(fake_graph)] == [1] * 8
        sent = [len(client.sent) for client in clients(fake_graph)]
        await asyncio.gather(*(ask(session, i) for i in range(8)))
        again = [len(client.sent) for client in clients(fake_graph)]
        assert [b - a for a, b in zip(sent, again, strict=True)] == [1] * 8
        assert session.pool.statistics().created == 8


async def test_first_come_first_served_also_when_waiters_leave(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1)) as session:
        with fake_graph.hold_requests():
            tasks = [asyncio.create_task(ask(session, i)) for i in range(10)]
            await until(lambda: session.pool.statistics().waiting == 9)
            for gone in (3, 4, 8):
                tasks[gone].cancel()
            await asyncio.gather(*(tasks[gone] for gone in (3, 4, 8)), return_exceptions=True)
        await asyncio.gather(*tasks, return_exceptions=True)
        assert [r.value for r in server.received] == [0, 1, 2, 5, 6, 7, 9]
        total = session.pool.statistics()
    assert (total.cancelled, total.completed, total.waiting) == (3, 7, 0)


async def test_a_place_granted_to_one_who_is_cancelled_goes_to_the_next(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1)) as session:
        async with session.pool.lease(Echo, "/echo"):
            first, second = await queued(session, 1, 2)
        # The place has been granted to the first call, whose task has not resumed yet.
        first.cancel()
        assert await second == 2
        with pytest.raises(asyncio.CancelledError):
            await first
        assert [request.value for request in server.received] == [2]
        assert session.pool.statistics().idle == 1


async def test_who_comes_while_another_is_granted_a_place_is_sent_after_him(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=2)) as session:
        async with session.pool.lease(Echo, "/echo"), session.pool.lease(Echo, "/echo"):
            (first,) = await queued(session, 1)
        assert await ask(session, 2) == 2
        assert await first == 1
    assert [request.value for request in server.received] == [1, 2]


async def test_a_place_granted_to_one_whose_time_is_up_goes_to_the_next(
    fake_graph: FakeGraph,
) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1)) as session:
        loop = asyncio.get_running_loop()
        async with session.pool.lease(Echo, "/echo"):
            late = asyncio.create_task(ask(session, 1, timeout=TICK))
            (second,) = await queued(session, 2, waiting=2)
            # The deadline passes in the turn in which the lease is granted.
            loop.call_later(TICK / 2, time.sleep, TICK)
            await asyncio.sleep(TICK / 2)
        assert await second == 2
        with pytest.raises(QueueTimeout):
            await late
        assert [request.value for request in server.received] == [2]


async def test_a_place_granted_as_everything_ends(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1)) as session:
        async with session.pool.lease(Echo, "/echo"):
            (first,) = await queued(session, 1)
        fake_graph.nodes[0].shutdown()
        with pytest.raises(ContextShutdown):
            await first
    assert server.received == []


async def test_a_place_granted_as_the_server_goes(fake_graph: FakeGraph) -> None:
    """The granted callers wait for the next server, ahead of the rest of the queue."""
    old = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=2)) as session:
        async with session.pool.lease(Echo, "/echo"), session.pool.lease(Echo, "/echo"):
            tasks = await queued(session, 1, 2, 3)
        old.close()
        await asyncio.sleep(TICK)
        assert session.pool.statistics().waiting == 3
        new = fake_graph.serve(Echo, "/echo", echo)
        assert await asyncio.gather(*tasks) == [1, 2, 3]
    assert [request.value for request in new.received] == [1, 2, 3]
    assert old.received == []


async def queued(
    session: Session, *values: int, waiting: int | None = None
) -> list[asyncio.Task[object]]:
    """Start calls that have to wait for a place, and wait until ``waiting`` callers (all) do."""
    tasks = [asyncio.create_task(ask(session, value)) for value in values]
    await until(lambda: session.pool.statistics().waiting == (waiting or len(values)))
    return tasks


async def test_an_abandoned_request_holds_its_place_until_its_late_response(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1, grace=1000.0)) as session:
        with fake_graph.hold_requests():
            with pytest.raises(ResponseTimeout):
                await ask(session, 1, timeout=TICK)
            total = session.pool.statistics()
            assert (total.abandoned, total.in_flight, total.timed_out) == (1, 0, 1)
            waiting = asyncio.create_task(ask(session, 2))
            with pytest.raises(QueueTimeout, match="1 abandoned"):
                await ask(session, 3, timeout=TICK)
        assert await waiting == 2
        total = session.pool.statistics()
    assert (total.abandoned, total.late, total.completed) == (0, 1, 1)


async def test_an_abandoned_request_gives_its_place_back_after_the_grace(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1, grace=2 * TICK)) as session:
        with fake_graph.drop_requests(), pytest.raises(ResponseTimeout):
            await ask(session, 1, timeout=TICK)
        assert session.pool.statistics().abandoned == 1
        assert await ask(session, 2) == 2
        assert session.pool.statistics().abandoned == 0


async def test_a_response_between_cancel_and_wake_up_harms_nobody(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        await ask(session, 0)
        with fake_graph.drop_requests():
            task = asyncio.create_task(ask(session, 1))
            await until(lambda: session.pool.statistics().in_flight == 1)
        client = clients(fake_graph)[0]
        task.cancel()
        client.deliver(client.sent[-1], Echo.Response("late"))
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await ask(session, 2) == 2
        total = session.pool.statistics()
    assert (total.late, total.abandoned, total.idle) == (1, 0, 1)


async def test_a_cancel_after_the_response_loses_only_that_call(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        await ask(session, 0)
        with fake_graph.drop_requests():
            task = asyncio.create_task(ask(session, 1))
            await until(lambda: session.pool.statistics().in_flight == 1)
        client = clients(fake_graph)[0]
        client.deliver(client.sent[-1], Echo.Response("in time"))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        total = session.pool.statistics()
    assert (total.late, total.abandoned, total.in_flight, total.cancelled) == (1, 0, 0, 1)


async def test_a_call_goes_out_as_soon_as_its_server_appears(fake_graph: FakeGraph) -> None:
    async with opened(fake_graph) as session:
        tasks = [asyncio.create_task(ask(session, i)) for i in range(3)]
        await until(lambda: session.pool.statistics().waiting == 3)
        fake_graph.serve(Echo, "/echo", echo)
        assert await asyncio.gather(*tasks) == [0, 1, 2]


@pytest.mark.parametrize("events", [True, False])
async def test_the_poller_serves_where_graph_events_do_not(events: bool) -> None:
    graph = FakeGraph(graph_events=events)
    async with opened(graph) as session:
        waiting = asyncio.create_task(session.wait_for_service(Echo, "/echo"))
        await asyncio.sleep(0)
        server = graph.serve(Echo, "/echo", echo)
        await waiting
        with graph.drop_requests():
            task = asyncio.create_task(ask(session, 1))
            await until(lambda: session.pool.statistics().in_flight == 1)
            server.close()
            with pytest.raises(ServerGone):
                await task


async def test_unavailable_says_what_was_seen(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echoes", echo)
    async with opened(fake_graph) as session:
        with pytest.raises(ServiceUnavailable, match=r"/echo: .* has /echoes \(") as caught:
            await ask(session, 1, timeout=TICK)
        assert caught.value.srv_name == "/echo"
        assert caught.value.elapsed > 0
        with pytest.raises(ServiceUnavailable):
            await ask(session, 1, wait=False, timeout=None)
        assert clients(fake_graph)[0].sent == []


async def test_server_gone_spares_a_response_sent_before(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        await ask(session, 0)
        with fake_graph.delay_responses(TICK / 10):
            task = asyncio.create_task(ask(session, 1))
            await until(lambda: len(server.received) == 2)
        server.close()
        assert await task == 1


async def test_after_its_server_is_gone_a_call_waits_for_the_next(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        with fake_graph.hold_requests():
            task = asyncio.create_task(ask(session, 1))
            abandoned = asyncio.create_task(ask(session, 2))
            await until(lambda: session.pool.statistics().in_flight == 2)
            abandoned.cancel()
            server.close()
            with pytest.raises(ServerGone):
                await task
        assert session.pool.statistics().abandoned == 0
        later = asyncio.create_task(ask(session, 3))
        await until(lambda: session.pool.statistics().waiting == 1)
        fake_graph.serve(Echo, "/echo", echo)
        assert await later == 3
        assert session.pool.statistics().created == 1


async def test_pool_full(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(in_flight=1, waiting=2)) as session:
        await ask(session, 0)
        with fake_graph.hold_requests():
            tasks = [asyncio.create_task(ask(session, i)) for i in range(3)]
            await until(lambda: session.pool.statistics().waiting == 2)
            with pytest.raises(PoolFull, match=r"Limits\.waiting=2"):
                await ask(session, 3)
        assert await asyncio.gather(*tasks) == [0, 1, 2]


async def test_a_client_that_cannot_be_made_is_the_callers_error(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        node: Any = session.node
        open_client = node.open_client

        def refuse(*_: object) -> None:
            raise UsageError("one type per name")

        node.open_client = refuse
        with pytest.raises(UsageError, match="one type"):
            await ask(session, 1)
        assert session.pool.statistics().waiting == 0
        node.open_client = open_client
        assert await ask(session, 2) == 2


async def test_without_a_line_a_first_call_still_goes_through(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(waiting=0)) as session:
        assert await ask(session, 1) == 1


async def test_idle_clients_are_evicted_and_made_again(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(clients=3, in_flight=1, idle=TICK)) as session:
        await asyncio.gather(*(ask(session, i) for i in range(3)))
        assert session.pool.statistics().clients == 3
        await until(lambda: session.pool.statistics().clients == 0)
        assert clients(fake_graph) == []
        assert await ask(session, 1) == 1
        assert session.pool.statistics().created == 4


async def test_a_client_somebody_waits_with_is_not_evicted(fake_graph: FakeGraph) -> None:
    async with opened(fake_graph, Limits(idle=TICK)) as session:
        task = asyncio.create_task(ask(session, 1))
        watch = asyncio.create_task(session.wait_for_service(Echo, "/echo"))
        await asyncio.sleep(3 * TICK)
        assert session.pool.statistics().clients == 1
        fake_graph.serve(Echo, "/echo", echo)
        assert await task == 1
        await watch


async def test_warm(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph, Limits(clients=3, in_flight=1)) as session:
        await session.pool.warm(Echo, "/echo", clients=3)
        assert session.pool.statistics().created == 3
        with pytest.raises(ValueError, match=r"Limits\.clients=3"):
            await session.pool.warm(Echo, "/echo", clients=4)
        await session.pool.warm(Echo, "/nobody")
        assert session.pool.statistics().created == 4


class TestLease:
    """`ClientPool.lease`."""

    async def test_every_way_out_gives_it_back(self, fake_graph: FakeGraph) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        async with opened(fake_graph, Limits(in_flight=1)) as session:
            async with session.pool.lease(Echo, "/echo") as client:
                assert (await client.call(Echo.Request(1))).value == 1
                assert (await client.call(Echo.Request(2))).value == 2
            with pytest.raises(ZeroDivisionError):
                async with session.pool.lease(Echo, "/echo"):
                    raise ZeroDivisionError
            assert session.pool.statistics().idle == 1
            with pytest.raises(UsageError, match="is over"):
                await client.call(Echo.Request(3))

    async def test_it_carries_one_call_at_a_time(self, fake_graph: FakeGraph) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        async with (
            opened(fake_graph) as session,
            session.pool.lease(Echo, "/echo") as client,
        ):
            with fake_graph.hold_requests():
                task = asyncio.create_task(client.call(Echo.Request(1)))
                await until(lambda: session.pool.statistics().in_flight == 1)
                with pytest.raises(UsageError, match="one call at a time"):
                    await client.call(Echo.Request(2))
            assert (await task).value == 1

    async def test_a_call_waits_for_the_place_its_predecessor_abandoned(
        self, fake_graph: FakeGraph
    ) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        async with (
            opened(fake_graph, Limits(in_flight=1)) as session,
            session.pool.lease(Echo, "/echo") as client,
        ):
            with fake_graph.hold_requests():
                with pytest.raises(ResponseTimeout):
                    await client.call(Echo.Request(1), timeout=TICK)
                with pytest.raises(QueueTimeout):
                    await client.call(Echo.Request(2), timeout=TICK)
                task = asyncio.create_task(client.call(Echo.Request(3)))
                await asyncio.sleep(0)
            assert (await task).value == 3
            assert [port.most for port in clients(fake_graph)] == [1]

    async def test_a_lease_in_vain(self, fake_graph: FakeGraph) -> None:
        async with opened(fake_graph, Limits(in_flight=1)) as session:
            with pytest.raises(ServiceUnavailable):
                async with session.pool.lease(Echo, "/echo", timeout=TICK):
                    pass
            fake_graph.serve(Echo, "/echo", echo)
            async with session.pool.lease(Echo, "/echo"):
                with pytest.raises(QueueTimeout):
                    async with session.pool.lease(Echo, "/echo", timeout=TICK):
                        pass


class TestRetry:
    """`Retry`, if requests or responses get lost."""

    async def test_what_was_lost_is_sent_again(self, fake_graph: FakeGraph) -> None:
        server = fake_graph.serve(Echo, "/echo", echo)
        async with opened(fake_graph) as session:
            await ask(session, 0)
            with fake_graph.drop_requests():
                # Sends at once, so that the block ends before the second attempt.
                task = session.start(Echo, "/echo", Echo.Request(1), retry=Retry(after=TICK))
            assert (await task).value == 1
            total = session.pool.statistics()
        assert (total.retried, total.abandoned, len(server.received)) == (1, 0, 2)

    async def test_the_first_answer_wins_and_the_second_is_late(
        self, fake_graph: FakeGraph
    ) -> None:
        server = fake_graph.serve(Echo, "/echo", echo)
        async with opened(fake_graph) as session:
            await ask(session, 0)
            with fake_graph.delay_responses(20 * TICK):
                task = asyncio.create_task(ask(session, 1, retry=Retry(2, 5 * TICK)))
                await until(lambda: len(server.received) == 2)
            with fake_graph.delay_responses(40 * TICK):
                await until(lambda: len(server.received) == 3)
            assert await task == 1
            assert session.pool.statistics().abandoned == 1
            await until(lambda: session.pool.statistics().late == 1)
            assert session.pool.statistics().abandoned == 0

    async def test_the_attempts_end_and_the_deadline_holds(self, fake_graph: FakeGraph) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        clock = VirtualClock()
        async with opened(fake_graph, Limits(grace=LIMIT)) as session:
            await ask(session, 0)
            retry = Retry(3, LIMIT, 1.0)
            with fake_graph.drop_requests(), pytest.raises(ResponseTimeout):
                await clock.skip(ask(session, 1, retry=retry, timeout=6 * LIMIT))
            total = session.pool.statistics()
            assert (total.retried, total.abandoned) == (2, 3)
            await clock.advance(LIMIT)
            assert session.pool.statistics().abandoned == 0


class TestEndings:
    """The session or its context ends with callers in every phase."""

    @pytest.mark.parametrize("how", ["closed", "shut down"])
    async def test_every_caller_is_told(self, fake_graph: FakeGraph, how: str) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        async with opened(fake_graph, Limits(in_flight=1)) as session:
            node = session.node
            assert isinstance(node, MemoryNode)
            with fake_graph.hold_requests():
                calls = [
                    ask(session, "in flight"),
                    ask(session, "in line"),
                    session.call(Echo, "/nobody", Echo.Request(), timeout=None),
                    session.wait_for_service(Echo, "/nobody"),
                ]
                tasks = [asyncio.create_task(call) for call in calls]
                await until(lambda: session.pool.statistics().waiting == 2)
                if how == "closed":
                    await session.aclose()
                else:
                    node.shutdown()
                results = await asyncio.gather(*tasks, return_exceptions=True)
            kind = SessionClosed if how == "closed" else ContextShutdown
            assert [type(result) for result in results] == [kind] * 4
            with pytest.raises(kind):
                await ask(session, "too late")
            total = session.pool.statistics()
        assert (total.in_flight, total.waiting, total.clients, total.abandoned) == (0, 0, 0, 0)
        assert clients(fake_graph) == []

    async def test_a_context_that_goes_down_silently_is_noticed(
        self, fake_graph: FakeGraph
    ) -> None:
        async with opened(fake_graph) as session:
            task = asyncio.create_task(ask(session, 1, timeout=None))
            await until(lambda: session.pool.statistics().waiting == 1)
            node = session.node
            assert isinstance(node, MemoryNode)
            node.up = False
            with pytest.raises(ContextShutdown):
                await task

    async def test_an_idle_pool_has_no_timer_but_the_eviction(self, fake_graph: FakeGraph) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        async with opened(fake_graph) as session:
            await ask(session, 1)
            loop: Any = asyncio.get_running_loop()

            def awake() -> int:
                return sum(not timer.cancelled() for timer in loop._scheduled)

            await until(lambda: awake() <= 2)  # the eviction, and until's own sleep


async def test_several_servers_of_one_name_are_warned_of_once(
    fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    fake_graph.serve(Echo, "/echo", echo)
    async with opened(fake_graph) as session:
        with caplog.at_level(logging.WARNING, "rosasync"):
            for value in range(3):
                assert await ask(session, value) == value
            fake_graph.changed()
            assert await ask(session, 3) == 3
    assert [r.getMessage().split(".")[0] for r in caplog.records] == [
        "/echo: 2 servers answer this name, of /server_1 and /server_2"
    ]


async def test_servers_that_have_crashed_do_not_count_as_several(
    fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graph shows one for some time after its end, when its successor is there already."""
    first, _ = (fake_graph.serve(Echo, "/echo", echo) for _ in range(2))
    crashed = frozenset({first.identity})
    monkeypatch.setattr(MemoryQueries, "find_ended", lambda graph, servers: crashed & servers)
    async with opened(fake_graph) as session:
        with caplog.at_level(logging.WARNING, "rosasync"):
            assert await ask(session, 1) == 1
            assert caplog.messages == []
            fake_graph.serve(Echo, "/echo", echo)
            assert await ask(session, 2) == 2
    assert [message.partition(" answer")[0] for message in caplog.messages] == ["/echo: 2 servers"]


async def test_a_call_goes_to_the_successor_of_a_server_that_has_crashed(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It does not wait for the calls that are out at the old one."""
    monkeypatch.setattr(response_times, "PATIENCE_INITIAL", 1_000.0)
    first = fake_graph.serve(Echo, "/echo", echo)
    crashed = frozenset({first.identity})
    monkeypatch.setattr(MemoryQueries, "find_ended", lambda node, servers: crashed & servers)
    async with opened(fake_graph, Limits(in_flight=2)) as session:
        with fake_graph.drop_requests():
            out = [asyncio.create_task(ask(session, number)) for number in range(2)]
            await until(lambda: session.pool.statistics().in_flight == 2)
        waiting = asyncio.create_task(ask(session, 2))
        await until(lambda: session.pool.statistics().waiting == 1)
        fake_graph.serve(Echo, "/echo", echo)
        assert await waiting == 2
        for call in out:
            call.cancel()


async def test_a_storm_leaves_nothing(fake_graph: FakeGraph) -> None:
    """Calls that are cancelled or time out at random do not cause others to be lost."""
    dice = random.Random(1)
    server = fake_graph.serve(Echo, "/echo", echo)

    async def caller(number: int) -> None:
        kind = dice.randrange(3)
        if kind == 0:
            assert await ask(session, number, timeout=60.0) == number
        elif kind == 1:
            with suppress(TimeoutError):
                assert await ask(session, number, timeout=dice.random() * TICK / 5) == number
        else:
            task = asyncio.create_task(ask(session, number, timeout=60.0))
            await asyncio.sleep(dice.random() * TICK / 5)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    async with opened(fake_graph, Limits(clients=2, in_flight=5)) as session:
        with fake_graph.delay_responses(TICK / 50):
            await asyncio.gather(*(caller(number) for number in range(2000)))
        await until(lambda: session.pool.statistics().abandoned == 0)
        total = session.pool.statistics()
        assert (total.in_flight, total.waiting, total.idle) == (0, 0, 2)
        assert max(client.most for client in clients(fake_graph)) <= 5
        assert total.completed + total.timed_out + total.cancelled == 2000
    assert server.lost == 0


async def test_reprs_tell_state_and_counts(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    session = fake_graph.session()
    assert "not open" in repr(session)
    async with session:
        await ask(session, 1)
        assert repr(session.pool) == (
            "<ClientPool 1 service, 1 client, 1 idle, 0 in flight, 0 waiting>"
        )
        async with session.pool.lease(Echo, "/echo") as client:
            assert repr(client) == "<LeasedClient /echo idle>"
        assert repr(session.client(Echo, "/echo")).startswith("<ServiceClient /echo")
    assert repr(session) == "<Session 'fake' closed>"


async def test_a_repr_in_another_thread_while_services_are_added(
    fake_graph: FakeGraph,
) -> None:
    async with fake_graph.session() as session:
        ended = threading.Event()

        def look() -> None:
            while not ended.is_set():
                assert "service" in repr(session)

        interval = sys.getswitchinterval()
        sys.setswitchinterval(1e-6)
        try:
            looking = asyncio.create_task(asyncio.to_thread(look))
            for service in range(200):
                session.client(Echo, f"/echo_{service}")
                await asyncio.sleep(0)
            ended.set()
            await looking
        finally:
            ended.set()
            sys.setswitchinterval(interval)


class TestClients:
    """The defaults of `Session.client`."""

    async def test_limits_of_its_own(self, fake_graph: FakeGraph) -> None:
        fake_graph.serve(Echo, "/echo", echo)
        deep = Limits(in_flight=30, server_depth=None)
        async with fake_graph.session() as session:
            client = session.client(Echo, "/echo", limits=deep)
            same = session.client(Echo, "/echo", limits=Limits(in_flight=30, server_depth=None))
            plain = session.client(Echo, "/echo", limits=Limits())
            with fake_graph.delay_responses(4 * TICK):
                calls = [one.start() for one in (client, same) for _ in range(25)]
                await until(lambda: session.pool.statistics().in_flight == 30)
                total = session.pool.statistics()
                assert (total.clients, total.waiting) == (1, 20)
                calls += [plain.start(), session.start(Echo, "/echo")]
                await until(lambda: session.pool.statistics().clients == 2)
                assert [each.servers for each in session.pool.statistics().keys.values()] == [1]
            await asyncio.gather(*calls)
            with pytest.raises(TypeError, match="limits must be"):
                session.client(Echo, "/echo", limits=10)  # type: ignore[call-overload]

    async def test_wait_and_retry(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            impatient = session.client(Echo, "/echo", wait=False, retry=Retry(after=10 * TICK))
            with pytest.raises(ServiceUnavailable):
                await impatient.call()
            with pytest.raises(ServiceUnavailable):
                await impatient.start()
            waiting = impatient.start(wait=True)
            await asyncio.sleep(0)
            with fake_graph.drop_requests():
                fake_graph.serve(Echo, "/echo", echo)
                await until(lambda: session.pool.statistics().in_flight)
            await waiting
            assert session.pool.statistics().retried == 1
            with fake_graph.drop_requests(), pytest.raises(ResponseTimeout):
                await impatient.call(retry=Retry(attempts=1), timeout=4 * TICK)
            assert session.pool.statistics().retried == 1
            mistakes: list[dict[str, Any]] = [{"wait": "no"}, {"retry": 3}]
            for mistake in mistakes:
                with pytest.raises(TypeError):
                    session.client(Echo, "/echo", **mistake)
