"""ActiveGoals: the goals of an action that are out, and the timer that looks after them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal

__all__ = ["ActiveGoals"]

LINGER = 5.0
"""Seconds from the last goal to `on_idle`."""
TICK = 0.25
"""Seconds between two calls of `on_tick`."""


class ActiveGoals:
    """The goals of one action that are out. Confined to the loop's thread.

    Iterating yields those that are out at its beginning.

    Args:
        on_tick: called regularly while goals are out, for what has no event.
        on_idle: called some time after the last one, unless another came.

    Attributes:
        find: returns the goal that is out under the bytes of a UUID, or None.
    """

    def __init__(self, on_tick: Callable[[], object], on_idle: Callable[[], object]) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_tick = on_tick
        self._on_idle = on_idle
        self._goals: dict[bytes, ActiveGoal] = {}
        self.find = self._goals.get
        # Runs every TICK while goals are out, and once, LINGER after the last.
        self._timer: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[ActiveGoal]:
        return iter(tuple(self._goals.values()))

    def add(self, goal: ActiveGoal) -> None:
        """Add a goal."""
        if not self._goals:
            self._set_timer(TICK)
        self._goals[goal.key] = goal

    def remove(self, goal: ActiveGoal) -> bool:
        """Remove a goal; return whether it was out, rather than another one of its UUID."""
        if self._goals.get(goal.key) is not goal:
            return False
        del self._goals[goal.key]
        if not self._goals:
            self._set_timer(LINGER)
        return True

    def stop_timer(self) -> None:
        """Call nothing any more, until a goal is added to none."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _set_timer(self, delay: float) -> None:
        self.stop_timer()
        if not self._loop.is_closed():
            self._timer = self._loop.call_later(delay, self._tick)

    def _tick(self) -> None:
        self._timer = None
        if not self._goals:
            self._on_idle()
            return
        self._on_tick()
        # The end of the last goal has set it to LINGER.
        if self._goals:
            self._set_timer(TICK)
