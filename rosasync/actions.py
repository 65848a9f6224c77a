"""Actions: goals that are never left behind, and servers for them. See `Session.act`."""

from __future__ import annotations

from rosasync._actions.goal import Goal
from rosasync._actions.proxy import ActionState, AsyncActionProxy
from rosasync._actions.server import ActionServer
from rosasync._actions.server_goal import ServerGoal
from rosasync._actions.status import GoalStatus
from rosasync.errors import (
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalError,
    GoalRejected,
    GoalTimeout,
)
from rosasync.statistics import ActionServerStatistics
from rosasync.typing import ActionType

__all__ = [
    "ActionServer",
    "ActionServerStatistics",
    "ActionState",
    "ActionType",
    "AsyncActionProxy",
    "CancelRejected",
    "Goal",
    "GoalAborted",
    "GoalCanceled",
    "GoalError",
    "GoalRejected",
    "GoalStatus",
    "GoalTimeout",
    "ServerGoal",
]
