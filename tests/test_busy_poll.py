"""Busy poll: no response is lost between looking and sleeping, and it spins only where it pays."""

from __future__ import annotations

import asyncio
import time

import pytest

from rosasync import Session, UsageError
from tests.support.checks import assert_clean, check_call
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK


@pytest.mark.parametrize("budget", [2e-5, 5e-5, 1e-4, 2e-4, 1e-3])
async def test_every_call_is_answered(echo: str, budget: float) -> None:
    """Budgets about as long as a call, so that many responses come as the loop gives up."""
    async with Session("busy", bridge="direct", busy_poll=budget) as session:
        await session.wait_for_service("diagnostic_msgs/srv/AddDiagnostics", echo, timeout=LIMIT)

        async def caller(name: int) -> None:
            for number in range(500):
                await check_call(session, echo, f"{name}-{number}", timeout=LIMIT)

        await caller(0)
        await asyncio.gather(*(caller(name) for name in range(1, 4)))
        assert session.pool.statistics().completed == 2000
        await assert_clean(session)


async def test_other_tasks_have_their_turns(server: ServerProcess) -> None:
    await server.serve("/echo")
    async with Session("busy", bridge="direct", busy_poll=LIMIT) as session:
        for number in range(5):
            await check_call(session, "/echo", str(number), timeout=LIMIT)
        await server.change("/echo", "hold")
        call = asyncio.create_task(check_call(session, "/echo", "held", timeout=LIMIT))
        await server.received("/echo", 6)
        await asyncio.sleep(TICK)
        assert not call.done()
        await server.release("/echo")
        await call


async def test_a_slow_service_is_not_spun_for(server: ServerProcess) -> None:
    """The CPU of a call that is answered after a long time is a fraction of that time."""
    await server.serve("/echo", delay=2 * TICK)
    async with Session("busy", bridge="direct", busy_poll=TICK) as session:
        await check_call(session, "/echo", "first", timeout=LIMIT)
        before = time.thread_time()
        for number in range(5):
            await check_call(session, "/echo", str(number), timeout=LIMIT)
        assert time.thread_time() - before < TICK


async def test_after_a_slow_answer_it_sleeps_until_a_quick_one(server: ServerProcess) -> None:
    await server.serve("/echo")
    async with Session("busy", bridge="direct", busy_poll=TICK) as session:
        await check_call(session, "/echo", "first", timeout=LIMIT)
        await check_call(session, "/echo", "quick", timeout=LIMIT)
        await server.change("/echo", 2 * TICK)
        await check_call(session, "/echo", "slow, spun for", timeout=LIMIT)
        before = time.thread_time()
        await check_call(session, "/echo", "slow, slept for", timeout=LIMIT)
        assert time.thread_time() - before < TICK / 2
        await server.change("/echo", None)
        await check_call(session, "/echo", "quick again", timeout=LIMIT)


async def test_it_needs_the_direct_bridge() -> None:
    with pytest.raises(UsageError, match="direct bridge"):
        async with Session("busy", bridge="executor", busy_poll=TICK):
            pass
    with pytest.raises(ValueError, match="busy_poll"):
        Session(busy_poll=-1.0)
