"""The goals of an action server: their states, which ones a request cancels, when they expire.

The rules of ``rcl_action`` (``goal_state_machine.c``, ``action_server.c``), without loop and ports.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from enum import Enum, IntEnum
from typing import NamedTuple

from rosasync._actions.status import TERMINAL, GoalStatus

__all__ = [
    "NO_GOAL",
    "CancelCode",
    "CancelSelection",
    "GoalEvent",
    "GoalRecord",
    "GoalTable",
    "next_status",
]

NO_GOAL = bytes(16)
"""The goal id of a cancel request that names no goal."""


class GoalEvent(Enum):
    """What happens to a goal after its acceptance."""

    EXECUTE = "execute"
    CANCEL_GOAL = "cancel"
    SUCCEED = "succeed"
    ABORT = "abort"
    CANCELED = "canceled"


class CancelCode(IntEnum):
    """The return codes of ``action_msgs/srv/CancelGoal``."""

    NONE = 0
    REJECTED = 1
    UNKNOWN_GOAL_ID = 2
    GOAL_TERMINATED = 3


_TRANSITIONS: dict[tuple[GoalStatus, GoalEvent], GoalStatus] = {
    (GoalStatus.ACCEPTED, GoalEvent.EXECUTE): GoalStatus.EXECUTING,
    (GoalStatus.ACCEPTED, GoalEvent.CANCEL_GOAL): GoalStatus.CANCELING,
    (GoalStatus.EXECUTING, GoalEvent.CANCEL_GOAL): GoalStatus.CANCELING,
    (GoalStatus.EXECUTING, GoalEvent.SUCCEED): GoalStatus.SUCCEEDED,
    (GoalStatus.EXECUTING, GoalEvent.ABORT): GoalStatus.ABORTED,
    (GoalStatus.CANCELING, GoalEvent.SUCCEED): GoalStatus.SUCCEEDED,
    (GoalStatus.CANCELING, GoalEvent.ABORT): GoalStatus.ABORTED,
    (GoalStatus.CANCELING, GoalEvent.CANCELED): GoalStatus.CANCELED,
}


def next_status(status: GoalStatus, event: GoalEvent) -> GoalStatus | None:
    """Return the status after an event, or None if the event cannot happen in this status."""
    return _TRANSITIONS.get((status, event))


class GoalRecord:
    """One goal of a `GoalTable`.

    Attributes:
        id: the 16 bytes of its id.
        stamp: when it was accepted, in ns of the node's clock.
        status: its status; changed by `GoalTable.apply` alone.
    """

    __slots__ = ("id", "stamp", "status")

    def __init__(self, goal_id: bytes, stamp: int) -> None:
        self.id = goal_id
        self.stamp = stamp
        self.status = GoalStatus.ACCEPTED

    @property
    def cancelable(self) -> bool:
        """Whether a request may cancel it: it runs or waits, and is not being cancelled yet."""
        return next_status(self.status, GoalEvent.CANCEL_GOAL) is not None

    @property
    def ended(self) -> bool:
        """Whether it has succeeded, aborted or been cancelled."""
        return self.status in TERMINAL


class CancelSelection(NamedTuple):
    """The goals that a cancel request asks for, before the server has agreed.

    Attributes:
        code: the return code, unless the server refuses all of ``goals``.
        goals: the goals to cancel.
    """

    code: CancelCode
    goals: list[GoalRecord]


class GoalTable:
    """The goals of one server, from their acceptance to their expiry.

    Args:
        result_timeout: seconds for which a goal is kept after its end; ``math.inf`` for ever.
    """

    def __init__(self, result_timeout: float) -> None:
        self._timeout = result_timeout
        self._goals: dict[bytes, GoalRecord] = {}
        # The goals that have ended and the times of their expiry, which grow, because the timeout
        # is the same for all.
        self._expiring: deque[tuple[float, GoalRecord]] = deque()

    def __len__(self) -> int:
        return len(self._goals)

    def __iter__(self) -> Iterator[GoalRecord]:
        return iter(self._goals.values())

    def get(self, goal_id: bytes) -> GoalRecord | None:
        """Return a goal, or None if it is unknown or has expired."""
        return self._goals.get(goal_id)

    def accept(self, goal_id: bytes, stamp: int) -> GoalRecord:
        """Add a goal.

        Raises:
            ValueError: there is one of this id.
        """
        if goal_id in self._goals:
            raise ValueError(f"goal {goal_id.hex()} was accepted before")
        goal = self._goals[goal_id] = GoalRecord(goal_id, stamp)
        return goal

    def apply(self, goal: GoalRecord, event: GoalEvent, now: float) -> bool:
        """Change the status of a goal.

        Args:
            goal: a goal of the table.
            event: what happens to it.
            now: the time of the loop, in seconds.

        Returns:
            False if this cannot happen in its status, which stays.
        """
        status = next_status(goal.status, event)
        if status is None:
            return False
        goal.status = status
        if status in TERMINAL and self._timeout < math.inf:
            self._expiring.append((now + self._timeout, goal))
        return True

    def select(self, goal_id: bytes, stamp: int) -> CancelSelection:
        """Return the goals that a cancel request asks for.

        ========  ======  =======================================================
        goal id   stamp   asks for
        ========  ======  =======================================================
        zero      zero    every goal
        zero      given   the goals accepted at this time or before
        given     zero    this goal
        given     given   this goal, and those accepted at this time or before
        ========  ======  =======================================================

        Args:
            goal_id: the 16 bytes of the goal's id.
            stamp: a time in ns of the node's clock.
        """
        if goal_id != NO_GOAL and not stamp:
            goal = self._goals.get(goal_id)
            if goal is None:
                return CancelSelection(CancelCode.UNKNOWN_GOAL_ID, [])
            if not goal.cancelable:
                return CancelSelection(CancelCode.GOAL_TERMINATED, [])
            return CancelSelection(CancelCode.NONE, [goal])
        every = goal_id == NO_GOAL and not stamp
        return CancelSelection(
            CancelCode.NONE,
            [
                goal
                for goal in self._goals.values()
                if goal.cancelable and (every or goal.stamp <= stamp or goal.id == goal_id)
            ],
        )

    def expiry(self) -> float | None:
        """Return when the next goal expires, in seconds of the loop's time; None if none does."""
        return self._expiring[0][0] if self._expiring else None

    def expire(self, now: float) -> list[GoalRecord]:
        """Forget the goals that have expired, and return them."""
        expired = []
        while self._expiring and self._expiring[0][0] <= now:
            goal = self._expiring.popleft()[1]
            del self._goals[goal.id]
            expired.append(goal)
        return expired
