"""One timer for all deadlines: each future fails at its own, and nothing stays behind."""

from __future__ import annotations

import asyncio
import random
from functools import partial

import pytest

from rosasync._core.aio import SPARE, Deadlines, Expired
from tests.support.times import LIMIT, TICK


def timers() -> int:
    """The timers of the running loop that were not cancelled."""
    scheduled = asyncio.get_running_loop()._scheduled  # type: ignore[attr-defined]
    return sum(not timer.cancelled() for timer in scheduled)


@pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
async def test_each_future_fails_at_its_own_deadline_in_order() -> None:
    loop = asyncio.get_running_loop()
    deadlines, ended = Deadlines(), list[float]()

    def end(deadline: float, future: asyncio.Future[None]) -> None:
        ended.append(deadline)

    now = loop.time()
    times = [now + n * TICK / 10 for n in range(20)]
    random.Random(1).shuffle(times)
    futures = [loop.create_future() for _ in times]
    for future, deadline in zip(futures, times, strict=True):
        future.add_done_callback(partial(end, deadline))
        deadlines.set(future, deadline)
    await asyncio.wait(futures, timeout=LIMIT)
    assert all(isinstance(future.exception(), Expired) for future in futures)
    assert ended == sorted(times)


async def test_one_timer_which_ends_with_the_last_future() -> None:
    loop = asyncio.get_running_loop()
    deadlines, before = Deadlines(), timers()
    last = loop.create_future()
    entries = [deadlines.set(loop.create_future(), loop.time() + LIMIT - n) for n in range(10)]
    deadlines.set(last, loop.time() + TICK)
    assert timers() == before + 1
    for entry in entries:
        entry[-1] = None
    with pytest.raises(Expired):
        await last
    assert timers() == before


async def test_a_future_that_is_done_or_met_is_left_alone() -> None:
    loop = asyncio.get_running_loop()
    deadlines = Deadlines()
    done, met, last = (loop.create_future() for _ in range(3))
    deadlines.set(done, loop.time())
    done.set_result("answer")
    deadlines.set(met, loop.time())[-1] = None
    deadlines.set(last, loop.time() + TICK / 10)
    with pytest.raises(Expired):
        await last
    assert done.result() == "answer"
    assert not met.done()


async def test_what_was_met_is_not_kept() -> None:
    loop = asyncio.get_running_loop()
    deadlines = Deadlines()
    for _ in range(10 * SPARE):
        deadlines.set(loop.create_future(), loop.time() + LIMIT)[-1] = None
        assert len(deadlines._heap) <= 2 * SPARE
    deadlines.close()
    deadlines.close()
    assert not deadlines._heap


async def test_after_the_close_nothing_fails_any_more() -> None:
    loop = asyncio.get_running_loop()
    deadlines, before = Deadlines(), timers()
    future = loop.create_future()
    deadlines.set(future, loop.time())
    deadlines.close()
    assert timers() == before
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert not future.done()
