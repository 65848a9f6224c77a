"""ResultPlan: when to ask for the result of a goal, and when to give it up."""

from __future__ import annotations

import enum
import math

__all__ = ["Due", "ResultPlan"]

ANSWER_PATIENCE = 0.25
"""Seconds to wait for the response to a goal that is known to have been accepted."""
FIRST_ASK = 5.0
"""Seconds after which a result is asked for again. The intervals grow."""
LAST_ASK = 300.0
"""Maximum number of seconds between two requests for a result."""
ENDED_ASK = 0.5
"""As FIRST_ASK, once the goal is known to have ended."""
ENDED_PATIENCE = 30.0
"""Seconds to wait for the result of such a goal."""


class Due(enum.Enum):
    """What there is to do for a goal."""

    NOTHING = enum.auto()
    ASK = enum.auto()
    GIVE_UP = enum.auto()


class ResultPlan:
    """When to ask for the result of one goal. Pure: it is told each time, in seconds.

    The server answers when the goal has ended, which may take hours, and nothing acknowledges the
    request before. So it is repeated, at growing intervals while the goal runs, and soon once it
    has ended.
    """

    __slots__ = ("_ask_at", "_delay", "_give_up_at")

    def __init__(self) -> None:
        self._ask_at = math.inf
        self._give_up_at = math.inf
        self._delay = FIRST_ASK

    @property
    def next_time(self) -> float:
        """When there is something to do next; infinite if that is not known yet."""
        return min(self._ask_at, self._give_up_at)

    def accepted(self, now: float) -> None:
        """Note that the goal is known to be accepted, although its acceptance has not arrived.

        That is on its way, or lost.
        """
        if self._ask_at == math.inf:
            self._ask_at = now + ANSWER_PATIENCE

    def asked(self, now: float) -> None:
        """Note that the result was asked for."""
        self._ask_at = now + self._delay
        self._delay = min(2 * self._delay, LAST_ASK)

    def ended(self, now: float) -> None:
        """Note that the goal has ended, so that its result is there; only the first time counts."""
        if self._give_up_at == math.inf:
            self._give_up_at = now + ENDED_PATIENCE
            self._delay = 2 * ENDED_ASK
            self._ask_at = now + ENDED_ASK

    def due(self, now: float) -> Due:
        """Return what there is to do."""
        if now >= self._give_up_at:
            return Due.GIVE_UP
        return Due.ASK if now >= self._ask_at else Due.NOTHING
