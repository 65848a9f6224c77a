"""ActionClient: the goals of one action, and the ports that they share."""

from __future__ import annotations

import asyncio
import enum
import logging
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rosasync._actions.active_goal import ActiveGoal, FeedbackQueue, Outcome
from rosasync._actions.errors import GoalErrors
from rosasync._actions.results import ResultRequests
from rosasync._actions.status import TERMINAL, GoalStatus, read_statuses, uuid_bytes, uuid_of
from rosasync._core.aio import start_task
from rosasync._core.ports import TopicQos
from rosasync._core.text import count
from rosasync.errors import (
    CallError,
    CancelRejected,
    ContextShutdown,
    GoalRejected,
    GoalTimeout,
    QueueTimeout,
    ServerGone,
    ServiceUnavailable,
    SessionClosed,
)
from rosasync.options import Retry

if TYPE_CHECKING:
    from rosasync._client.pool import ClientPool, LeasedClient
    from rosasync._core.ports import Action, NodePort, Servers, SubscriptionPort
    from rosasync.tracing import Tracing

__all__ = ["ActionClient", "CancelAnswer"]

logger = logging.getLogger("rosasync")

LINGER = 5.0
"""Seconds for which the ports stay after the last goal: the next one need not be matched again."""
TICK = 0.25
"""Seconds between two looks at the goals that are out, for what has no event."""
MATCH_TIMEOUT = 1.0
"""Seconds to wait until the topics are matched with a server that accepts goals already."""
POLL_MIN = 0.002
"""Seconds until the first look for these matches. The intervals grow."""
STATUS_PAUSE = 0.02
"""Seconds between two readings of the status topic: only the newest message counts."""
GONE_DELAY = 0.1
"""Seconds to wait for the results that the last server sent just before it vanished."""
LAST_ASK = 300.0
"""Maximum number of seconds between two requests for a result."""
ENDED_ASK = 0.5
"""Seconds after which it is asked for again, once the status topic has shown the goal's end."""
ENDED_PATIENCE = 30.0
"""Seconds to wait for the result of such a goal."""
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

ErrorT = TypeVar("ErrorT", bound=BaseException)

FEEDBACK_QOS = TopicQos(depth=1000)
STATUS_QOS = TopicQos(depth=1, latched=True)


class CancelAnswer(enum.Enum):
    """What a server answers to a cancellation."""

    AGREED = enum.auto()
    REFUSED = enum.auto()
    UNKNOWN = enum.auto()
    ENDED = enum.auto()


class Owner(Protocol):
    """The session, as far as an action's client needs it."""

    def check_open(self) -> None:
        """Raise the error that callers get, once the session has begun to close."""

    def on_shutdown(self) -> None:
        """End everything: the context was shut down."""


class ActionClient:
    """The goals of one action that are out, and the ports that they share.

    Confined to the loop's thread. However many goals there are, it has one subscription for
    feedback, one for statuses and one client for results. The session's pool sends and cancels
    goals.
    """

    def __init__(
        self, action: Action, node: NodePort, pool: ClientPool, tracing: Tracing, owner: Owner
    ) -> None:
        self.action = action
        self.errors = GoalErrors(action, node)
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._pool = pool
        self._tracing = tracing
        self._owner = owner
        self._types = action.action_type.Impl
        self._goals: dict[bytes, ActiveGoal] = {}
        # The background tasks that cancel goals.
        self._endings: set[asyncio.Task[None]] = set()
        self._results = ResultRequests(
            node, action.get_result, self._make_result_request, self._on_result
        )
        self._feedback: SubscriptionPort | None = None
        self._statuses: SubscriptionPort | None = None
        self._matched = False
        # The newest message of the status topic that was not read, and the timer that reads it.
        self._unread_status: bytes | None = None
        self._status_timer: asyncio.TimerHandle | None = None
        # Runs every TICK while goals are out, and once, LINGER after the last.
        self._timer: asyncio.TimerHandle | None = None
        self._idle_since = 0.0
        # The servers that the graph shows; None after it has changed.
        self._servers: Servers | None = None
        self._gone_timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<ActionClient {self.action.name} {count(len(self._goals), 'goal')}>"

    @property
    def goals(self) -> tuple[ActiveGoal, ...]:
        """The goals that are out."""
        return tuple(self._goals.values())

    def find(self, key: bytes) -> ActiveGoal | None:
        """Return the goal that is out under the bytes of a UUID."""
        return self._goals.get(key)

    def is_provided(self) -> bool:
        """Return whether the graph shows a server."""
        self._servers = None
        return bool(self._find_servers())

    def make_goal(self, goal: Any) -> Any:
        """Return the message to send, from a message, a mapping or None.

        Raises:
            TypeError, ValueError: it does not fit.
        """
        return self._node.make_message(self.action.action_type.Goal, goal)

    def make_queue(self, size: int) -> FeedbackQueue:
        """Return a queue for the feedback that one handle reads."""
        return FeedbackQueue(size, self._read_feedback)

    # Sending and following goals.

    async def send(
        self, goal: ActiveGoal, message: Any, timeout: float | None, wait: bool | float
    ) -> None:
        """Send a goal, and wait for its acceptance.

        If it raises, the goal was not sent, or has ended, or is being cancelled in the background.

        Args:
            goal: the goal, with its readers.
            message: the goal message.
            timeout: seconds until the acceptance, None for no deadline.
            wait: whether, or for how many seconds, to wait for a server.

        Raises:
            Exception: as `Session.goal`.
        """
        goal.trace = self._tracing.follow(self.action.name, self.action.type_name)
        deadline = None if timeout is None else goal.started + timeout
        try:
            self._add(goal)
            await self._reach_server(goal, deadline, wait)
            lease = self._pool.lease(
                self.action.send_goal.srv_type,
                self.action.send_goal.srv_name,
                timeout=self._left(deadline),
            )
            client = await lease.__aenter__()
            try:
                self._owner.check_open()
            except BaseException:
                await lease.__aexit__(None, None, None)
                raise
        except BaseException as error:
            # Nothing was sent.
            failure = self._translate(goal, error, "the goal was not sent")
            self._remove(goal)
            goal.end_trace(failure)
            raise failure from None
        if goal.trace is not None:
            goal.trace.enter("sent")
        with self._tracing.muted():
            # A task of its own: the acceptance is awaited, also if the caller leaves.
            goal.acceptance = start_task(self._loop, self._send(goal, client, message, lease))
        await self._wait_for_acceptance(goal, deadline)

    async def follow(self, goal: ActiveGoal, timeout: float | None, wait: bool | float) -> None:
        """Follow a goal that runs already.

        Args:
            goal: the goal, with its readers.
            timeout: seconds until a server is found, None for no deadline.
            wait: whether, or for how many seconds, to wait for a server.

        Raises:
            Exception: as `Session.attach`.
        """
        goal.detached = True
        deadline = None if timeout is None else goal.started + timeout
        try:
            self._add(goal)
            await self._reach_server(goal, deadline, wait)
            self._owner.check_open()
        except BaseException as error:
            self._remove(goal)
            raise self._translate(goal, error, "no server was found") from None
        goal.servers = self._find_servers()
        self._ask(goal)

    def timed_out(self, goal: ActiveGoal, seconds: float) -> CallError:
        """Return the error for a goal whose deadline has passed: it says how far the goal got."""
        if goal.acceptance is None:
            with suppress(ContextShutdown):
                if not self.is_provided():
                    return self.errors.unavailable(goal)
            what = f"the goal was not sent within {seconds:.3g} s: no place in the window"
        elif not goal.answered.is_set():
            what = f"the goal was sent, but not answered within {seconds:.3g} s; it is cancelled"
        else:
            what = f"the goal has not ended within {seconds:.3g} s; it is cancelled"
        return self.errors.goal(GoalTimeout, goal, what)

    def leave(self, goal: ActiveGoal, queue: FeedbackQueue, owns: bool) -> None:
        """Let a handle go; if it owns the goal, the goal is cancelled unless it was detached."""
        goal.leave(queue)
        if owns:
            self.abandon(goal)
        if goal.detached and not goal.has_readers and goal.outcome is None:
            self._remove(goal)
            goal.end_trace(None)

    # Cancelling goals.

    async def cancel(self, goal: ActiveGoal, timeout: float | None) -> None:
        """Cancel a goal for its caller; see `Goal.cancel`."""
        if goal.ended.is_set():
            goal.result()
            return
        if goal.status is GoalStatus.CANCELING:
            return
        try:
            answer = await self._request_cancel(goal, timeout)
        except CallError as error:
            raise self._translate(goal, error, "the cancellation was not answered") from None
        if goal.outcome is None and answer in (CancelAnswer.REFUSED, CancelAnswer.UNKNOWN):
            knows = "refuses to cancel" if answer is CancelAnswer.REFUSED else "does not know"
            raise self.errors.goal(CancelRejected, goal, f"the server {knows} the goal")

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
            goal.ending = self._loop.create_task(self._end_abandoned(goal))
            self._endings.add(goal.ending)
            goal.ending.add_done_callback(self._endings.discard)
        return goal.ending

    async def _end_abandoned(self, goal: ActiveGoal) -> None:
        try:
            async with asyncio.timeout(END_TIMEOUT):
                if await self._insist_on_cancel(goal):
                    await goal.settled.wait()
        except TimeoutError:
            if goal.status is not GoalStatus.CANCELING:
                logger.warning(
                    "%s: goal %s, whose caller has left, could not be cancelled within %g s, and "
                    "may run on: look after the server",
                    self.action.name,
                    goal.id,
                    END_TIMEOUT,
                )
        except ContextShutdown:
            self._owner.on_shutdown()
        except SessionClosed:
            pass
        if goal.acceptance is not None:
            goal.acceptance.cancel()
        if not goal.has_readers:
            self._remove(goal)
            goal.end_trace(None)

    async def _insist_on_cancel(self, goal: ActiveGoal) -> bool:
        """Cancel a goal by its UUID, at once and again after its acceptance.

        Returns:
            Whether the server has agreed.
        """
        delay = AGAIN_MIN
        while goal.outcome is None:
            answered = goal.is_answered
            try:
                answer = await self._request_cancel(goal, CANCEL_TIMEOUT)
            except CallError:
                # No answer, or no server; it may come back, and the goal with it.
                answer = None
            if answer is CancelAnswer.AGREED:
                return True
            if answer is CancelAnswer.ENDED:
                return goal.status is GoalStatus.CANCELING
            if answer is CancelAnswer.REFUSED:
                logger.warning(
                    "%s: the server refuses to cancel goal %s, whose caller has left: it runs on",
                    self.action.name,
                    goal.id,
                )
                return False
            if answer is CancelAnswer.UNKNOWN and answered and self._has_one_server():
                return False
            if goal.acceptance is None or goal.acceptance.done():
                await asyncio.sleep(delay)
            else:
                await asyncio.wait((goal.acceptance,), timeout=delay)
            delay = min(2 * delay, AGAIN_MAX)
        return False

    async def _request_cancel(self, goal: ActiveGoal, timeout: float | None) -> CancelAnswer:
        request = self._types.CancelGoalService.Request()
        request.goal_info.goal_id.uuid = list(goal.key)
        service = self._pool.service_of(self.action.cancel_goal)
        with self._tracing.muted():
            call = start_task(self._loop, service.call(request, timeout, True, CANCEL_RETRY))
        response = await call
        if any(uuid_of(info.goal_id) == goal.key for info in response.goals_canceling):
            goal.update(GoalStatus.CANCELING)
            return CancelAnswer.AGREED
        if response.return_code == response.ERROR_UNKNOWN_GOAL_ID:
            return CancelAnswer.UNKNOWN
        if response.return_code == response.ERROR_GOAL_TERMINATED:
            return CancelAnswer.ENDED
        return CancelAnswer.REFUSED

    # For the session.

    def on_graph(self) -> None:
        """Look whether the servers of the goals that are out have vanished.

        Raises:
            ContextShutdown: the node is down.
        """
        self._servers = None
        self._matched = False
        self._expect_loss(self.goals)

    def close_callers(self, make_error: Callable[[], Exception]) -> None:
        """Let every caller go with an error, because the session closes."""
        for goal in self.goals:
            goal.close(make_error)

    def end(self, make_error: Callable[[], Exception]) -> None:
        """End every goal with an error, and destroy the ports; idempotent."""
        for goal in self.goals:
            self._settle(goal, Outcome(goal.status, make_error=make_error))
            if goal.acceptance is not None:
                goal.acceptance.cancel()
        for task in self._endings:
            task.cancel()
        self._close_ports()

    # The goals that are out.

    def _add(self, goal: ActiveGoal) -> None:
        self._owner.check_open()
        self._results.open()
        if self._feedback is None:
            self._feedback = self._node.open_subscription(
                self._types.FeedbackMessage,
                self.action.feedback_topic,
                FEEDBACK_QOS,
                self._on_feedback,
                raw=True,
            )
        if self._statuses is None:
            self._statuses = self._node.open_subscription(
                self._types.GoalStatusMessage,
                self.action.status_topic,
                STATUS_QOS,
                self._on_status,
                raw=True,
            )
        idle = not self._goals
        self._goals[goal.key] = goal
        if idle:
            self._set_timer(TICK)

    def _remove(self, goal: ActiveGoal) -> None:
        """Drop a goal, if it is out."""
        if self._goals.pop(goal.key, None) is None:
            return
        self._results.forget(goal.key)
        if not self._goals:
            self._idle_since = self._loop.time()
            self._set_timer(LINGER)

    def _settle(self, goal: ActiveGoal, outcome: Outcome) -> None:
        goal.settle(outcome)
        goal.end_trace(None)
        self._remove(goal)

    def _set_timer(self, delay: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if not self._loop.is_closed():
            self._timer = self._loop.call_later(delay, self._tick)

    def _tick(self) -> None:
        self._timer = None
        if not self._goals:
            self._close_ports()
            return
        try:
            if not self._node.ok():
                raise ContextShutdown
            if not self._node.graph_events:
                self.on_graph()
        except ContextShutdown:
            self._owner.on_shutdown()
            return
        now = self._loop.time()
        for goal in self.goals:
            self._check(goal, now)
        if self._timer is None:
            self._set_timer(TICK)

    def _check(self, goal: ActiveGoal, now: float) -> None:
        """Do for a goal what time demands."""
        if goal.is_accepted and not goal.answered.is_set():
            # The status topic shows the acceptance, and the response was lost.
            self._accepted(goal, None)
            if goal.acceptance is not None:
                goal.acceptance.cancel()
        elif goal.ended_at is not None and now - goal.ended_at > ENDED_PATIENCE:
            what = f"it ended as {goal.status.name}, and the server does not send its result"
            self._settle(
                goal,
                Outcome(goal.status, make_error=lambda: self.errors.goal(GoalTimeout, goal, what)),
            )
        elif now >= goal.ask_at:
            self._ask(goal)

    def _ask(self, goal: ActiveGoal, room: bool = False) -> None:
        """Ask for the result, now and again at growing intervals."""
        self._results.ask(goal.key, room=room)
        goal.asked = True
        goal.ask_at = self._loop.time() + goal.ask_delay
        goal.ask_delay = min(2 * goal.ask_delay, LAST_ASK)

    def _close_ports(self) -> None:
        for timer in (self._timer, self._status_timer, self._gone_timer):
            if timer is not None:
                timer.cancel()
        self._timer = self._status_timer = self._gone_timer = None
        self._unread_status = None
        self._results.close()
        for port in (self._feedback, self._statuses):
            if port is not None:
                port.close()
        self._feedback = self._statuses = None
        self._matched = False

    # Reaching a server.

    async def _reach_server(
        self, goal: ActiveGoal, deadline: float | None, wait: bool | float
    ) -> None:
        """Wait for a server, and then, not for long, until every port is matched with it."""
        service = self._pool.service_of(self.action.send_goal)
        left = self._left(deadline)
        if wait is not True:
            limit = MATCH_TIMEOUT if wait is False else wait
            left = limit if left is None else min(limit, left)
            if wait is False and not self.is_provided():
                raise self.errors.unavailable(goal)
        if not service.match():
            await service.wait_for_server(left)
        limit = self._loop.time() + MATCH_TIMEOUT
        if deadline is not None:
            limit = min(limit, deadline)
        delay = POLL_MIN
        while not self._match() and self._loop.time() < limit:
            await asyncio.sleep(delay)
            delay *= 1.5

    def _match(self) -> bool:
        """Return whether the ports are matched, so that nothing sent by a server is lost."""
        if not self._matched:
            self._matched = (
                self._results.ready()
                and self._pool.service_of(self.action.cancel_goal).match()
                and self._feedback is not None
                and self._feedback.publishers() > 0
            )
        return self._matched

    async def _send(
        self, goal: ActiveGoal, client: LeasedClient[Any, Any], message: Any, lease: Any
    ) -> None:
        """Send a goal and take its answer. A task of its own."""
        request = self._types.SendGoalService.Request(goal=message)
        request.goal_id.uuid = list(goal.key)
        with suppress(ContextShutdown):
            goal.servers = self._find_servers_now()
        try:
            response = await client.call(request, timeout=None)
        except Exception as error:
            failure = self._translate(goal, error, "the goal was not answered")
            self._settle(goal, Outcome(goal.status, make_error=lambda: failure))
        else:
            if response.accepted:
                self._accepted(goal, response.stamp)
            else:
                self._rejected(goal)
        finally:
            goal.answered.set()
            await lease.__aexit__(None, None, None)

    async def _wait_for_acceptance(self, goal: ActiveGoal, deadline: float | None) -> None:
        try:
            if not goal.answered.is_set():
                async with asyncio.timeout_at(deadline):
                    await goal.answered.wait()
        except TimeoutError:
            self.abandon(goal)
            elapsed = self._loop.time() - goal.started
            what = f"the goal was sent, but not answered within {elapsed:.3g} s; it is cancelled"
            raise self.errors.goal(GoalTimeout, goal, what) from None
        except BaseException:
            self.abandon(goal)
            raise
        if goal.outcome is not None and goal.outcome.make_error is not None:
            raise goal.outcome.make_error()
        if goal.ended.is_set() and goal.outcome is None:
            self.abandon(goal)
            goal.result()

    def _accepted(self, goal: ActiveGoal, stamp: Any) -> None:
        if stamp is not None:
            goal.accepted_at = stamp.sec * 1_000_000_000 + stamp.nanosec
        if not goal.asked:
            goal.update(GoalStatus.ACCEPTED)
            if goal.trace is not None:
                goal.trace.enter("accepted")
            self._ask(goal, room=stamp is not None)
            with suppress(ContextShutdown):
                goal.servers |= self._find_servers_now()
                self._expect_loss((goal,))
        goal.answered.set()

    def _rejected(self, goal: ActiveGoal) -> None:
        error = self.errors.goal(GoalRejected, goal, "the server rejected the goal")
        self._settle(goal, Outcome(GoalStatus.UNKNOWN, make_error=lambda: error))
        if not self._has_one_server():
            # Another server of the name may have accepted it.
            other = ActiveGoal(goal.id, goal.started)
            other.update(GoalStatus.ACCEPTED)
            self._add(other)
            self._ask(other)
            self.abandon(other)

    # What servers send.

    def _make_result_request(self, key: bytes) -> Any:
        request = self._types.GetResultService.Request()
        request.goal_id.uuid = list(key)
        return request

    def _on_result(self, key: bytes, response: Any) -> None:
        goal = self._goals.get(key)
        if goal is None:
            return
        if response.status == GoalStatus.UNKNOWN:
            self._on_unknown(goal)
        elif response.status in TERMINAL:
            if self._feedback is not None:
                # It was sent before the result.
                self._feedback.drain()
            self._settle(goal, Outcome(GoalStatus(response.status), response.result))

    def _on_unknown(self, goal: ActiveGoal) -> None:
        """Decide about a goal that a server does not know."""
        with suppress(ContextShutdown):
            if self._is_lost(goal):
                self._lose(goal, "the server was replaced by one that does not know the goal")
                return
        if self._has_one_server():
            what = "the server does not know the goal: it was never accepted, or it has expired"
            error = self.errors.goal(GoalRejected, goal, what)
            self._settle(goal, Outcome(goal.status, make_error=lambda: error))
        # Otherwise another server of the name may know it.

    def _on_feedback(self, serialized: bytes) -> None:
        goal = self._goals.get(uuid_bytes(serialized))
        if goal is not None:
            goal.put_feedback(serialized)

    def _read_feedback(self, serialized: bytes) -> Any:
        try:
            return self._node.deserialize(self._types.FeedbackMessage, serialized)
        except ValueError as error:
            logger.error("%s: a feedback message is dropped: %s", self.action.name, error)
            raise

    def _on_status(self, serialized: bytes) -> None:
        """Read a status message, at once or after a pause, in which a newer one may replace it."""
        self._unread_status = serialized
        if self._status_timer is None:
            self._read_status()
            self._status_timer = self._loop.call_later(STATUS_PAUSE, self._resume_status)

    def _resume_status(self) -> None:
        self._status_timer = None
        if self._unread_status is not None:
            self._on_status(self._unread_status)

    def _read_status(self) -> None:
        serialized, self._unread_status = self._unread_status, None
        assert serialized is not None
        statuses = read_statuses(serialized)
        if statuses is None:
            try:
                message = self._node.deserialize(self._types.GoalStatusMessage, serialized)
            except ValueError as error:
                logger.error("%s: a status message is dropped: %s", self.action.name, error)
                return
            statuses = ((uuid_of(s.goal_info.goal_id), s.status) for s in message.status_list)
        goals = self._goals
        for key, status in statuses:
            goal = goals.get(key)
            if goal is not None and 0 < status <= GoalStatus.ABORTED:
                self._update(goal, GoalStatus(status))

    def _update(self, goal: ActiveGoal, status: GoalStatus) -> None:
        goal.update(status)
        if status in TERMINAL and goal.ended_at is None:
            goal.ended_at = self._loop.time()
            goal.ask_delay = ENDED_ASK
            goal.ask_at = goal.ended_at + ENDED_ASK

    # Servers.

    def _find_servers(self) -> Servers:
        if self._servers is None:
            self._servers = self._node.queries.find_servers(self.action.get_result)
        return self._servers

    def _find_servers_now(self) -> Servers:
        """As `_find_servers`, but never from before a change that the graph has not reported."""
        if not self._node.graph_events:
            self._servers = None
        return self._find_servers()

    def _has_one_server(self) -> bool:
        with suppress(ContextShutdown):
            return len(self._find_servers()) <= 1
        return True

    def _is_lost(self, goal: ActiveGoal) -> bool:
        """Return whether every server that may have an accepted goal has vanished."""
        servers = goal.servers
        return goal.asked and bool(servers) and servers.isdisjoint(self._find_servers())

    def _expect_loss(self, goals: Iterable[ActiveGoal]) -> None:
        """End those of the goals that are lost, unless their results arrive in a moment."""
        if self._gone_timer is None and any(map(self._is_lost, goals)):
            self._gone_timer = self._loop.call_later(GONE_DELAY, self._end_lost)

    def _end_lost(self) -> None:
        self._gone_timer = None
        try:
            for goal in self.goals:
                if self._is_lost(goal):
                    self._lose(goal, "every server vanished before the goal ended")
        except ContextShutdown:
            self._owner.on_shutdown()

    def _lose(self, goal: ActiveGoal, what: str) -> None:
        error = self.errors.server_gone(goal, what)
        self._settle(goal, Outcome(goal.status, make_error=lambda: error))

    # Helpers.

    def _left(self, deadline: float | None) -> float | None:
        return None if deadline is None else max(0.0, deadline - self._loop.time())

    def _translate(self, goal: ActiveGoal, error: ErrorT, what: str) -> ErrorT | CallError:
        """Return the error of the action for one of its services."""
        if not isinstance(error, CallError) or error.srv_name == self.action.name:
            return error
        if isinstance(error, ServiceUnavailable):
            with suppress(ContextShutdown):
                return self.errors.unavailable(goal)
        if isinstance(error, ServerGone):
            return self.errors.server_gone(goal, f"{what}: every server vanished")
        if isinstance(error, TimeoutError):
            reason = "no place in the window" if isinstance(error, QueueTimeout) else "no answer"
            return self.errors.goal(
                GoalTimeout, goal, f"{what} within {error.elapsed:.3g} s: {reason}"
            )
        return error
