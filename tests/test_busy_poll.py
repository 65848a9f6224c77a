"""Busy poll: no response is lost between polling and sleeping, and it polls only if it pays."""

from __future__ import annotations

import asyncio

import pytest

from rosasync import Session, UsageError
from tests.support.checks import assert_clean, check_call, count_takes
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK

MAX_TAKES = 20
"""The maximum number of takes without polling. Polling takes hundreds of times."""


@pytest.mark.parametrize("calls", [100, pytest.param(500, marks=pytest.mark.soak)])
@pytest.mark.parametrize("budget", [2e-5, 5e-5, 1e-4, 2e-4, 1e-3])
async def test_every_call_is_answered(echo: str, budget: float, calls: int) -> None:
    """The budgets are about as long as a call, so many responses arrive as the polling stops."""
    async with Session("busy", bridge="direct", busy_poll=budget) as session:
        await session.wait_for_service("diagnostic_msgs/srv/AddDiagnostics", echo, timeout=LIMIT)

        async def caller(name: int) -> None:
            for number in range(calls):
                await check_call(session, echo, f"{name}-{number}", timeout=LIMIT)

        await caller(0)
        await asyncio.gather(*(caller(name) for name in range(1, 4)))
        assert session.pool.statistics().completed == 4 * calls
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
    await server.serve("/echo", delay=2 * TICK)
    with count_takes() as takes:
        async with Session("busy", bridge="direct", busy_poll=TICK) as session:
            await check_call(session, "/echo", "first", timeout=LIMIT)
            takes.attempts = 0
            for number in range(5):
                await check_call(session, "/echo", str(number), timeout=LIMIT)
            assert 5 <= takes.attempts <= 5 * MAX_TAKES


async def test_after_a_slow_answer_it_sleeps_until_a_quick_one(server: ServerProcess) -> None:
    await server.serve("/echo")
    with count_takes() as takes:
        async with Session("busy", bridge="direct", busy_poll=TICK) as session:
            await check_call(session, "/echo", "first", timeout=LIMIT)
            await check_call(session, "/echo", "quick", timeout=LIMIT)
            await server.change("/echo", 2 * TICK)
            await check_call(session, "/echo", "slow, spun for", timeout=LIMIT)
            takes.attempts = 0
            await check_call(session, "/echo", "slow, slept for", timeout=LIMIT)
            assert 1 <= takes.attempts <= MAX_TAKES
            await server.change("/echo", None)
            await check_call(session, "/echo", "quick again", timeout=LIMIT)


async def test_it_needs_the_direct_bridge() -> None:
    with pytest.raises(UsageError, match="direct bridge"):
        async with Session("busy", bridge="executor", busy_poll=TICK):
            pass
    with pytest.raises(ValueError, match="busy_poll"):
        Session(busy_poll=-1.0)
