"""The errors of an action's goals, and their messages."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, TypeVar

from rosasync._core.text import duration
from rosasync.errors import CallError, GoalError, ServerGone, ServiceUnavailable

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal
    from rosasync._core.ports import Action, NodePort

__all__ = ["GoalErrors"]

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

    def _call(self, kind: type[CallError], what: str, elapsed: float) -> CallError:
        name, type_name = self._action.name, self._action.type_name
        return kind(f"{name}: {what}", srv_name=name, srv_type=type_name, elapsed=elapsed)

    def _elapsed(self, goal: ActiveGoal) -> float:
        return self._loop.time() - goal.started
