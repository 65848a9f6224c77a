"""ActionServer: accepts goals, cancels them, and ends."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
from collections.abc import Callable
from copy import deepcopy
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias

from rosasync._actions.feedback import FeedbackSender
from rosasync._actions.goal_runner import (
    GoalErrorHook,
    GoalHandler,
    GoalRunner,
    OnBusy,
    check_on_busy,
)
from rosasync._actions.goal_table import GoalEvent, GoalRecord, GoalTable
from rosasync._actions.intake import CancelHook, CancelIntake, GoalHook, GoalIntake
from rosasync._actions.server_goal import ServerGoal
from rosasync._actions.server_goals import ServerGoals
from rosasync._core.aio import until_done
from rosasync._core.ports import PortDestroyed, TopicQos
from rosasync._server.handler_tasks import HandlerTasks
from rosasync.errors import ContextShutdown, SessionClosed, UsageError
from rosasync.options import check_count, check_hook, check_seconds, check_timeout
from rosasync.statistics import ActionServerStatistics, ServiceKey
from rosasync.tracing import ServerTracing
from rosasync.typing import FeedbackT, GoalT, ResultT

if TYPE_CHECKING:
    from rosasync._core.ports import Action, NodePort, PublisherPort
    from rosasync._server.server import ServiceServer
    from rosasync.tracing import Tracing

__all__ = ["ActionServer", "ServeService"]

logger = logging.getLogger("rosasync")

CLOSE_TIMEOUT = 5.0
"""Seconds to wait for cancelled handlers to end when a server is closed."""
CANCEL_TIMEOUT = 1.0
"""Seconds to wait for them if the server has ended at once."""

ServeService: TypeAlias = "Callable[..., ServiceServer[Any, Any]]"
"""Serves a service of the action: ``(srv_type, srv_name, handler)``."""


class ActionServer(Generic[GoalT, ResultT, FeedbackT]):
    """Serves an action in the loop; created by `Session.serve_action`, ends with the session.

    It accepts goals as soon as it is created. As an async context manager it is closed at the end
    of the block. Confined to the loop's thread, except for what `ServerGoal` says.
    """

    def __init__(
        self,
        node: NodePort,
        serve: ServeService,
        action: Action,
        handler: GoalHandler[GoalT, FeedbackT, ResultT],
        *,
        on_goal: GoalHook[GoalT] | None = None,
        on_cancel: CancelHook[GoalT, FeedbackT] | None = None,
        on_busy: OnBusy = "queue",
        concurrency: int = 1,
        backlog: int = 10,
        result_timeout: float | None = 900.0,
        on_error: GoalErrorHook[GoalT, FeedbackT, ResultT] | None = None,
        on_end: Callable[[ActionServer[GoalT, ResultT, FeedbackT]], object],
        tracing: Tracing,
        on_accepted: Callable[[ServerGoal[GoalT, FeedbackT]], object] | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._action = action
        self._on_end = on_end
        # For the stubs of `rosasync.testing`.
        self._on_accepted = on_accepted
        self._tasks = HandlerTasks()
        self._traces = ServerTracing(tracing, ServiceKey(action.name, action.type_name))
        self._feedback = FeedbackSender(
            self._publish_feedback_message,
            lambda: self._feedback_publisher,
            graph_events=node.graph_events,
        )
        self._goals = ServerGoals(
            action.name,
            GoalTable(
                math.inf
                if result_timeout is None
                else check_seconds("result_timeout", result_timeout)
            ),
            self._publish_status,
            self._feedback,
            action.action_type.Impl.GetResultService.Response,
        )
        self._runner = GoalRunner(
            action.name,
            handler,
            check_hook("on_error", on_error, "goal", "error"),
            on_busy=check_on_busy(on_busy),
            concurrency=check_count("concurrency", concurrency, 1),
            backlog=check_count("backlog", backlog, 0),
            make_result=self._make_result,
            goals=self._goals,
            tasks=self._tasks,
            traces=self._traces,
        )
        self._goal_intake = GoalIntake(
            action.name,
            check_hook("on_goal", on_goal, "request"),
            self._goals,
            self._runner,
            self._feedback,
            node.now,
            self._make_goal,
        )
        self._cancel_intake = CancelIntake(
            action.name, check_hook("on_cancel", on_cancel, "goal"), self._goals, self._runner
        )
        self._feedback_count = 0
        self._ending: Callable[[], Exception] | None = None
        self._closing = False
        self._end_task: asyncio.Task[None] | None = None
        self._services: list[ServiceServer[Any, Any]] = []
        self._publishers: list[PublisherPort] = []
        try:
            self._open(serve)
        except BaseException:
            self._destroy(functools.partial(SessionClosed, "the server could not be created"))
            raise

    def __repr__(self) -> str:
        counts = f"{self._runner.running} running, {self._runner.waiting} waiting"
        state = "closed" if self.closed else counts
        return f"<ActionServer {self.action_name} [{self.action_type}] {state}>"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()

    @property
    def action_name(self) -> str:
        """The resolved name of the action. Also available after the end."""
        return self._action.name

    @property
    def action_type(self) -> str:
        """The name of the action type."""
        return self._action.type_name

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, or its closing has begun. Never raises."""
        return self._closing

    def statistics(self) -> ActionServerStatistics:
        """Return a snapshot."""
        runner, goals = self._runner, self._goals
        return ActionServerStatistics(
            action_name=self.action_name,
            running=runner.running,
            waiting=runner.waiting,
            results=goals.kept,
            asking=goals.asking,
            accepted=self._goal_intake.accepted,
            rejected=self._goal_intake.rejected,
            succeeded=runner.counts[GoalEvent.SUCCEED],
            canceled=runner.counts[GoalEvent.CANCELED],
            aborted=runner.counts[GoalEvent.ABORT],
            feedback=self._feedback_count,
        )

    async def aclose(self, timeout: float | None = CLOSE_TIMEOUT) -> None:
        """End the server; idempotent, and not cut short by cancellation.

        It rejects further goals, cancels those that wait or run, and gives their handlers
        ``timeout`` seconds to end (None: without a limit). Each client that waits for a result gets
        it: CANCELED, or ABORTED if the handler still runs then. A client that was told of its
        acceptance within the last four seconds, and whose request for the result has not come yet,
        is waited for until these are over, unless no client is left. Then the server leaves the
        graph, and the results that it kept are gone.

        A handler may close its server, or its session, itself or in a task that it starts. It is
        then neither waited for nor cancelled, and its goal ends as ABORTED.

        Raises:
            UsageError: called from another loop or thread.
        """
        seconds = check_timeout(timeout, None)
        if asyncio._get_running_loop() is not self._loop:
            raise UsageError(
                f"{self.action_name}: a server can only be closed in the loop that serves it"
            )
        if self._ending is not None:
            await self._tasks.wait(self._loop.time() + CANCEL_TIMEOUT)
            return
        # First, because an eager task collects the handlers to wait for as it is created.
        self.exclude_caller()
        if self._end_task is None:
            self._end_task = self._loop.create_task(self._end(seconds))
        await until_done(self._end_task)

    def exclude_caller(self) -> None:
        """Exclude the calling handler from those that the end of the server waits for."""
        self._runner.exclude_caller()

    def on_graph(self) -> None:
        """End the server if something other than rosasync has destroyed one of its services.

        Otherwise look again which clients its feedback reaches. For the session, whenever the graph
        changes. On the loop's thread.
        """
        if not self._closing and any(service.closed for service in self._services):
            self.end(ContextShutdown)
        self._feedback.on_graph()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End at once; idempotent. Its goals have no end, and their handlers are cancelled.

        For the session. On the loop's thread, or on any if the loop is closed.
        """
        if self._ending is None:
            self._destroy(ending)
            if not self._loop.is_closed():
                self._tasks.cancel()
            self._on_end(self)

    # Opening.

    def _open(self, serve: ServeService) -> None:
        action, types = self._action, self._action.action_type.Impl
        self._feedback_publisher = self._open_publisher(
            types.FeedbackMessage, action.feedback_topic, TopicQos()
        )
        self._status = self._open_publisher(
            types.GoalStatusMessage, action.status_topic, TopicQos(depth=1, latched=True)
        )
        # Last `send_goal`: a goal is accepted once the rest is there.
        for service, handler in (
            (action.get_result, self._goals.on_get_result),
            (action.cancel_goal, self._cancel_intake),
            (action.send_goal, self._goal_intake),
        ):
            self._services.append(serve(service.srv_type, service.srv_name, handler))

    def _open_publisher(self, message_type: Any, topic_name: str, qos: TopicQos) -> PublisherPort:
        publisher = self._node.open_publisher(message_type, topic_name, qos)
        self._publishers.append(publisher)
        return publisher

    # What the parts call.

    def _make_goal(self, record: GoalRecord, request: Any) -> ServerGoal[Any, Any]:
        goal = ServerGoal[Any, Any](self, record, request, self._publish_feedback)
        if self._on_accepted is not None:
            self._on_accepted(goal)
        return goal

    def _make_result(self, value: Any) -> Any:
        """Make a result that does not change any more, of what a handler returned."""
        if value is None:
            raise TypeError(
                "the handler returned None instead of the result: end it with `return result`, a "
                "message or a mapping of its fields"
            )
        result = self._node.make_message(self._action.action_type.Result, value)
        # It is sent to every client that asks for it, and the handler may use its messages again.
        return deepcopy(result)

    def _publish_feedback(self, goal_id: bytes, value: Any) -> None:
        if self._ending is not None:
            raise self._ending()
        types = self._action.action_type
        message = types.Impl.FeedbackMessage()
        message.goal_id.uuid[:] = memoryview(goal_id)
        message.feedback = self._node.make_message(types.Feedback, value)
        if asyncio._get_running_loop() is self._loop:
            self._send_feedback(goal_id, message)
            return
        try:
            self._loop.call_soon_threadsafe(self._send_feedback, goal_id, deepcopy(message))
        except RuntimeError as error:
            raise SessionClosed(f"{self.action_name}: the event loop is closed") from error

    def _send_feedback(self, goal_id: bytes, message: Any) -> None:
        self._feedback_count += 1
        self._feedback.send(goal_id, message)

    def _publish_feedback_message(self, message: Any) -> None:
        self._publish(self._feedback_publisher, message)

    def _publish_status(self, message: bytes) -> None:
        self._publish(self._status, message)

    def _publish(self, publisher: PublisherPort, message: Any) -> None:
        if self._ending is None:
            try:
                publisher.publish(message)
            except PortDestroyed:
                self.end(ContextShutdown)

    # Ending.

    async def _end(self, timeout: float | None) -> None:
        deadline = None if timeout is None else self._loop.time() + timeout
        self._closing = self._goal_intake.closed = True
        self._runner.cancel_all()
        await self._tasks.wait(deadline)
        if self._tasks:
            logger.warning(
                "%s: %d handlers still run although they were cancelled, and are left behind: "
                "let CancelledError pass within %g s",
                self.action_name,
                len(self._tasks),
                timeout,
            )
        self._runner.abort_all()
        self._goals.flush()
        await self._feedback.wait()
        # An acceptance may wait to be sent again. Its client asks for the result afterwards.
        *others, send_goal = self._services
        last = self._loop.time() + CLOSE_TIMEOUT
        age = await send_goal.until_sent(CLOSE_TIMEOUT)
        await self._goals.until_asked(
            age, lambda: self._node.queries.count_clients(self._action.send_goal)
        )
        # Each waits until the clients have received its last responses.
        await asyncio.gather(
            *(service.aclose(CLOSE_TIMEOUT) for service in others),
            send_goal.aclose(max(0.0, last - self._loop.time())),
        )
        self.end(functools.partial(SessionClosed, f"{self.action_name}: the server is closed"))

    def _destroy(self, ending: Callable[[], Exception]) -> None:
        self._ending = ending
        self._closing = True
        self._goals.close()
        self._feedback.close()
        self._traces.close()
        for service in self._services:
            service.end(ending)
        for publisher in self._publishers:
            publisher.close()
