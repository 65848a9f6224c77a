"""VirtualClock: loop time that a test moves forward, so that a deadline takes no time.

It changes what the running loop calls "now", and nothing else. So it works with every test runner,
with sessions that a fixture has opened before, and on real ROS. looptime replaces the loops of all
tests in a run and sets their time back to zero between a fixture and its test, which leaves the
timers of an open session in the far future.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections.abc import Awaitable, Callable
from contextvars import Context
from typing import Any, TypeVar

__all__ = ["VirtualClock"]

T = TypeVar("T")

TURNS = 50
"""Turns of the loop in which everything in memory settles between two steps of the clock."""
IDLE = 0.01
"""Seconds to wait for other threads if no timer is left to skip to."""


class VirtualClock:
    """Moves the time of the running loop forward.

    ::

        clock = VirtualClock()
        with pytest.raises(ResponseTimeout):
            await clock.skip(session.call(SetBool, "/arm/enable", timeout=10.0))

    The loop's time goes on as before, plus what was skipped, and never goes back. Only the loop is
    affected: ``time.monotonic()``, ``time.sleep()`` and other threads are not. It is installed in
    the running loop when it is first used. Use it with asyncio's own loop: uvloop does not allow
    it.

    Args:
        settle: real seconds to wait before each step, for responses from outside the process's
            memory. 0 for a graph in memory, about 0.1 on real ROS. A session with calls or goals
            out looks at its context twice a second, so an hour takes 7,200 steps.
    """

    def __init__(self, settle: float = 0.0) -> None:
        self._settle_time = settle

    def time(self) -> float:
        """Return the loop's time, in seconds."""
        return _installed().time()

    async def advance(self, seconds: float) -> None:
        """Move the time forward; timers that are due on the way run in their order.

        Raises:
            TypeError: the loop's time cannot be changed, as in uvloop.
        """
        clock = _installed()
        target = clock.time() + seconds
        await self._settle()
        while (due := clock.next_timer()) is not None and due <= target:
            clock.move_to(due)
            await self._settle()
        clock.move_to(target)
        await self._settle()

    async def skip(self, awaitable: Awaitable[T]) -> T:
        """Await something, and skip every wait for a timer until it is done.

        Returns:
            The result of the awaitable, whose exceptions are raised as well.

        Raises:
            TypeError: the loop's time cannot be changed, as in uvloop.
        """
        clock = _installed()
        task = asyncio.ensure_future(awaitable)
        try:
            await self._settle()
            while not task.done():
                if (due := clock.next_timer()) is None:
                    await asyncio.wait({task}, timeout=IDLE)
                else:
                    clock.move_to(due)
                await self._settle()
            return task.result()
        finally:
            task.cancel()

    async def _settle(self) -> None:
        for _ in range(TURNS):
            await asyncio.sleep(0)
        if self._settle_time:
            await asyncio.sleep(self._settle_time)


class _LoopTime:
    """The time of one loop, from the moment it is installed to the end of the loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._real_time = loop.time
        self._real_call_at = loop.call_at
        self._skipped = 0.0
        self._numbers = itertools.count()
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        loop.time = self.time  # type: ignore[method-assign]
        loop.call_at = self.call_at  # type: ignore[assignment, method-assign]

    def time(self) -> float:
        return self._real_time() + self._skipped

    def call_at(
        self,
        when: float,
        callback: Callable[..., object],
        *args: Any,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        handle = self._real_call_at(when, callback, *args, context=context)
        heapq.heappush(self._timers, (when, next(self._numbers), handle))
        return handle

    def next_timer(self) -> float | None:
        """Return when the next timer is due; None if there is none."""
        now = self.time()
        while self._timers:
            when, _, handle = self._timers[0]
            if when > now and not handle.cancelled():
                return when
            heapq.heappop(self._timers)
        return None

    def move_to(self, when: float) -> None:
        self._skipped += max(0.0, when - self.time())


def _installed() -> _LoopTime:
    """Return the time of the running loop, and install it if this is the first use."""
    loop = asyncio.get_running_loop()
    # The timers of other loops, such as uvloop's, do not ask for the loop's time.
    if not isinstance(loop, asyncio.BaseEventLoop):
        raise TypeError(
            f"the time of {type(loop).__module__}.{type(loop).__name__} cannot be changed: "
            "run tests that use VirtualClock on asyncio's own loop"
        )
    installed = getattr(loop.time, "__self__", None)
    return installed if isinstance(installed, _LoopTime) else _LoopTime(loop)
