"""The errors of an action's goals, and their messages."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, TypeVar

from rosasync._core.text import duration
from rosasync.errors import (
    CallError,
    ContextShutdown,
    GoalError,
    GoalTimeout,
    QueueTimeout,
    ServerGone,
    ServiceUnavailable,
    UsageError,
)

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal
    from rosasync._core.ports import Action, NodePort

__all__ = ["GoalErrors"]

ErrorT = TypeVar("ErrorT", bound=BaseException)
GoalErrorT = TypeVar("GoalErrorT", bound=GoalError)


class GoalErrors:
    """Makes the errors of one action's goals."""

    def __init__(self, action: Action, node: NodePort) -> None:
        self._loop = asyncio.get_running_loop()
        self._action = action
        self._node = node

    def goal(self, kind: type[GoalErrorT], goal: ActiveGoal, what: str) -> GoalErrorT:
        """Return an error of a goal."""
        return kind(
            f"{self._action.name}: {what} (goal {goal.id})",
            srv_name=self._action.name,
            srv_type=self._action.type_name,
            elapsed=self._elapsed(goal),
            goal_id=goal.id,
        )

    def unavailable(self, goal: ActiveGoal) -> CallError:
        """Return the error for a goal that found no server."""
        seen = self._node.queries.explain_missing(self._action.send_goal)
        # The graph shows the services of actions.
        seen = seen.replace("/_action/send_goal", "").replace("_SendGoal", "")
        elapsed = self._elapsed(goal)
        what = f"no action server for {self._action.type_name} after {duration(elapsed)}; {seen}"
        return self._call(ServiceUnavailable, what, elapsed)

    def server_gone(self, goal: ActiveGoal, what: str) -> CallError:
        """Return the error for a goal whose server has vanished."""
        return self._call(ServerGone, f"{what} (goal {goal.id})", self._elapsed(goal))

    def not_followed(self, goal: ActiveGoal) -> UsageError:
        """Return the error for a handle whose block has left a goal that had not ended."""
        return UsageError(
            f"{self._action.name}: goal {goal.id} is not followed any more, because its block was "
            "left before its end: await its result in the block, or follow it with "
            "`async with session.attach(…, goal.id)`"
        )

    def translate(self, goal: ActiveGoal, error: ErrorT, what: str) -> ErrorT | CallError:
        """Return the error of the action for an error of one of its services.

        Args:
            goal: the goal that the service was called for.
            error: the error; what is not of a service is returned as it is.
            what: what did not happen.
        """
        if not isinstance(error, CallError) or error.srv_name == self._action.name:
            return error
        if isinstance(error, ServiceUnavailable):
            with suppress(ContextShutdown):
                return self.unavailable(goal)
        if isinstance(error, ServerGone):
            return self.server_gone(goal, f"{what}: every server vanished")
        if isinstance(error, TimeoutError):
            reason = "no place in the window" if isinstance(error, QueueTimeout) else "no answer"
            what = f"{what} within {error.elapsed:.3g} s: {reason}"
            return self.goal(GoalTimeout, goal, what)
        return error

    def _call(self, kind: type[CallError], what: str, elapsed: float) -> CallError:
        name, type_name = self._action.name, self._action.type_name
        return kind(f"{name}: {what}", srv_name=name, srv_type=type_name, elapsed=elapsed)

    def _elapsed(self, goal: ActiveGoal) -> float:
        return self._loop.time() - goal.started
