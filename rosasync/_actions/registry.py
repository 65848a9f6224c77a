"""Actions: the goals of a session, from their arguments to their end."""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any
from uuid import UUID, uuid4

from rosasync._actions.active_goal import ActiveGoal
from rosasync._actions.client import ActionClient
from rosasync._actions.goal import Goal, GoalBlock
from rosasync._core.text import count
from rosasync.errors import CallError
from rosasync.options import check_count, check_seconds, check_timeout, check_wait

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager

    from rosasync._client.graph_watch import GraphWatch
    from rosasync._client.pool import ClientPool
    from rosasync._core.ports import Action, NodePort
    from rosasync.tracing import Tracing
    from rosasync.typing import Timeout

__all__ = ["ActArguments", "Actions"]

logger = logging.getLogger("rosasync")

CLOSE_TIMEOUT = 5.0
"""Seconds for which the end of the session waits for the ends of the goals that it cancels."""
ACT_FEEDBACK = 1000
"""Feedback messages kept for ``on_feedback``, while it runs."""
CANCEL_TIMEOUT = 5.0
"""Seconds to wait for the end of a cancelled goal at the end of its block."""


@dataclass(frozen=True, slots=True)
class ActArguments:
    """The checked arguments of a goal.

    Attributes:
        action: the action.
        message: the goal message.
        accept_timeout: seconds until its acceptance, None for no deadline.
        wait: whether, or for how many seconds, to wait for a server.
    """

    action: Action
    message: Any
    accept_timeout: float | None
    wait: bool | float


class Actions:
    """The goals of a session. Confined to the loop's thread, except `describe` and `arguments`."""

    def __init__(
        self,
        node: NodePort,
        pool: ClientPool,
        graph_watch: GraphWatch,
        tracing: Tracing,
        timeout: float | None,
        on_shutdown: Callable[[], None],
    ) -> None:
        self.on_shutdown = on_shutdown
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._pool = pool
        self._graph_watch = graph_watch
        # The generation of the graph in which the servers of the goals were checked.
        self._checked_generation = graph_watch.generation
        graph_watch.add(self)
        self._tracing = tracing
        self._timeout = timeout
        self._closing: Callable[[], Exception] | None = None
        self._clients: dict[tuple[str, str], ActionClient] = {}
        # Needs no lock: each access is a single operation, which is atomic.
        self._known: dict[tuple[Any, str], Action] = {}

    @property
    def out(self) -> int:
        """How many goals are out."""
        return sum(len(client.goals) for client in self._clients.values())

    def check_open(self) -> None:
        """Raise the error that callers get, once the session has begun to close."""
        if self._closing is not None:
            raise self._closing()

    def describe(self, action_type: Any, action_name: str) -> Action:
        """Resolve an action; raises as `NodePort.describe_action`. From any thread."""
        try:
            return self._known[action_type, action_name]
        except (KeyError, TypeError):
            action = self._node.describe_action(action_type, action_name)
        self._known[action_type, action_name] = action
        return action

    def arguments(
        self,
        action_type: Any,
        action_name: str,
        goal: Any,
        accept_timeout: Timeout,
        wait: bool | float,
    ) -> ActArguments:
        """Check what every way to send a goal takes. From any thread.

        Raises:
            TypeError, ValueError: an argument does not fit.
        """
        action = self.describe(action_type, action_name)
        message = self._node.make_message(action.action_type.Goal, goal)
        seconds = check_timeout(accept_timeout, self._timeout, "accept_timeout")
        return ActArguments(action, message, seconds, check_wait(wait))

    async def act(
        self,
        arguments: ActArguments,
        timeout: float | None,
        on_feedback: Callable[[Any], Any] | None,
        on_accepted: Callable[[Goal[Any, Any]], object] | None = None,
    ) -> Any:
        """Send a goal and return its result; see `Session.act`.

        Args:
            arguments: those of the goal.
            timeout: seconds for all of it, None for no deadline.
            on_feedback: called with each feedback message.
            on_accepted: called with the goal when it is accepted.
        """
        goal = self._new_goal()
        feedback = 1 if on_feedback is None else ACT_FEEDBACK
        if timeout == 0:
            # Otherwise the goal would be sent, because `asyncio.timeout` acts only when this waits.
            arguments = replace(arguments, accept_timeout=0.0)
        try:
            async with asyncio.timeout(timeout) as deadline:
                async with self._pursue(arguments, goal, feedback, CANCEL_TIMEOUT) as handle:
                    if on_accepted is not None:
                        on_accepted(handle)
                    if on_feedback is not None:
                        await _pass_feedback(handle, on_feedback, arguments.action.name)
                    return await handle.result()
        except TimeoutError as error:
            if not deadline.expired() or isinstance(error, CallError):
                raise
            assert timeout is not None
            raise self.client(arguments.action).timed_out(goal, timeout) from None

    def goal(
        self,
        arguments: ActArguments,
        feedback: int,
        cancel_timeout: float,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]:
        """Return the context manager of a goal; see `Session.goal`."""
        feedback = check_count("feedback", feedback, 1)
        seconds = check_seconds("cancel_timeout", cancel_timeout)
        block = self._pursue(arguments, self._new_goal(), feedback, seconds)
        return GoalBlock(block, "session.goal")

    @asynccontextmanager
    async def _pursue(
        self, arguments: ActArguments, goal: ActiveGoal, feedback: int, cancel_timeout: float
    ) -> AsyncIterator[Goal[Any, Any]]:
        client = self.client(arguments.action)
        queue = client.make_queue(feedback)
        goal.started = self._loop.time()
        goal.join(queue)
        try:
            await client.send(goal, arguments.message, arguments.accept_timeout, arguments.wait)
        except BaseException:
            goal.leave(queue)
            raise
        cancelled = False
        try:
            yield Goal(client, goal, queue, self._timeout)
        except (asyncio.CancelledError, GeneratorExit):
            cancelled = True
            raise
        finally:
            client.leave(goal, queue, owns=True)
            if goal.ending is not None and not cancelled and not goal.ended.is_set():
                await asyncio.wait((goal.ending,), timeout=cancel_timeout)

    def attach(
        self,
        action_type: Any,
        action_name: str,
        goal_id: UUID,
        accept_timeout: Timeout,
        wait: bool | float,
        feedback: int,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]:
        """Return the context manager of a goal that runs already; see `Session.attach`."""
        if not isinstance(goal_id, UUID):
            hint = "such as goal.id, or uuid.UUID(text)"
            raise TypeError(f"goal_id must be a uuid.UUID, {hint}, not {type(goal_id).__name__}")
        if not goal_id.int:
            # In a request to cancel, it stands for every goal of the server.
            raise ValueError("goal_id has only zeros: that is no goal's id")
        arguments = self.arguments(action_type, action_name, None, accept_timeout, wait)
        block = self._follow(arguments, goal_id, check_count("feedback", feedback, 1))
        return GoalBlock(block, "session.attach")

    @asynccontextmanager
    async def _follow(
        self, arguments: ActArguments, goal_id: UUID, feedback: int
    ) -> AsyncIterator[Goal[Any, Any]]:
        client = self.client(arguments.action)
        queue = client.make_queue(feedback)
        goal = client.goals.find(goal_id.bytes)
        if goal is None:
            goal = ActiveGoal(goal_id, self._loop.time())
            goal.join(queue)
            await client.follow(goal, arguments.accept_timeout, arguments.wait)
        else:
            goal.join(queue)
        try:
            yield Goal(client, goal, queue, self._timeout)
        finally:
            client.leave(goal, queue, owns=False)

    def client(self, action: Action) -> ActionClient:
        """Return the client of an action, created at its first use.

        Raises:
            SessionClosed, ContextShutdown: the session has ended.
        """
        self.check_open()
        key = action.name, action.type_name
        client = self._clients.get(key)
        if client is None:
            client = ActionClient(action, self._node, self._pool, self._tracing, self)
            self._clients[key] = client
        return client

    # For the watch of the graph.

    @property
    def is_busy(self) -> bool:
        """Whether goals are out, so that the polling which their services have started goes on."""
        return self.out > 0

    @property
    def awaits_match(self) -> bool:
        """False: the services, and each `ServerWatch`, wait for the matches of a goal."""
        return False

    def on_graph(self) -> None:
        """Look whether the servers of the goals have vanished, if the graph may have changed.

        Raises:
            ContextShutdown: the node is down.
        """
        generation = self._graph_watch.generation
        if generation != self._checked_generation:
            self._checked_generation = generation
            for client in tuple(self._clients.values()):
                client.on_graph()

    # The end.

    def end(self, make_error: Callable[[], Exception]) -> None:
        """End every goal with an error; nothing can be cancelled any more. Idempotent."""
        self._closing = make_error
        for client in tuple(self._clients.values()):
            client.end(make_error)

    async def aclose(self, make_error: Callable[[], Exception]) -> None:
        """Let the callers go, and cancel what is out, except what is detached."""
        if self._closing is None:
            self._closing = make_error
        tasks: set[asyncio.Task[None]] = set()
        for client in tuple(self._clients.values()):
            tasks |= client.close(make_error)
        if tasks:
            await asyncio.wait(tasks, timeout=CLOSE_TIMEOUT)

    def _new_goal(self) -> ActiveGoal:
        return ActiveGoal(uuid4(), self._loop.time())


async def _pass_feedback(
    goal: Goal[Any, Any], on_feedback: Callable[[Any], Any], name: str
) -> None:
    """Call a function with each feedback message of a goal, until that has ended."""
    async for message in goal:
        returned = on_feedback(message)
        if returned is not None and inspect.isawaitable(returned):
            await returned
    if goal.feedback_dropped:
        logger.warning(
            "%s: %s of goal %s never reached on_feedback, which is too slow: let it return at once",
            name,
            count(goal.feedback_dropped, "feedback message"),
            goal.id,
        )
