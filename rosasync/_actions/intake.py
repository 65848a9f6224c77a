"""What an action server does with a request: to accept a goal, and to cancel goals."""

from __future__ import annotations

import inspect
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, TypeAlias

from rosasync._actions.goal_table import CancelCode, CancelSelection, GoalEvent, GoalRecord
from rosasync._actions.server_goal import ServerGoal
from rosasync.typing import FeedbackT, GoalT

if TYPE_CHECKING:
    from rosasync._actions.feedback import FeedbackSender
    from rosasync._actions.goal_runner import GoalRunner
    from rosasync._actions.server_goals import ServerGoals
    from rosasync._server.service_call import ServiceCall

__all__ = ["CancelHook", "CancelIntake", "GoalHook", "GoalIntake"]

logger = logging.getLogger("rosasync")

NANOSECONDS = 1_000_000_000

GoalHook: TypeAlias = Callable[[GoalT], bool | Awaitable[bool]]
"""``on_goal(request)``, plain or async, which decides on the acceptance."""
CancelHook: TypeAlias = Callable[[ServerGoal[GoalT, FeedbackT]], bool | Awaitable[bool]]
"""``on_cancel(goal)``, plain or async, which decides on a cancellation."""


class GoalIntake:
    """Accepts or rejects goals: the handler of the service ``send_goal``.

    Args:
        name: the action's name, for the log.
        on_goal: the hook that decides; None to accept.
        goals: the states of the goals.
        runner: runs what is accepted.
        feedback: publishes the feedback of what is accepted.
        now: returns the time of the node's clock, in ns.
        make_goal: makes what the handler gets, of a record and the goal's message.

    Attributes:
        accepted: how many goals were accepted.
        rejected: how many were not.
        closed: whether to reject every further goal.
    """

    def __init__(
        self,
        name: str,
        on_goal: GoalHook[Any] | None,
        goals: ServerGoals,
        runner: GoalRunner,
        feedback: FeedbackSender,
        now: Callable[[], int],
        make_goal: Callable[[GoalRecord, Any], ServerGoal[Any, Any]],
    ) -> None:
        self.accepted = 0
        self.rejected = 0
        self.closed = False
        self._name = name
        # For the warning of a handler that blocks the loop.
        self.__qualname__ = getattr(on_goal, "__qualname__", "of rosasync")
        self._on_goal = on_goal
        self._goals = goals
        self._runner = runner
        self._feedback = feedback
        self._now = now
        self._make_goal = make_goal
        # The ids of the goals that `on_goal` decides on.
        self._deciding: set[bytes] = set()

    def __call__(self, call: ServiceCall[Any, Any]) -> Awaitable[None] | None:
        """Answer a request, at once unless `on_goal` is async."""
        goal_id = call.request.goal_id.uuid.tobytes()
        if not self._may_accept(goal_id):
            self._reject(call)
        elif self._on_goal is None:
            self._accept(call, goal_id)
        else:
            return self._decide(call, goal_id, self._on_goal)
        return None

    def _may_accept(self, goal_id: bytes) -> bool:
        known = goal_id in self._deciding or self._goals.knows(goal_id)
        return not self.closed and not known and self._runner.has_room()

    async def _decide(
        self, call: ServiceCall[Any, Any], goal_id: bytes, on_goal: GoalHook[Any]
    ) -> None:
        self._deciding.add(goal_id)
        try:
            agreed = await _ask(on_goal, call.request.goal)
        except Exception:
            logger.exception("%s: on_goal raised an exception, so the goal is rejected", self._name)
            agreed = False
        finally:
            self._deciding.discard(goal_id)
        # There may be less room than before.
        if agreed and self._may_accept(goal_id):
            self._accept(call, goal_id)
        else:
            self._reject(call)

    def _reject(self, call: ServiceCall[Any, Any]) -> None:
        self.rejected += 1
        call.respond(call.response)

    def _accept(self, call: ServiceCall[Any, Any], goal_id: bytes) -> None:
        stamp = self._now()
        response = call.response
        response.accepted = True
        response.stamp.sec, response.stamp.nanosec = divmod(stamp, NANOSECONDS)
        # Before the handler starts: stock clients drop feedback that precedes the acceptance.
        call.respond(response)
        self.accepted += 1
        record = self._goals.accept(goal_id, stamp)
        self._feedback.accept(goal_id, call)
        self._runner.add(self._make_goal(record, call.request.goal), record)


class CancelIntake:
    """Cancels goals: the handler of the service ``cancel_goal``.

    Args:
        name: the action's name, for the log.
        on_cancel: the hook that decides for each goal; None to cancel it.
        goals: the states of the goals.
        runner: runs the goals.
    """

    def __init__(
        self,
        name: str,
        on_cancel: CancelHook[Any, Any] | None,
        goals: ServerGoals,
        runner: GoalRunner,
    ) -> None:
        self._name = name
        self._on_cancel = on_cancel
        self._goals = goals
        self._runner = runner

    def __call__(self, call: ServiceCall[Any, Any]) -> Awaitable[None] | None:
        """Answer a request, at once unless there is a hook to ask."""
        info = call.request.goal_info
        stamp = info.stamp.sec * NANOSECONDS + info.stamp.nanosec
        selection = self._goals.select(info.goal_id.uuid.tobytes(), stamp)
        if self._on_cancel is not None and selection.goals:
            return self._decide(call, selection, self._on_cancel)
        self._cancel(call, selection.code, selection.goals)
        return None

    async def _decide(
        self,
        call: ServiceCall[Any, Any],
        selection: CancelSelection,
        on_cancel: CancelHook[Any, Any],
    ) -> None:
        agreed = [record for record in selection.goals if await self._is_agreed(record, on_cancel)]
        code = selection.code if agreed else CancelCode.REJECTED
        self._cancel(call, code, agreed)

    async def _is_agreed(self, record: GoalRecord, on_cancel: CancelHook[Any, Any]) -> bool:
        goal = self._runner.goal(record.id)
        try:
            return goal is not None and await _ask(on_cancel, goal)
        except Exception:
            logger.exception(
                "%s: on_cancel raised an exception, so %r is not cancelled", self._name, goal
            )
            return False

    def _cancel(
        self, call: ServiceCall[Any, Any], code: CancelCode, records: list[GoalRecord]
    ) -> None:
        # A goal may have ended while the hook decided.
        cancelling = [
            record for record in records if self._goals.apply(record, GoalEvent.CANCEL_GOAL)
        ]
        response = call.response
        if records and not cancelling:
            code = CancelCode.GOAL_TERMINATED
        response.return_code = int(code)
        make_info = type(call.request.goal_info)
        for record in cancelling:
            info = make_info()
            info.goal_id.uuid[:] = memoryview(record.id)
            info.stamp.sec, info.stamp.nanosec = divmod(record.stamp, NANOSECONDS)
            response.goals_canceling.append(info)
        # First the answer: a goal that waits ends at once, and its result would overtake it.
        call.respond(response)
        for record in cancelling:
            self._runner.cancel(record.id)


async def _ask(hook: Callable[[Any], Any], argument: Any) -> bool:
    """Return what a hook decides.

    Raises:
        TypeError: it is not a bool.
        Exception: the hook raised it.
    """
    answer = hook(argument)
    if inspect.isawaitable(answer):
        answer = await answer
    if not isinstance(answer, bool):
        raise TypeError(f"{hook!r} must return True or False, not {type(answer).__name__}")
    return answer
