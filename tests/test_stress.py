"""Thousands of calls, many of them cancelled or timed out at random."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from rosasync import Limits, QueueTimeout, ResponseTimeout, Session
from tests.support.checks import Takes, assert_clean, check_call, count_takes, take_what_is_left
from tests.support.echo import ECHO, request_of
from tests.support.times import LIMIT, TICK

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess

CALLERS = 100
PATIENCE = 4 * LIMIT


@pytest.fixture
def takes() -> Iterator[Takes]:
    """Count the responses that the middleware hands to the clients."""
    with count_takes() as takes:
        yield takes


@pytest.mark.parametrize("calls", [20, pytest.param(200, marks=pytest.mark.soak)])
@pytest.mark.parametrize(
    "limits",
    [Limits(grace=LIMIT), Limits(clients=8, in_flight=1, grace=LIMIT)],
    ids=["shared", "exclusive"],
)
async def test_no_wanted_answer_is_lost(
    bridge: Bridge, server: ServerProcess, takes: Takes, limits: Limits, calls: int
) -> None:
    await server.serve("/echo")
    outcomes: Counter[str] = Counter()
    chance = random.Random(7)

    async def wanted(text: str) -> None:
        try:
            await check_call(session, "/echo", text, timeout=PATIENCE)
        except ResponseTimeout:
            outcomes["unanswered"] += 1
        else:
            outcomes["answered"] += 1

    async def timed(text: str) -> None:
        try:
            await check_call(session, "/echo", text, timeout=chance.uniform(0, TICK / 2))
        except (ResponseTimeout, QueueTimeout) as error:
            outcomes[type(error).__name__] += 1
        else:
            outcomes["in time"] += 1

    async def cancelled(text: str) -> None:
        task = session.start(ECHO, "/echo", request_of(text), timeout=PATIENCE)
        for _ in range(chance.randrange(3)):
            await asyncio.sleep(0)
        asyncio.get_running_loop().call_later(chance.uniform(0, TICK / 2), task.cancel)
        await asyncio.wait([task])
        outcomes["cancelled" if task.cancelled() else "before"] += 1

    async def caller(name: int) -> None:
        for number in range(calls):
            await chance.choice([wanted, timed, cancelled])(f"{name}-{number}")

    async with Session("stressed", bridge=bridge, limits=limits) as session:
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        async with asyncio.TaskGroup() as group:
            for name in range(CALLERS):
                group.create_task(caller(name))
        await assert_clean(session)
        statistics = session.pool.statistics()
        assert outcomes.total() == CALLERS * calls
        answered = outcomes["answered"] + outcomes["in time"] + outcomes["before"]
        assert statistics.completed == answered
        assert statistics.cancelled == outcomes["cancelled"]
        timed_out = outcomes["ResponseTimeout"] + outcomes["QueueTimeout"]
        assert statistics.timed_out == timed_out + outcomes["unanswered"]
        assert statistics.created <= limits.clients
        assert min(answered, outcomes["cancelled"], statistics.timed_out) > 0, outcomes
        # Each response that arrived was counted once. Only the middleware has lost any.
        assert statistics.late > 0
        assert statistics.completed + statistics.late == takes.responses
        assert take_what_is_left(session) == 0
        assert outcomes["unanswered"] <= await server.answered("/echo") - takes.responses
