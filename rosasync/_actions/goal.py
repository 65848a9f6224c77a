"""Goal: the handle of a goal."""

from __future__ import annotations

import asyncio
from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, Any, Generic, NoReturn, Self
from uuid import UUID

from rosasync._actions.status import GoalStatus
from rosasync.errors import GoalAborted, GoalCanceled, GoalError, GoalTimeout, UsageError
from rosasync.options import check_timeout
from rosasync.typing import FeedbackT, ResultT, Timeout

if TYPE_CHECKING:
    from types import TracebackType

    from rosasync._actions.active_goal import ActiveGoal, FeedbackQueue, Outcome
    from rosasync._actions.client import ActionClient

__all__ = ["Goal", "GoalBlock"]


class Goal(Generic[ResultT, FeedbackT]):
    """A goal of an action. `Session.goal` and `Session.attach` make them.

    ::

        async with session.goal(Fibonacci, "/fibonacci", {"order": 8}) as goal:
            async for feedback in goal:
                print(feedback.sequence)
            result = await goal.result()

    Iterating yields the feedback and ends with the goal. Use a goal on the loop's thread.
    """

    __slots__ = ("_client", "_goal", "_loop", "_queue", "_timeout")

    def __init__(
        self, client: ActionClient, goal: ActiveGoal, queue: FeedbackQueue, timeout: float | None
    ) -> None:
        self._client = client
        self._goal = goal
        self._loop = asyncio.get_running_loop()
        self._queue = queue
        self._timeout = timeout

    def __repr__(self) -> str:
        return f"<Goal {self._client.action.name} {self.id} {self.status.name}>"

    @property
    def id(self) -> UUID:
        """The goal's identifier, chosen by the client before anything is sent."""
        return self._goal.id

    @property
    def status(self) -> GoalStatus:
        """The last status known. It may lag behind the server by a message."""
        return self._goal.status

    @property
    def accepted_at(self) -> int | None:
        """When the server accepted the goal, in ns of its clock; None for an attached goal."""
        return self._goal.accepted_at

    @property
    def done(self) -> bool:
        """Whether the goal has ended, so that `result` returns or raises at once."""
        return self._goal.ended.is_set() and self._goal.is_followed

    @property
    def feedback_dropped(self) -> int:
        """How many feedback messages were dropped, because they were not read in time."""
        return self._queue.dropped

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> FeedbackT:
        # A cancellation between two messages takes effect in `wait`.
        feedback: FeedbackT
        while (feedback := self._queue.take()) is None:
            if self._goal.ended.is_set() or self._queue.closed:
                raise StopAsyncIteration
            self._check_loop()
            await self._queue.wait()
        return feedback

    async def result(self, timeout: float | None = None) -> ResultT:
        """Wait until the goal has ended, and return its result. Any number of times and tasks.

        Args:
            timeout: seconds to wait, None for no deadline. The goal runs on when it passes.

        Raises:
            GoalAborted: the server gave up; ``error.result`` is what it sent.
            GoalCanceled: the goal was cancelled; ``error.result`` is what the server sent.
            GoalTimeout: the goal has not ended in time.
            ServerGone: the server vanished, or was replaced by one that does not know the goal.
            GoalRejected: an attached goal is not known to the server.
            UsageError: the block was left, and the goal, which was detached or attached, or which
                the server does not cancel, is not followed any more; called from another loop or
                thread.
            SessionClosed, ContextShutdown: the session has ended.
        """
        goal = self._goal
        seconds = check_timeout(timeout, None)
        self._check_loop()
        if not goal.ended.is_set():
            try:
                async with asyncio.timeout(seconds):
                    await goal.ended.wait()
            except TimeoutError:
                what = f"the goal has not ended within {seconds:.3g} s; it is {goal.status.name}"
                raise self._client.errors.goal(GoalTimeout, goal, what) from None
        outcome = goal.result()
        if outcome.make_error is not None:
            raise outcome.make_error()
        if outcome.status is GoalStatus.SUCCEEDED:
            result: ResultT = outcome.result
            return result
        raise self._failure(outcome)

    async def cancel(self, timeout: Timeout = ...) -> None:
        """Cancel the goal, and return when the server has agreed, or if the goal has ended.

        Then `result` raises `GoalCanceled`, or returns if the goal succeeds nevertheless.

        Args:
            timeout: seconds; None for no deadline; if left out, the session's.

        Raises:
            CancelRejected: the server refuses, or does not know the goal.
            GoalTimeout: it has not answered in time.
            ServiceUnavailable, ServerGone: there is no server, or no longer.
            SessionClosed, ContextShutdown: the session has ended.
            UsageError: called from another loop or thread.
        """
        self._check_loop()
        await self._client.cancel(self._goal, check_timeout(timeout, self._timeout))

    def detach(self) -> None:
        """Leave the goal running when the block is left, or the session closed; idempotent.

        Raises:
            UsageError: the block was left already, and the goal is being cancelled; called from
                another thread.
        """
        self._check_loop()
        if self._goal.ending is not None and self._goal.outcome is None:
            raise UsageError(
                f"{self._client.action.name}: the goal is being cancelled already: call detach() "
                "before the block ends"
            )
        self._goal.detached = True

    def _check_loop(self) -> None:
        if asyncio._get_running_loop() is not self._loop:
            raise UsageError(
                f"{self._client.action.name}: goal {self.id} belongs to the loop of its session: "
                "in another thread, use session.from_thread.act(…) or an AsyncActionProxy"
            )

    def _failure(self, outcome: Outcome) -> GoalError:
        canceled = outcome.status is GoalStatus.CANCELED
        what = "the goal was cancelled" if canceled else "the server aborted the goal"
        kind: type[GoalError] = GoalCanceled if canceled else GoalAborted
        error = self._client.errors.goal(kind, self._goal, what)
        error.result = outcome.result
        return error


class GoalBlock(AbstractAsyncContextManager["Goal[Any, Any]"]):
    """The block of a goal, to be entered once. It explains itself to those who use it as the goal.

    Args:
        block: enters and leaves the goal.
        method: the method that makes the block, for the errors.
    """

    def __init__(self, block: AbstractAsyncContextManager[Goal[Any, Any]], method: str) -> None:
        self._block = block
        self._method = method
        self._entered = False

    async def __aenter__(self) -> Goal[Any, Any]:
        if self._entered:
            raise UsageError(
                f"a block of {self._method}(…) is entered once: call {self._method}(…) again for "
                "another goal"
            )
        self._entered = True
        return await self._block.__aenter__()

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> bool | None:
        return await self._block.__aexit__(exc_type, exc, traceback)

    def __await__(self) -> NoReturn:
        raise TypeError(f"{self._method}(…) cannot be awaited: {self._hint}")

    def __aiter__(self) -> NoReturn:
        raise TypeError(f"{self._method}(…) has no feedback: {self._hint}")

    def __getattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"{self._method}(…) has no {name!r}: {self._hint}")

    @property
    def _hint(self) -> str:
        return f"it is entered, with `async with {self._method}(…) as goal:`, and the goal has that"
