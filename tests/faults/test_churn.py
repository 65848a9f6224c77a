"""Clients, leases and servers that come and go, and calls that are cancelled, at random."""

from __future__ import annotations

import asyncio
import random
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rosasync import Limits, Session
from tests.faults.trial import PATIENT, Trial
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.servers import ServerProcess
from tests.support.serving import FORMS
from tests.support.times import LIMIT, TICK

pytestmark = pytest.mark.slow

SHAPES = {
    "shared": Limits(grace=4 * TICK),
    "exclusive": Limits(clients=8, in_flight=1, grace=4 * TICK),
}


async def test_clients_leases_and_servers(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/echo")
    limits = Limits(clients=4, in_flight=2, idle=TICK, grace=2 * TICK)
    chance = random.Random(11)
    ended = asyncio.Event()

    async def lease(session: Session) -> None:
        while not ended.is_set():
            async with session.pool.lease(ECHO, "/echo", timeout=LIMIT) as client:
                for number in range(chance.randrange(3)):
                    text = f"leased {number}"
                    call = client.call(request_of(text), timeout=LIMIT)
                    await trial.count(call, LIMIT, lambda r, t=text: answer_to(r) == t)  # type: ignore[misc]

    async def serve(session: Session, number: int) -> None:
        while not ended.is_set():
            async with session.serve(ECHO, f"/own_{number}", FORMS["async, call"]):
                count = chance.randrange(5)
                # The graph may still show the previous server of this name, and not yet this one.
                await trial.calls(session, f"/own_{number}", count, timeout=LIMIT, retry=PATIENT)

    async def make_clients(session: Session, number: int) -> None:
        while not ended.is_set():
            await session.pool.warm(ECHO, f"/warm_{number}", chance.randint(1, 4))
            await asyncio.sleep(chance.uniform(0, 2 * TICK))

    async with (
        trial.session(limits=limits) as session,
        asyncio.TaskGroup() as group,
        trial.callers(session, "/echo", 5, timeout=LIMIT),
    ):
        for number in range(3):
            group.create_task(lease(session))
            group.create_task(serve(session, number))
            group.create_task(make_clients(session, number))
        await asyncio.sleep(1_200 * TICK if full else 20 * TICK)
        ended.set()
    assert not trial.failed


@asynccontextmanager
async def debugging() -> AsyncIterator[None]:
    loop = asyncio.get_running_loop()
    loop.set_debug(True)
    slow, loop.slow_callback_duration = loop.slow_callback_duration, LIMIT
    yield
    loop.slow_callback_duration = slow
    loop.set_debug(False)


@asynccontextmanager
async def eager_tasks() -> AsyncIterator[None]:
    loop = asyncio.get_running_loop()
    loop.set_task_factory(asyncio.eager_task_factory)  # type: ignore[attr-defined]
    yield
    loop.set_task_factory(None)


@asynccontextmanager
async def plainly() -> AsyncIterator[None]:
    yield


MODES = {"plain": plainly, "debug mode": debugging}
if sys.version_info >= (3, 12):
    MODES["eager tasks"] = eager_tasks


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
async def test_cancelled_calls(
    trial: Trial, server: ServerProcess, full: bool, shape: str, mode: str
) -> None:
    async with MODES[mode](), trial.session(limits=SHAPES[shape]) as session:
        await _cancel_at_random(trial, session, server, 20_000 if full else 300)


@pytest.mark.parametrize("bridge", ["direct"])
@pytest.mark.parametrize("shape", SHAPES)
async def test_cancelled_calls_with_busy_poll(
    trial: Trial, server: ServerProcess, full: bool, shape: str
) -> None:
    async with trial.session(limits=SHAPES[shape], busy_poll=0.0005) as session:
        await _cancel_at_random(trial, session, server, 20_000 if full else 300)


async def _cancel_at_random(
    trial: Trial, session: Session, server: ServerProcess, calls: int
) -> None:
    """Make calls, a third of which are cancelled and a third of which get hardly any time."""
    await server.serve("/echo")
    await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
    chance = random.Random(13)
    loop = asyncio.get_running_loop()

    async def one() -> None:
        how = chance.randrange(3)
        # Not long: places come back so soon that requests are lost at a server that is held up.
        timeout = chance.uniform(0, TICK / 4) if how == 1 else LIMIT / 4
        task = asyncio.create_task(trial.call(session, "/echo", timeout=timeout))
        await asyncio.sleep(0)
        if how == 2:
            loop.call_later(chance.uniform(0, TICK / 4), task.cancel)
        await asyncio.wait([task])

    async def caller() -> None:
        for _ in range(calls // 50):
            await one()

    async with asyncio.TaskGroup() as group:
        for _ in range(50):
            group.create_task(caller())
    row = trial.row
    assert row.made == calls // 50 * 50
    assert trial.failed.keys() <= {"CancelledError", "QueueTimeout", "ResponseTimeout"}
    assert row.answered >= row.made / 4
    statistics = session.pool.statistics()
    assert statistics.completed == row.answered
    assert statistics.cancelled == trial.failed["CancelledError"]
    assert statistics.timed_out == trial.failed["QueueTimeout"] + trial.failed["ResponseTimeout"]
    assert statistics.failed == 0
