"""Cancellations: cancels goals for their callers, and in the background those that were left."""

from __future__ import annotations

import asyncio
import enum
import logging
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from rosasync._actions.status import GoalStatus, uuid_of
from rosasync._core.aio import start_task
from rosasync.errors import CallError, CancelRejected, ContextShutdown, SessionClosed
from rosasync.options import Retry

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal
    from rosasync._actions.errors import GoalErrors
    from rosasync._actions.server_watch import ServerWatch
    from rosasync._client.pool import ClientPool
    from rosasync._core.ports import Action
    from rosasync.tracing import Tracing

__all__ = ["CancelAnswer", "Cancellations", "Step", "next_step"]

logger = logging.getLogger("rosasync")

END_TIMEOUT = 60.0
"""Seconds in which a goal whose caller has left has to be cancelled."""
CANCEL_TIMEOUT = 5.0
"""Seconds for one attempt to cancel such a goal."""
AGAIN_MIN = 0.1
"""Seconds between the first two such attempts. The intervals grow."""
AGAIN_MAX = 5.0
"""Maximum number of seconds between two such attempts."""
CANCEL_RETRY = Retry(attempts=3, after=1.0)
"""A goal may be cancelled twice."""


class CancelAnswer(enum.Enum):
    """What a server answers to a cancellation.

    Attributes:
        AGREED: it cancels the goal.
        REFUSED: it does not.
        UNKNOWN: it has no such goal, or not yet.
        ENDED: the goal has ended, or is being cancelled already.
    """

    AGREED = enum.auto()
    REFUSED = enum.auto()
    UNKNOWN = enum.auto()
    ENDED = enum.auto()


class Step(enum.Enum):
    """What follows an attempt to cancel a goal whose caller has left.

    Attributes:
        AWAIT_END: the server cancels it.
        RETRY: it may be there later.
        STOP: nothing is left to do.
    """

    AWAIT_END = enum.auto()
    RETRY = enum.auto()
    STOP = enum.auto()


def next_step(answer: CancelAnswer | None, *, canceling: bool, final: bool) -> Step:
    """Return what follows an attempt to cancel a goal whose caller has left.

    Args:
        answer: what the server answered; None if nothing, or if there was no server. It may come
            back, and the goal with it.
        canceling: whether the goal is known to be in cancellation.
        final: whether a goal that is unknown now stays so: it had been answered to before the
            attempt, and there is no second server.
    """
    if answer is CancelAnswer.AGREED or (answer is CancelAnswer.ENDED and canceling):
        return Step.AWAIT_END
    if answer is None or (answer is CancelAnswer.UNKNOWN and not final):
        return Step.RETRY
    return Step.STOP


class Cancellations:
    """Cancels the goals of one action. Confined to the loop's thread.

    Args:
        action: the action.
        pool: calls the service that cancels.
        tracing: the session's.
        errors: the errors of goals.
        watch: the action's servers.
        on_status: called with a goal and a status that an answer shows.
        on_left: called with a goal whose caller has left, when nothing is left to do for it.
        on_shutdown: called if the context was shut down.
    """

    def __init__(
        self,
        action: Action,
        pool: ClientPool,
        tracing: Tracing,
        errors: GoalErrors,
        watch: ServerWatch,
        on_status: Callable[[ActiveGoal, GoalStatus], None],
        on_left: Callable[[ActiveGoal], object],
        on_shutdown: Callable[[], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._action = action
        self._pool = pool
        self._tracing = tracing
        self._errors = errors
        self._watch = watch
        self._on_status = on_status
        self._on_left = on_left
        self._on_shutdown = on_shutdown
        self._tasks: set[asyncio.Task[None]] = set()

    async def cancel(self, goal: ActiveGoal, timeout: float | None) -> None:
        """Cancel a goal for its caller; see `Goal.cancel`."""
        # One that its block has left running may be cancelled nevertheless.
        if goal.ended.is_set() and goal.is_followed:
            goal.result()
            return
        if goal.status is GoalStatus.CANCELING:
            return
        try:
            answer = await self._request(goal, timeout)
        except CallError as error:
            raise self._errors.translate(goal, error, "the cancellation was not answered") from None
        if goal.outcome is None and answer in (CancelAnswer.REFUSED, CancelAnswer.UNKNOWN):
            knows = "refuses to cancel" if answer is CancelAnswer.REFUSED else "does not know"
            raise self._errors.goal(CancelRejected, goal, f"the server {knows} the goal")

    def abandon(self, goal: ActiveGoal) -> asyncio.Task[None] | None:
        """Cancel a goal in the background, because its caller has left; idempotent.

        Returns:
            The task that does it; None if the goal has ended or was never sent.
        """
        unsent = goal.acceptance is None and not goal.is_accepted
        if goal.outcome is not None or goal.detached or unsent:
            return None
        if goal.ending is None or goal.ending.done():
            # Done: the end of the loop cancels every task, and the session then closes.
            goal.ending = self._loop.create_task(self._end(goal))
            self._tasks.add(goal.ending)
            goal.ending.add_done_callback(self._tasks.discard)
        return goal.ending

    def close(self) -> None:
        """Stop what is done in the background; idempotent."""
        for task in self._tasks:
            task.cancel()

    async def _end(self, goal: ActiveGoal) -> None:
        """Cancel a goal and wait for its end, as long as that is of use."""
        try:
            async with asyncio.timeout(END_TIMEOUT):
                if await self._insist(goal):
                    await goal.settled.wait()
        except TimeoutError:
            self._warn(goal)
        except ContextShutdown:
            self._on_shutdown()
        except SessionClosed:
            pass
        self._on_left(goal)

    def _warn(self, goal: ActiveGoal) -> None:
        """Warn that a goal may run on, unless its server is gone as well."""
        with suppress(ContextShutdown):
            if goal.status is not GoalStatus.CANCELING and self._watch.exists():
                logger.warning(
                    "%s: goal %s, whose caller has left, could not be cancelled within %g s, and "
                    "may run on: look after the server",
                    self._action.name,
                    goal.id,
                    END_TIMEOUT,
                )

    async def _insist(self, goal: ActiveGoal) -> bool:
        """Cancel a goal by its UUID, at once, and again until that is settled.

        Returns:
            Whether the server has agreed.
        """
        delay = AGAIN_MIN
        while goal.outcome is None:
            answered = goal.is_answered
            try:
                answer = await self._request(goal, CANCEL_TIMEOUT)
            except CallError:
                answer = None
            step = next_step(
                answer,
                canceling=goal.status is GoalStatus.CANCELING,
                final=answered and self._watch.is_single(),
            )
            if answer is CancelAnswer.REFUSED:
                logger.warning(
                    "%s: the server refuses to cancel goal %s, whose caller has left: it runs on",
                    self._action.name,
                    goal.id,
                )
            if step is not Step.RETRY:
                return step is Step.AWAIT_END
            if goal.acceptance is None or goal.acceptance.done():
                await asyncio.sleep(delay)
            else:
                await asyncio.wait((goal.acceptance,), timeout=delay)
            delay = min(2 * delay, AGAIN_MAX)
        return False

    async def _request(self, goal: ActiveGoal, timeout: float | None) -> CancelAnswer:
        request = self._action.action_type.Impl.CancelGoalService.Request()
        request.goal_info.goal_id.uuid = list(goal.key)
        service = self._pool.service_of(self._action.cancel_goal)
        with self._tracing.muted():
            call = start_task(self._loop, service.call(request, timeout, True, CANCEL_RETRY))
        response = await call
        if any(uuid_of(info.goal_id) == goal.key for info in response.goals_canceling):
            self._on_status(goal, GoalStatus.CANCELING)
            return CancelAnswer.AGREED
        if response.return_code == response.ERROR_UNKNOWN_GOAL_ID:
            return CancelAnswer.UNKNOWN
        if response.return_code == response.ERROR_GOAL_TERMINATED:
            return CancelAnswer.ENDED
        return CancelAnswer.REFUSED
