"""What a session knows of each goal that is out, and the feedback not read by its handles yet."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from uuid import UUID

from rosasync._actions.result_plan import ResultPlan
from rosasync._actions.status import TERMINAL, GoalStatus

if TYPE_CHECKING:
    from rosasync._core.ports import Servers
    from rosasync.tracing import CallTrace
    from rosasync.tracing import Outcome as TraceOutcome

__all__ = ["ActiveGoal", "FeedbackQueue", "Outcome"]


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a goal has ended.

    Attributes:
        status: its last status.
        result: the result message.
        make_error: makes the error, if it did not end by a result, such as `ServerGone`.
    """

    status: GoalStatus
    result: Any = None
    make_error: Callable[[], Exception] | None = None


class ActiveGoal:
    """What a session knows of a goal that is out. All handles of the goal share it.

    Confined to the loop's thread. `ActionClient` and its parts write the attributes.

    Attributes:
        id: the UUID.
        key: its bytes.
        started: the loop time at which the client began to send it.
        status: the last status known.
        accepted_at: when the server accepted it, in ns; None before, and for an attached goal.
        acceptance: the task that sends the goal and takes the answer; None if it was not sent by
            this session.
        answered: set when `acceptance` has ended, or when the session closes.
        servers: those that may have the goal: there when it was sent, or accepted. One may vanish
            in between.
        asked: whether its result has been asked for, as it is from the acceptance on.
        outcome: how it has ended.
        settled: set with the outcome.
        ended: set with the outcome, when the session closes, or when its last handle has left it.
        is_followed: whether a handle may still learn how it ends.
        ending: the background task that cancels it, after its caller has left.
        detached: whether it is to run on when its caller leaves.
        plan: when to ask for its result.
        trace: follows the goal, if something listens.
    """

    __slots__ = (
        "_make_closed",
        "_readers",
        "acceptance",
        "accepted_at",
        "answered",
        "asked",
        "detached",
        "ended",
        "ending",
        "id",
        "is_followed",
        "key",
        "outcome",
        "plan",
        "servers",
        "settled",
        "started",
        "status",
        "trace",
    )

    def __init__(self, goal_id: UUID, started: float) -> None:
        self.id = goal_id
        self.key = goal_id.bytes
        self.started = started
        self.trace: CallTrace | None = None
        self.status = GoalStatus.UNKNOWN
        self.accepted_at: int | None = None
        self.acceptance: asyncio.Task[None] | None = None
        self.servers: Servers = frozenset()
        self.asked = False
        self.outcome: Outcome | None = None
        self.answered = asyncio.Event()
        self.settled = asyncio.Event()
        self.ended = asyncio.Event()
        self.ending: asyncio.Task[None] | None = None
        self.detached = False
        self.is_followed = True
        self.plan = ResultPlan()
        self._make_closed: Callable[[], Exception] | None = None
        self._readers: dict[FeedbackQueue, None] = {}

    @property
    def is_accepted(self) -> bool:
        """Whether the server is known to have it."""
        return self.status is not GoalStatus.UNKNOWN

    @property
    def is_answered(self) -> bool:
        """Whether the server has answered to it, so that it knows the goal or never will."""
        acceptance = self.acceptance
        if self.is_accepted or acceptance is None:
            return True
        # If it was cancelled, the answer may be on its way.
        return acceptance.done() and not acceptance.cancelled()

    @property
    def has_readers(self) -> bool:
        """Whether a handle follows the goal."""
        return bool(self._readers)

    def join(self, reader: FeedbackQueue) -> None:
        """Pass the feedback to one more handle."""
        self._readers[reader] = None

    def leave(self, reader: FeedbackQueue) -> None:
        """Pass no more feedback to a handle; idempotent."""
        self._readers.pop(reader, None)
        reader.close()

    def put_feedback(self, serialized: bytes) -> None:
        """Pass a feedback message to every handle."""
        for reader in self._readers:
            reader.put(serialized)

    def update(self, status: GoalStatus) -> None:
        """Set the status, unless the goal is known to be further than that."""
        if status > self.status and self.status not in TERMINAL:
            if status is GoalStatus.CANCELING and self.trace is not None:
                self.trace.enter("canceling")
            self.status = status

    def show(self, status: GoalStatus, now: float) -> None:
        """Set the status that the server shows, at this loop time."""
        if not self.is_accepted:
            self.plan.accepted(now)
        self.update(status)
        if status in TERMINAL:
            self.plan.ended(now)

    def settle(self, outcome: Outcome) -> None:
        """Set the outcome, unless there is one."""
        if self.outcome is None:
            self.outcome = outcome
            self.status = outcome.status
            self.settled.set()
            self._wake()

    def close(self, make_error: Callable[[], Exception]) -> None:
        """Let the callers go with an error, because the session closes. The goal is still out."""
        self._make_closed = make_error
        self.answered.set()
        self._wake()

    def unfollow(self, make_error: Callable[[], Exception]) -> None:
        """Let those who wait for its end go with an error: nothing more is learnt of it."""
        self.is_followed = False
        self.close(make_error)

    def result(self) -> Outcome:
        """Return the outcome, once the goal has ended; raise the error of another end."""
        if self.outcome is None:
            assert self._make_closed is not None
            raise self._make_closed()
        return self.outcome

    def end_trace(self, error: BaseException | None) -> None:
        """End the trace, unless it has ended.

        Args:
            error: what the caller gets, if it is not the outcome.
        """
        trace, self.trace = self.trace, None
        if trace is None:
            return
        if self.outcome is not None and self.outcome.make_error is not None:
            error = self.outcome.make_error()
        outcome: TraceOutcome
        if self.status is GoalStatus.SUCCEEDED:
            outcome = "answered"
        elif self.status is GoalStatus.CANCELED or isinstance(error, asyncio.CancelledError):
            outcome = "cancelled"
        elif isinstance(error, TimeoutError):
            outcome = "timed out"
        else:
            outcome = "detached" if self.detached else "failed"
        trace.end(outcome, error)

    def _wake(self) -> None:
        self.ended.set()
        for reader in self._readers:
            reader.wake()


class FeedbackQueue:
    """The feedback of one goal that one handle has not read: the newest messages, serialized.

    Args:
        size: how many are kept.
        read: deserializes a message, or raises ValueError.

    Attributes:
        dropped: how many were dropped, because they were not read in time, or cannot be read.
        closed: whether no more messages come.
    """

    def __init__(self, size: int, read: Callable[[bytes], Any]) -> None:
        self.dropped = 0
        self.closed = False
        self._messages: deque[bytes] = deque(maxlen=size)
        self._read = read
        self._waiters: set[asyncio.Future[None]] = set()

    def put(self, serialized: bytes) -> None:
        """Add a message; the oldest is dropped if there are too many."""
        if len(self._messages) == self._messages.maxlen:
            self.dropped += 1
        self._messages.append(serialized)
        self.wake()

    def close(self) -> None:
        """Expect no more messages: the handle has left its goal. Those that are kept stay."""
        self.closed = True
        self.wake()

    def wake(self) -> None:
        """Wake the readers: there is a message, or there will be none."""
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)

    def take(self) -> Any:
        """Return the oldest message that can be read; None if there is none."""
        while self._messages:
            try:
                return self._read(self._messages.popleft())
            except ValueError:
                self.dropped += 1
        return None

    async def wait(self) -> None:
        """Wait until `wake` is called."""
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiters.add(waiter)
        try:
            await waiter
        finally:
            self._waiters.discard(waiter)
