"""The virtual clock: timers in their order, deadlines that take no time, and its limits."""

from __future__ import annotations

import asyncio
import time

import pytest
import uvloop

from rosasync.testing import VirtualClock
from tests.support.times import LIMIT, TICK


class Log(list[tuple[str, float]]):
    """What ran, and when by the loop's time since the log was made, to ten seconds."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._start = self._loop.time()

    def add(self, name: str) -> None:
        self.append((name, round(self._loop.time() - self._start, -1)))

    def later(self, seconds: float, name: str) -> asyncio.TimerHandle:
        return self._loop.call_later(seconds, self.add, name)


async def test_advance_runs_what_is_due_in_its_order(virtual_clock: VirtualClock) -> None:
    log = Log()
    await virtual_clock.advance(0)
    for seconds, name in ((300, "c"), (100, "a"), (200, "b"), (1000, "never")):
        log.later(seconds, name)
    await virtual_clock.advance(500)
    assert log == [("a", 100), ("b", 200), ("c", 300)]
    log.add("now")
    assert log[-1] == ("now", 500)


async def test_advance_runs_timers_that_timers_make(virtual_clock: VirtualClock) -> None:
    log = Log()
    await virtual_clock.advance(0)

    async def periodic() -> None:
        while True:
            await asyncio.sleep(100)
            log.add("tick")

    task = asyncio.create_task(periodic())
    await virtual_clock.advance(350)
    assert log == [("tick", 100), ("tick", 200), ("tick", 300)]
    task.cancel()


async def test_advance_leaves_out_what_was_cancelled(virtual_clock: VirtualClock) -> None:
    log = Log()
    await virtual_clock.advance(0)
    log.later(100, "cancelled").cancel()
    log.later(200, "kept")
    await virtual_clock.advance(300)
    assert log == [("kept", 200)]


async def test_timers_from_before_the_first_use_are_due_as_well(
    virtual_clock: VirtualClock,
) -> None:
    log = Log()
    log.later(100, "before")
    await virtual_clock.advance(200)
    assert [name for name, _ in log] == ["before"]


async def test_time_never_goes_back(virtual_clock: VirtualClock) -> None:
    before = virtual_clock.time()
    await virtual_clock.advance(100)
    await virtual_clock.advance(-100)
    assert virtual_clock.time() >= before + 100
    assert VirtualClock().time() >= before + 100
    assert asyncio.get_running_loop().time() >= before + 100


async def test_skip_returns_the_result_long_before(virtual_clock: VirtualClock) -> None:
    started = time.monotonic()
    assert await virtual_clock.skip(asyncio.sleep(1e6, "slept")) == "slept"
    assert time.monotonic() < started + LIMIT


async def test_skip_raises_what_was_raised(virtual_clock: VirtualClock) -> None:
    async def fail() -> None:
        await asyncio.sleep(1e6)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await virtual_clock.skip(fail())


async def test_skip_waits_for_other_threads(virtual_clock: VirtualClock) -> None:
    def slept() -> str:
        time.sleep(TICK)
        return "slept"

    assert await virtual_clock.skip(asyncio.to_thread(slept)) == "slept"


async def test_skip_that_is_cancelled_cancels(virtual_clock: VirtualClock) -> None:
    ended = asyncio.Event()

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()

    skip = asyncio.create_task(virtual_clock.skip(endless()))
    await virtual_clock.advance(100)
    skip.cancel()
    with pytest.raises(asyncio.CancelledError):
        await skip
    await ended.wait()


def test_uvloop_does_not_allow_it() -> None:
    with (
        asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner,
        pytest.raises(TypeError, match="uvloop.Loop cannot be changed"),
    ):
        runner.run(VirtualClock().advance(1))
