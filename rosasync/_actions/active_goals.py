"""ActiveGoals: the goals of an action that are out, and the timer for what their plans demand."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rosasync._actions.result_plan import Due

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal

__all__ = ["ActiveGoals"]

LINGER = 5.0
"""Seconds from the last goal to `on_idle`."""
PAUSE = 0.25
"""Minimum number of seconds between two looks at the plans, because there may be thousands. A plan
that changes demands nothing sooner than that."""


class ActiveGoals:
    """The goals of one action that are out. Confined to the loop's thread.

    Iterating yields those that are out at its beginning.

    Args:
        on_due: called with a goal for which there is something to do, and what.
        on_idle: called some time after the last goal, unless another came.

    Attributes:
        find: returns the goal that is out under the bytes of a UUID, or None.
    """

    def __init__(
        self, on_due: Callable[[ActiveGoal, Due], object], on_idle: Callable[[], object]
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_due = on_due
        self._on_idle = on_idle
        self._goals: dict[bytes, ActiveGoal] = {}
        self.find = self._goals.get
        # Set to the next time of a plan, or of `on_idle`. The end of a goal leaves it as it is,
        # so it may find nothing to do.
        self._timer: asyncio.TimerHandle | None = None
        self._idle_at = math.inf

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[ActiveGoal]:
        return iter(tuple(self._goals.values()))

    def add(self, goal: ActiveGoal) -> None:
        """Add a goal."""
        self._goals[goal.key] = goal

    def remove(self, goal: ActiveGoal) -> bool:
        """Remove a goal; return whether it was out, rather than another one of its UUID."""
        if self._goals.get(goal.key) is not goal:
            return False
        del self._goals[goal.key]
        if not self._goals:
            self._idle_at = self._loop.time() + LINGER
            self._wake_at(self._idle_at)
        return True

    def reschedule(self, goal: ActiveGoal) -> None:
        """Heed the plan of a goal, which has changed."""
        self._wake_at(goal.plan.next_time)

    def stop_timer(self) -> None:
        """Call nothing any more, until a plan changes or the last goal is removed."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _wake_at(self, when: float) -> None:
        """Set the timer, unless it is set to an earlier time."""
        if when == math.inf or self._loop.is_closed():
            return
        if self._timer is not None:
            if self._timer.when() <= when:
                return
            self._timer.cancel()
        self._timer = self._loop.call_at(when, self._wake)

    def _wake(self) -> None:
        self._timer = None
        now = self._loop.time()
        if self._goals:
            self._look(now)
        elif now < self._idle_at:
            self._wake_at(self._idle_at)
        else:
            self._on_idle()

    def _look(self, now: float) -> None:
        """Do what the plans demand, and set the timer to what they demand next."""
        try:
            for goal in self:
                due = goal.plan.due(now)
                if due is not Due.NOTHING:
                    self._on_due(goal, due)
        finally:
            times = [goal.plan.next_time for goal in self._goals.values()]
            self._wake_at(max(min(times, default=math.inf), now + PAUSE))
