"""StubActionServer: an action server of a test, with its answers, its faults, and its goals."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias
from uuid import UUID

from rosasync._actions.status import GoalStatus
from rosasync._core.text import count
from rosasync._ros.messages import make_message, to_dict
from rosasync._ros.types import action_type
from rosasync.errors import (
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    SessionClosed,
    UsageError,
)
from rosasync.options import check_hook, check_seconds
from rosasync.testing._arrivals import Arrivals
from rosasync.testing._faults import Faults, FaultyService, OpenService, StubCall, set_in_block
from rosasync.testing._matching import describe, explain_mismatch
from rosasync.testing._rules import Match, Rules
from rosasync.typing import FeedbackT, GoalT, ResultT

if TYPE_CHECKING:
    from rosasync._actions.server import ActionServer
    from rosasync._actions.server_goal import ServerGoal
    from rosasync._core.ports import DeliverRequest, Service, ServicePort

__all__ = ["STUB", "GoalAnswer", "StubActionServer", "StubGoal"]

GoalAnswer: TypeAlias = Any
"""The result of a goal, a message or a mapping of its fields; `GoalRejected` to reject it; an
exception that the handler raises, such as ``GoalAborted("blocked", result={…})``; or None to run
until it is cancelled."""

STUB = object()
"""The handler of an action server whose answers are given by `StubActionServer.answer`."""


@dataclass(frozen=True)
class _Plan:
    """How one goal ends, and what comes before."""

    answer: GoalAnswer
    feedback: tuple[Any, ...]
    delay: float

    @property
    def rejects(self) -> bool:
        answer = self.answer
        return isinstance(answer, GoalRejected) or answer is GoalRejected

    async def run(self, goal: ServerGoal[Any, Any]) -> Any:
        """Be the handler of a goal."""
        for message in self.feedback:
            await asyncio.sleep(self.delay)
            goal.feedback(message)
        await asyncio.sleep(self.delay)
        if self.answer is None:
            await asyncio.get_running_loop().create_future()
        if isinstance(self.answer, type | Exception):
            raise self.answer
        return self.answer


@dataclass(eq=False)
class StubGoal(Generic[GoalT, FeedbackT]):
    """A goal that a `StubActionServer` received.

    Attributes:
        request: the goal message.
        id: its id.
        accepted: the goal as its handler gets it; None if it was not accepted.
    """

    request: GoalT
    id: UUID
    accepted: ServerGoal[GoalT, FeedbackT] | None = None

    @property
    def status(self) -> GoalStatus:
        """Its status; UNKNOWN if it was not accepted."""
        return GoalStatus.UNKNOWN if self.accepted is None else self.accepted.status


class StubActionServer(Generic[GoalT, ResultT, FeedbackT]):
    """An action server in a `Graph`; created by `Graph.serve_action` and `Graph.stub_action`.

    It is a `rosasync.ActionServer` on the graph's own node, in memory or on real ROS. Confined to
    the loop's thread.

    Attributes:
        goals: the goals received, in order, with those that were rejected.
        optional: whether a strict graph accepts that it never gets a goal.
    """

    def __init__(
        self,
        wanted: Any,
        action_name: str,
        handler: Any,
        options: Mapping[str, Any],
        optional: bool,
        open_server: Callable[..., ActionServer[GoalT, ResultT, FeedbackT]],
        on_unexpected: Callable[[str], None],
    ) -> None:
        self.goals: list[StubGoal[GoalT, FeedbackT]] = []
        self.optional = optional
        self._type = action_type(wanted)
        self._name = action_name
        self._options = dict(options)
        self._handler = handler
        if handler is STUB:
            self._handler = self._run
            self._options = {"concurrency": 100, "on_goal": self._is_accepted, **options}
        self._on_cancel = check_hook("on_cancel", self._options.pop("on_cancel", None), "goal")
        self._open_server = open_server
        self._rules = Rules[_Plan](self._type.Goal, on_unexpected)
        # What `_is_accepted` has decided on the goal that is accepted next, and on those that run.
        self._decided: _Plan | None = None
        self._plans: dict[UUID, _Plan] = {}
        self._refusing = False
        self._faults = Faults()
        self._result_faults = Faults()
        self._arrivals = Arrivals()
        self._server = self._open()

    def __repr__(self) -> str:
        state = "vanished" if self._server.closed else "up"
        return f"<StubActionServer {self.action_name} {state}, {count(len(self.goals), 'goal')}>"

    @property
    def action_name(self) -> str:
        """The resolved name of the action."""
        return self._server.action_name

    @property
    def server(self) -> ActionServer[GoalT, ResultT, FeedbackT]:
        """The server itself; another one after `come_back`."""
        return self._server

    @property
    def requests(self) -> list[dict[str, Any]]:
        """The fields of the goals received, in order, as plain values to compare."""
        return [to_dict(goal.request) for goal in self.goals]

    @property
    def lost_requests(self) -> int:
        """The number of requests that `drop_requests` lost, which are not in `goals`."""
        return self._faults.lost_requests

    # Answers.

    def answer(
        self,
        *answers: GoalAnswer,
        feedback: Iterable[Any] = (),
        delay: float = 0.0,
        match: Match[GoalT] = None,
    ) -> Self:
        """Answer goals of a server that `Graph.stub_action` created.

        ::

            drive.answer(GoalRejected, match={"distance": 100.0})
            drive.answer(GoalAborted("blocked", result={"driven": 1.0}), {"driven": 5.0})
            drive.answer({"driven": 5.0}, feedback=[{"driven": 1.0}, {"driven": 3.0}], delay=1.0)

        For each goal, the first rule that matches and has an answer left counts. If there is none,
        the goal is rejected, and a strict graph fails the test.

        Args:
            answers: a single one answers every goal, several are given in turn, once each. A
                result, a mapping of its fields, `GoalRejected` to reject the goal, another
                exception that the handler raises, or None to run until the goal is cancelled.
            feedback: the feedback of a goal, messages or mappings.
            delay: seconds before each feedback message, and before the end.
            match: which goals: a mapping of the fields that count, or a function of the goal's
                message.

        Raises:
            TypeError, ValueError: an answer or a field does not fit the action type.
            UsageError: the server has a handler.
        """
        if self._handler != self._run:
            raise UsageError(f"{self.action_name}: its handler answers: use stub_action for that")
        if isinstance(feedback, Mapping | self._type.Feedback):
            raise TypeError("feedback must be a list of messages or mappings, not a single one")
        self._rules.check(self.action_name, match, answers)
        messages = tuple(make_message(self._type.Feedback, message) for message in feedback)
        seconds = check_seconds("delay", delay)
        plans = [_Plan(self._prepare(answer), messages, seconds) for answer in answers]
        self._rules.add(match, plans)
        return self

    def refuse_cancellations(self) -> AbstractContextManager[None]:
        """Refuse to cancel any goal in this block."""
        return set_in_block(self, "_refusing", True)

    # Faults.

    def delay_responses(self, seconds: float) -> AbstractContextManager[None]:
        """Delay the answers to goals and cancellations by a number of seconds, in this block."""
        return set_in_block(self._faults, "delay", check_seconds("seconds", seconds))

    def drop_requests(self) -> AbstractContextManager[None]:
        """Lose every goal and cancellation that arrives in this block."""
        return set_in_block(self._faults, "dropping_requests", True)

    def drop_responses(self) -> AbstractContextManager[None]:
        """Lose every answer to a goal or a cancellation that is sent in this block."""
        return set_in_block(self._faults, "dropping_responses", True)

    def drop_results(self) -> AbstractContextManager[None]:
        """Lose every result that is sent in this block."""
        return set_in_block(self._result_faults, "dropping_responses", True)

    async def vanish(self) -> None:
        """Leave the graph with all goals, as a node that crashed; idempotent.

        The handlers are cancelled, and the clients learn nothing of the end of their goals.
        """
        self._server.end(_vanished)
        await self._server.aclose()

    async def come_back(self) -> None:
        """Enter the graph again, as a node that was restarted; does nothing if it is there."""
        if self._server.closed:
            self._server = self._open()

    # What it was asked.

    async def wait_for_goals(
        self, number: int = 1, timeout: float = 10.0
    ) -> list[StubGoal[GoalT, FeedbackT]]:
        """Wait until it has received a number of goals, and return them.

        Raises:
            AssertionError: it has not, after ``timeout`` seconds.
        """
        if not await self._arrivals.wait_for(number, self.goals, timeout):
            raise self._failure(f"expected {count(number, 'goal')} within {timeout:g} s")
        return self.goals[:number]

    def assert_goals(self, *expected: Mapping[str, Any]) -> None:
        """Check all goals, in order; of each, only the fields that are given count.

        Raises:
            AssertionError: they differ; the message shows where.
            ValueError: the goal has no such field.
        """
        __tracebackhide__ = True
        differences = explain_mismatch(self._type.Goal, expected, self.requests)
        if differences is not None:
            raise self._failure(f"expected {count(len(expected), 'goal')}", f"\n{differences}")

    def assert_statuses(self, *expected: GoalStatus) -> None:
        """Check the status of every goal, in order; UNKNOWN is that of a rejected one.

        Raises:
            AssertionError: they differ.
        """
        __tracebackhide__ = True
        statuses = [goal.status for goal in self.goals]
        if statuses != [*expected]:
            names = [status.name for status in statuses]
            wanted = ", ".join(GoalStatus(status).name for status in expected)
            raise self._failure(f"expected {wanted or 'no goal'}", f"\nthey are {', '.join(names)}")

    def _failure(self, expected: str, more: str = "") -> AssertionError:
        received = describe(self.requests, self.lost_requests, "goal")
        return AssertionError(f"{self.action_name}: {expected}, but {received}{more}")

    # Serving.

    def _open(self) -> ActionServer[GoalT, ResultT, FeedbackT]:
        return self._open_server(
            self._wrap,
            self._type,
            self._name,
            self._handler,
            on_cancel=self._may_cancel,
            on_accepted=self._accept,
            **self._options,
        )

    def _wrap(self, opener: OpenService, service: Service, deliver: DeliverRequest) -> ServicePort:
        of_results = service.srv_type is self._type.Impl.GetResultService
        sends_goals = service.srv_type is self._type.Impl.SendGoalService
        return FaultyService(
            opener,
            service,
            deliver,
            self._result_faults if of_results else self._faults,
            self._on_goal_request if sends_goals else _ignore,
        )

    def _on_goal_request(self, call: StubCall[Any, Any]) -> None:
        self.goals.append(StubGoal(call.request.goal, UUID(bytes=bytes(call.request.goal_id.uuid))))
        self._arrivals.notify()

    def _accept(self, accepted: ServerGoal[Any, Any]) -> None:
        next(goal for goal in reversed(self.goals) if goal.id == accepted.id).accepted = accepted
        if self._decided is not None:
            self._plans[accepted.id] = self._decided

    def _is_accepted(self, request: Any) -> bool:
        self._decided = self._rules.take(self.action_name, request)
        return self._decided is not None and not self._decided.rejects

    async def _run(self, goal: ServerGoal[Any, Any]) -> Any:
        return await self._plans.pop(goal.id).run(goal)

    async def _may_cancel(self, goal: ServerGoal[Any, Any]) -> bool:
        if self._refusing:
            return False
        if self._on_cancel is None:
            return True
        answer = self._on_cancel(goal)
        return answer if isinstance(answer, bool) else await answer

    def _prepare(self, answer: GoalAnswer) -> GoalAnswer:
        if answer is None or isinstance(answer, Exception):
            if isinstance(answer, GoalAborted | GoalCanceled) and answer.result is not None:
                make_message(self._type.Result, answer.result)
            return answer
        if isinstance(answer, type) and issubclass(answer, Exception):
            return answer
        return make_message(self._type.Result, answer)


def _vanished() -> SessionClosed:
    return SessionClosed("the server has vanished")


def _ignore(call: StubCall[Any, Any]) -> None:
    pass
