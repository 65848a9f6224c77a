"""GoalRunner: runs the goals of a server: how many at a time, and how their handlers end."""

from __future__ import annotations

import asyncio
import functools
import inspect
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from time import monotonic_ns
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from rosasync._actions.goal_table import GoalEvent, GoalRecord
from rosasync._actions.server_goal import ServerGoal
from rosasync._server.blocking import BlockingReport
from rosasync.errors import ContextShutdown, GoalAborted, GoalCanceled, SessionClosed
from rosasync.typing import FeedbackT, GoalT, ResultT

if TYPE_CHECKING:
    from rosasync._actions.server_goals import ServerGoals
    from rosasync._server.handler_tasks import HandlerTasks
    from rosasync.tracing import Outcome, ServerTrace, ServerTracing

__all__ = ["GoalErrorHook", "GoalHandler", "GoalRunner", "OnBusy", "check_handler", "check_on_busy"]

logger = logging.getLogger("rosasync")

OnBusy: TypeAlias = Literal["queue", "reject", "replace"]

GoalHandler: TypeAlias = Callable[
    [ServerGoal[GoalT, FeedbackT]], Awaitable[ResultT | Mapping[str, Any]]
]
"""``handler(goal)``, async, which returns the result."""

GoalErrorHook: TypeAlias = Callable[
    [ServerGoal[GoalT, FeedbackT], Exception],
    ResultT | Mapping[str, Any] | Awaitable[ResultT | Mapping[str, Any] | None] | None,
]
"""``on_error(goal, error)``, plain or async, which may return the result of the aborted goal."""


def check_handler(handler: object) -> str:
    """Return the name of a handler of goals.

    Raises:
        TypeError: it is not an async function of one argument.
    """
    function: Any = handler
    while isinstance(function, functools.partial):
        function = function.func
    if not callable(handler) or inspect.isclass(function):
        raise TypeError(f"a goal handler is a coroutine function, not {handler!r}")
    if not any(map(inspect.iscoroutinefunction, (function, type(function).__call__))):
        raise TypeError(
            f"a goal handler must be async, `async def handler(goal)`, and {handler!r} is not: it "
            "could not be cancelled. Do slow work in `await asyncio.to_thread(…)`"
        )
    try:
        inspect.signature(handler).bind(None)
    except TypeError:
        raise TypeError(
            f"a goal handler takes one argument, (goal): {handler!r} does not"
        ) from None
    return str(getattr(function, "__qualname__", type(function).__qualname__))


def check_on_busy(value: OnBusy) -> OnBusy:
    """Return ``on_busy``.

    Raises:
        ValueError: it is none of the three.
    """
    if value == "queue" or value == "reject" or value == "replace":
        return value
    raise ValueError(f"on_busy must be 'queue', 'reject' or 'replace', not {value!r}")


@dataclass(eq=False, slots=True)
class _Execution:
    """A goal that waits or runs.

    Attributes:
        goal: what the handler gets.
        record: its state.
        task: the task of its handler, once that has begun.
        closes: whether the handler closes the server, which then does not cancel it.
        trace: follows the goal, if something listens.
    """

    goal: ServerGoal[Any, Any]
    record: GoalRecord
    task: asyncio.Task[Any] | None = None
    closes: bool = False
    trace: ServerTrace | None = None


_OUTCOMES: dict[GoalEvent, Outcome] = {
    GoalEvent.SUCCEED: "answered",
    GoalEvent.CANCELED: "cancelled",
    GoalEvent.ABORT: "failed",
}

_current: ContextVar[_Execution | None] = ContextVar("current_goal", default=None)
"""The goal whose handler runs here. Tasks that a handler starts inherit it."""


class GoalRunner:
    """Runs the handler for each goal, up to ``concurrency`` at a time.

    Confined to the loop's thread.

    Args:
        name: the action's name, for the log.
        handler: the handler.
        on_error: the hook for handlers that failed.
        on_busy: what happens to a goal that comes while ``concurrency`` goals run.
        concurrency: how many goals run at a time.
        backlog: how many goals wait, if ``on_busy`` is ``"queue"``.
        make_result: makes a result of what a handler returned; raises TypeError and ValueError.
        goals: the states of the goals.
        tasks: the tasks of the handlers.
        traces: the traces of the goals.

    Attributes:
        counts: how many goals have ended, by event.
    """

    def __init__(
        self,
        name: str,
        handler: GoalHandler[Any, Any, Any],
        on_error: GoalErrorHook[Any, Any, Any] | None,
        *,
        on_busy: OnBusy,
        concurrency: int,
        backlog: int,
        make_result: Callable[[Any], Any],
        goals: ServerGoals,
        tasks: HandlerTasks,
        traces: ServerTracing,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._name = name
        self._handler = handler
        self._blocking = BlockingReport(name, check_handler(handler))
        self._on_error = on_error
        self._on_busy = on_busy
        self._concurrency = concurrency
        self._backlog = backlog
        self._make_result = make_result
        self._goals = goals
        self._tasks = tasks
        self._traces = traces
        # Both by the goals' ids, in the order of acceptance.
        self._running: dict[bytes, _Execution] = {}
        self._waiting: dict[bytes, _Execution] = {}
        self.counts = dict.fromkeys((GoalEvent.SUCCEED, GoalEvent.CANCELED, GoalEvent.ABORT), 0)

    @property
    def running(self) -> int:
        """The number of goals whose handlers run."""
        return len(self._running)

    @property
    def waiting(self) -> int:
        """The number of accepted goals whose handlers have not begun."""
        return len(self._waiting)

    def has_room(self) -> bool:
        """Return whether another goal may be accepted."""
        if self._on_busy == "replace" or len(self._running) < self._concurrency:
            return True
        return self._on_busy == "queue" and len(self._waiting) < self._backlog

    def goal(self, goal_id: bytes) -> ServerGoal[Any, Any] | None:
        """Return a goal that waits or runs; None if it has ended."""
        execution = self._waiting.get(goal_id) or self._running.get(goal_id)
        return None if execution is None else execution.goal

    def add(self, goal: ServerGoal[Any, Any], record: GoalRecord) -> None:
        """Run an accepted goal, now or when it is its turn."""
        if self._on_busy == "replace":
            self._replace()
        execution = _Execution(goal, record, trace=self._traces.start(monotonic_ns()))
        self._waiting[record.id] = execution
        self._start_waiting()
        if execution.trace is not None and record.id in self._waiting:
            execution.trace.enter("queued")

    def cancel(self, goal_id: bytes) -> None:
        """Cancel a goal whose status is CANCELING: end it if it waits, or its handler."""
        execution = self._waiting.get(goal_id) or self._running.get(goal_id)
        if execution is None:
            return
        if execution.trace is not None:
            execution.trace.enter("canceling")
        if self._waiting.pop(goal_id, None) is not None:
            self._end(execution, GoalEvent.CANCELED, None)
        else:
            # Not at once: a task that has not begun would end without running its handler.
            self._loop.call_soon(self._cancel_task, execution)

    def exclude_caller(self) -> None:
        """Exclude the goal whose handler calls this, or started the task that does, from ends."""
        self._tasks.exclude_caller()
        if (execution := _current.get()) is not None:
            execution.closes = True

    def cancel_all(self) -> None:
        """Cancel every goal that is not being cancelled."""
        # Those that wait first: otherwise one would start whenever another ends.
        for execution in (*self._waiting.values(), *self._running.values()):
            if not execution.closes:
                self._cancel(execution)

    def abort_all(self) -> None:
        """End every goal, whose handler may still run, as aborted."""
        for execution in tuple(self._running.values()):
            self._end(execution, GoalEvent.ABORT, None)

    def _replace(self) -> None:
        """Cancel the oldest goals, so that there is room for another."""
        active = [
            execution
            for execution in (*self._running.values(), *self._waiting.values())
            if execution.record.cancelable
        ]
        for execution in active[: len(active) - self._concurrency + 1]:
            self._cancel(execution)

    def _cancel(self, execution: _Execution) -> None:
        if self._goals.apply(execution.record, GoalEvent.CANCEL_GOAL):
            self.cancel(execution.record.id)

    def _cancel_task(self, execution: _Execution) -> None:
        if execution.task is not None:
            execution.task.cancel()

    def _start_waiting(self) -> None:
        while self._waiting and len(self._running) < self._concurrency:
            goal_id, execution = next(iter(self._waiting.items()))
            del self._waiting[goal_id]
            self._running[goal_id] = execution
            self._goals.apply(execution.record, GoalEvent.EXECUTE)
            trace = execution.trace
            if trace is not None:
                trace.enter("handling")
            self._tasks.spawn(
                self._run(execution),
                functools.partial(self._abandon, execution),
                None if trace is None else trace.context,
            )

    def _abandon(self, execution: _Execution) -> None:
        """End a goal whose task something has cancelled before it began."""
        del self._running[execution.record.id]
        self._end(execution, GoalEvent.ABORT, None)

    async def _run(self, execution: _Execution) -> None:
        execution.task = asyncio.current_task()
        _current.set(execution)
        try:
            event, result = await self._outcome(execution)
        finally:
            # Also if something ends the program. The task and its context would keep each other.
            _current.set(None)
            execution.task = None
            del self._running[execution.record.id]
        self._end(execution, event, result)
        self._start_waiting()

    async def _outcome(self, execution: _Execution) -> tuple[GoalEvent, Any]:
        """Run the handler of a goal; return how the goal ends, and its result."""
        goal = execution.goal
        try:
            result = self._make_result(await self._blocking.timed(self._handler(goal)))
        except asyncio.CancelledError:
            if goal.cancelling:
                return GoalEvent.CANCELED, None
            logger.error("%s: the handler of %r was cancelled by other code", self._name, goal)
            return GoalEvent.ABORT, None
        except Exception as error:
            if execution.trace is not None:
                execution.trace.fail(error)
            if goal.cancelling and isinstance(error, GoalCanceled):
                return GoalEvent.CANCELED, self._result_of(error)
            return GoalEvent.ABORT, await self._fail(goal, error)
        return GoalEvent.CANCELED if goal.cancelling else GoalEvent.SUCCEED, result

    async def _fail(self, goal: ServerGoal[Any, Any], error: Exception) -> Any:
        """Log what a handler raised, and return the result of its goal; None for an empty one."""
        if self._goals.closed and isinstance(error, SessionClosed | ContextShutdown):
            logger.warning("%s: the handler of %r outlasted the server", self._name, goal)
            return None
        # One that has a name was raised by a goal that the handler itself has sent.
        if isinstance(error, GoalAborted) and not error.srv_name:
            logger.warning("%s: the handler aborted %r: %s", self._name, goal, error)
            if (result := self._result_of(error)) is not None:
                return result
        else:
            logger.error(
                "%s: the handler of %r raised an exception", self._name, goal, exc_info=error
            )
        if self._on_error is None:
            return None
        try:
            result = self._on_error(goal, error)
            if inspect.isawaitable(result):
                result = await result
            return None if result is None else self._make_result(result)
        except asyncio.CancelledError:
            return None
        except Exception:
            logger.exception("%s: on_error raised an exception for %r", self._name, goal)
            return None

    def _result_of(self, error: GoalAborted | GoalCanceled) -> Any:
        """Return the result in an error; None if it has none, or that of another action."""
        try:
            return None if error.result is None else self._make_result(error.result)
        except (TypeError, ValueError):
            return None

    def _end(self, execution: _Execution, event: GoalEvent, result: Any) -> None:
        result = self._make_result({}) if result is None else result
        if not self._goals.end(execution.record, event, result):
            return
        self.counts[event] += 1
        if execution.trace is not None:
            execution.trace.end(_OUTCOMES[event])
