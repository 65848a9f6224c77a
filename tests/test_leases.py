"""The pool with real clients: shared and exclusive use, fairness, eviction, constant resources."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import pytest

from rosasync import Limits, PoolFull, QueueTimeout, Session, SessionClosed, UsageError
from rosasync._ros.inspect import all_discovered
from tests.support.checks import assert_clean, check_call, count_descriptors, count_threads
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess


@pytest.fixture
async def exclusive(bridge: Bridge) -> AsyncIterator[Session]:
    """A session with eight clients for each service, each used by one caller at a time."""
    limits = Limits(clients=8, in_flight=1)
    async with Session("exclusive", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        yield session


class TestExclusive:
    """Eight clients that carry one request each."""

    async def test_two_callers_use_two_clients(
        self, exclusive: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        one, two = (exclusive.start(ECHO, "/echo", request_of(t)) for t in ("one", "two"))
        await server.received("/echo", 2)
        statistics = exclusive.pool.statistics()
        assert (statistics.clients, statistics.idle, statistics.in_flight) == (2, 0, 2)
        await server.release("/echo")
        assert [answer_to(await one), answer_to(await two)] == ["one", "two"]
        assert exclusive.pool.statistics().idle == 2

    async def test_one_caller_keeps_to_one_client(self, exclusive: Session, echo: str) -> None:
        for number in range(50):
            await check_call(exclusive, echo, str(number))
        assert exclusive.pool.statistics().created == 1

    async def test_the_ninth_waits_and_all_eight_are_used_again(
        self, exclusive: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        tasks = [exclusive.start(ECHO, "/echo", request_of(str(n))) for n in range(9)]
        assert sorted(await server.received("/echo", 8)) == [str(n) for n in range(8)]
        statistics = exclusive.pool.statistics()
        assert (statistics.clients, statistics.in_flight, statistics.waiting) == (8, 8, 1)
        await asyncio.sleep(2 * TICK)
        assert len(await server.received("/echo")) == 8
        await server.release("/echo", 1)
        assert (await server.received("/echo", 9))[-1] == "8"
        await server.release("/echo")
        assert [answer_to(await task) for task in tasks] == [str(n) for n in range(9)]
        again = [exclusive.start(ECHO, "/echo", request_of(f"again {n}")) for n in range(8)]
        await server.received("/echo", 17)
        assert exclusive.pool.statistics().in_flight == 8
        await server.release("/echo")
        assert [answer_to(await task) for task in again] == [f"again {n}" for n in range(8)]
        statistics = exclusive.pool.statistics()
        assert statistics.created == statistics.clients == statistics.idle == 8
        await assert_clean(exclusive)

    async def test_no_client_ever_carries_two(self, exclusive: Session, echo: str) -> None:
        async def caller(name: int) -> None:
            for number in range(20):
                async with exclusive.pool.lease(ECHO, echo) as client:
                    assert client not in leased
                    leased.append(client)
                    response = await client.call(request_of(f"{name}-{number}"))
                    assert answer_to(response) == f"{name}-{number}"
                    leased.remove(client)

        leased: list[object] = []
        async with asyncio.TaskGroup() as group:
            for name in range(30):
                group.create_task(caller(name))
        statistics = exclusive.pool.statistics()
        assert statistics.peak == statistics.created == 8
        assert statistics.completed == 600
        await assert_clean(exclusive)

    async def test_a_leased_client_is_no_good_afterwards(
        self, exclusive: Session, echo: str
    ) -> None:
        async with exclusive.pool.lease(ECHO, echo) as client:
            assert answer_to(await client.call(request_of("inside"))) == "inside"
        with pytest.raises(UsageError):
            await client.call(request_of("outside"))

    async def test_a_lease_comes_back_when_its_block_raises(
        self, exclusive: Session, echo: str
    ) -> None:
        for _ in range(20):
            with pytest.raises(ZeroDivisionError):
                async with exclusive.pool.lease(ECHO, echo):
                    raise ZeroDivisionError
        assert exclusive.pool.statistics().created == 1
        await assert_clean(exclusive)


class TestFairness:
    """First come, first served."""

    @pytest.mark.parametrize("limits", [Limits(in_flight=1), Limits(clients=2, in_flight=1)])
    async def test_in_order_also_when_waiters_in_the_middle_are_cancelled(
        self, bridge: Bridge, server: ServerProcess, limits: Limits
    ) -> None:
        await server.serve("/echo", delay="hold")
        # No deadline: a call that would be answered too late on a busy machine is passed over.
        async with Session("fair", bridge=bridge, limits=limits, timeout=None) as session:
            await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
            width = limits.clients
            first = [session.start(ECHO, "/echo", request_of(f"out {n}")) for n in range(width)]
            await server.received("/echo", width)
            queued = [session.start(ECHO, "/echo", request_of(str(n))) for n in range(40)]
            await until(lambda: session.pool.statistics().waiting == 40)
            for task in queued[1::3]:
                task.cancel()
            await asyncio.wait(queued[1::3])
            kept = [n for n in range(40) if n % 3 != 1]
            for count in range(len(kept)):
                await server.release("/echo", 1)
                await server.received("/echo", width + count + 1)
            await server.release("/echo")
            expected = [f"out {n}" for n in range(width)] + [str(n) for n in kept]
            assert (await server.received("/echo"))[width:] == expected[width:]
            assert [answer_to(await queued[n]) for n in kept] == [str(n) for n in kept]
            await asyncio.wait(first)
            await assert_clean(session)

    async def test_a_newcomer_does_not_overtake_the_queue(
        self, bridge: Bridge, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        limits = Limits(in_flight=1)
        async with Session("queue", bridge=bridge, limits=limits, timeout=LIMIT) as session:
            first = session.start(ECHO, "/echo", request_of("first"))
            await server.received("/echo", 1)
            second = session.start(ECHO, "/echo", request_of("second"))
            await until(lambda: session.pool.statistics().waiting == 1)
            newcomers = []
            first.add_done_callback(
                lambda _: newcomers.append(session.start(ECHO, "/echo", request_of("newcomer")))
            )
            await server.release("/echo")
            assert await server.received("/echo", 2) == ["first", "second"]
            await server.release("/echo")
            assert (await server.received("/echo", 3))[2] == "newcomer"
            await server.release("/echo")
            await asyncio.gather(second, *newcomers)


async def test_a_full_queue(bridge: Bridge, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    limits = Limits(in_flight=1, waiting=2)
    async with Session("full", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        await session.wait_for_service(ECHO, "/echo")
        tasks = [session.start(ECHO, "/echo", request_of(str(n))) for n in range(3)]
        await until(lambda: session.pool.statistics().waiting == 2)
        with pytest.raises(PoolFull, match="/echo"):
            await session.call(ECHO, "/echo")
        for count in range(3):
            await server.received("/echo", count + 1)
            await server.release("/echo")
        assert [answer_to(await task) for task in tasks] == ["0", "1", "2"]
        await assert_clean(session)


async def test_a_lease_that_comes_too_late(bridge: Bridge, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    limits = Limits(in_flight=1)
    async with Session("late", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        async with session.pool.lease(ECHO, "/echo") as client:
            with pytest.raises(QueueTimeout):
                async with session.pool.lease(ECHO, "/echo", timeout=2 * TICK):
                    pytest.fail("there is no client to lease")
            task = asyncio.create_task(client.call(request_of("mine")))
            await server.received("/echo", 1)
            await server.release("/echo")
            assert answer_to(await task) == "mine"
        await assert_clean(session)


async def test_a_lease_held_while_the_session_closes(bridge: Bridge, echo: str) -> None:
    session = Session("held", bridge=bridge, timeout=LIMIT)
    await session.__aenter__()
    async with session.pool.lease(ECHO, echo) as client:
        await client.call(request_of("open"))
        await session.aclose()
        with pytest.raises(SessionClosed):
            await client.call(request_of("closed"))


async def test_warm(bridge: Bridge, echo: str) -> None:
    limits = Limits(clients=3, in_flight=1)
    async with Session("warm", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        await session.wait_for_service(ECHO, echo, timeout=LIMIT)
        await session.pool.warm(ECHO, echo, clients=2)
        statistics = session.pool.statistics()
        assert statistics.clients == statistics.idle == statistics.created == 2
        assert session.service_is_ready(ECHO, echo)
        await asyncio.gather(*(check_call(session, echo, str(n), wait=False) for n in range(2)))
        assert session.pool.statistics().created == 2


async def test_idle_clients_are_destroyed_and_made_again(bridge: Bridge, echo: str) -> None:
    limits = Limits(idle=2 * TICK)
    async with Session("idle", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        for round_ in range(1, 4):
            await check_call(session, echo, str(round_))
            assert session.pool.statistics().created == round_
            await until(lambda: session.pool.statistics().clients == 0)
            await until(lambda: not list(session.node.clients))


async def test_a_client_in_use_is_not_destroyed(bridge: Bridge, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    limits = Limits(idle=TICK, grace=LIMIT)
    async with Session("used", bridge=bridge, limits=limits, timeout=LIMIT) as session:
        task = session.start(ECHO, "/echo", request_of("slow"))
        abandoned = session.start(ECHO, "/echo", request_of("abandoned"))
        await server.received("/echo", 2)
        abandoned.cancel()
        await asyncio.sleep(4 * TICK)
        assert session.pool.statistics().clients == 1
        await server.release("/echo", 1)
        assert answer_to(await task) == "slow"
        await asyncio.sleep(4 * TICK)
        assert session.pool.statistics().clients == 1
        await server.release("/echo")
        await until(lambda: session.pool.statistics().clients == 0)
        assert session.pool.statistics().late == 1


@pytest.mark.parametrize("services", [100, pytest.param(1000, marks=pytest.mark.soak)])
async def test_a_thousand_services_leave_no_thread_or_file_behind(
    bridge: Bridge, lonely_echo: str, services: int
) -> None:
    limits = Limits(idle=10 * TICK)
    async with Session("thousand", bridge=bridge, limits=limits, timeout=LIMIT) as session:

        async def pool_and_evict(services: int) -> None:
            await asyncio.gather(
                *(session.pool.warm(ECHO, f"/service_{number}") for number in range(services))
            )
            await until(lambda: session.pool.statistics().clients == 0, 4 * LIMIT)

        await check_call(session, lonely_echo, "before")
        await pool_and_evict(50)
        # Each process that is discovered takes descriptors.
        await until(lambda: all_discovered(session.node))
        threads, descriptors = count_threads(), count_descriptors()
        await pool_and_evict(services)
        assert session.pool.statistics().created == services + 51
        await until(lambda: not list(session.node.clients), 4 * LIMIT)
        assert count_threads() == threads
        assert count_descriptors() == descriptors
        await check_call(session, lonely_echo, "after")


async def test_clients_that_never_called_are_destroyed_too(bridge: Bridge) -> None:
    async with Session("unused", bridge=bridge, limits=Limits(idle=TICK)) as session:
        await session.pool.warm(ECHO, "/warmed")
        assert not session.service_is_ready(ECHO, "/asked_for")
        assert session.pool.statistics().clients == 2
        await until(lambda: session.pool.statistics().clients == 0)


async def test_clients_come_and_go_while_others_call(bridge: Bridge, server: ServerProcess) -> None:
    """Creating and destroying clients while the node is spun has crashed rclpy."""
    names = [f"/echo_{number}" for number in range(8)]
    for name in names:
        await server.serve(name)
    async with Session("churn", bridge=bridge, limits=Limits(idle=0.0)) as session:

        async def caller(offset: int) -> None:
            for number in range(60):
                name = names[(number + offset) % len(names)]
                await check_call(session, name, f"{offset}-{number}", timeout=LIMIT)
                await asyncio.sleep(TICK / 50)

        await asyncio.gather(*(caller(offset) for offset in range(4)))
        statistics = session.pool.statistics()
        assert statistics.completed == 240
        assert statistics.created > len(names)
        await until(lambda: session.pool.statistics().clients == 0)
