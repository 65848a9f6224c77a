"""ActionClient: the goals of one action that are out, from their sending to their end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._actions.active_goal import ActiveGoal, FeedbackQueue, Outcome
from rosasync._actions.active_goals import ActiveGoals
from rosasync._actions.cancellation import Cancellations
from rosasync._actions.errors import GoalErrors
from rosasync._actions.result_plan import Due
from rosasync._actions.results import ResultRequests
from rosasync._actions.server_watch import ServerWatch
from rosasync._actions.status import TERMINAL, GoalStatus
from rosasync._actions.topics import ActionTopics
from rosasync._core.aio import start_task
from rosasync._core.text import count
from rosasync.errors import (
    CallError,
    ContextShutdown,
    GoalRejected,
    GoalTimeout,
    ServerGone,
    SessionClosed,
)

if TYPE_CHECKING:
    from rosasync._client.pool import ClientPool, LeasedClient
    from rosasync._core.ports import Action, NodePort
    from rosasync.tracing import Tracing

__all__ = ["ActionClient"]

GONE_DELAY = 0.1
"""Seconds to wait for the results that the last server sent just before it vanished."""


class Owner(Protocol):
    """The session, as far as an action's client needs it."""

    def check_open(self) -> None:
        """Raise the error that callers get, once the session has begun to close."""

    def on_shutdown(self) -> None:
        """End everything: the context was shut down."""


class ActionClient:
    """The goals of one action that are out, and the ports that they share.

    Confined to the loop's thread. However many goals there are, it has one subscription for
    feedback, one for statuses and one client for results. They stay for a while after the last
    goal, so that the next one need not be matched again. The session's pool sends and cancels
    goals.

    Attributes:
        action: the action.
        errors: makes the errors of its goals.
        goals: those that are out.
        cancel: asks the server to cancel a goal; see `Cancellations.cancel`.
    """

    def __init__(
        self, action: Action, node: NodePort, pool: ClientPool, tracing: Tracing, owner: Owner
    ) -> None:
        self.action = action
        self.errors = GoalErrors(action, node)
        self._loop = asyncio.get_running_loop()
        self._pool = pool
        self._tracing = tracing
        self._owner = owner
        self._types = action.action_type.Impl
        self.goals = ActiveGoals(self._on_due, self._close_ports)
        self._topics = ActionTopics(action, node, self.goals.find, self._on_status)
        self._results = ResultRequests(
            node, action.get_result, self._types.GetResultService.Request, self._on_result
        )
        self._watch = ServerWatch(action, node, pool, self.errors, (self._results, self._topics))
        self._cancellations = Cancellations(
            action,
            pool,
            tracing,
            self.errors,
            self._watch,
            self._on_status,
            self._let_go,
            owner.on_shutdown,
        )
        self.cancel = self._cancellations.cancel
        # Ends the goals whose servers have vanished.
        self._gone_timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<ActionClient {self.action.name} {count(len(self.goals), 'goal')}>"

    def make_queue(self, size: int) -> FeedbackQueue:
        """Return a queue for the feedback that one handle reads."""
        return FeedbackQueue(size, self._topics.read_feedback)

    # For the handles of goals.

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
            self._owner.check_open()
            if timeout == 0:
                raise self.timed_out(goal, 0.0)
            self._add(goal)
            await self._watch.reach(goal, deadline, wait)
            client, lease = await self._lease(deadline)
        except BaseException as error:
            # Nothing was sent.
            failure = self.errors.translate(goal, error, "the goal was not sent")
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
            goal.servers = await self._watch.find(goal, deadline, wait)
            self._owner.check_open()
        except BaseException as error:
            self._remove(goal)
            raise self.errors.translate(goal, error, "no server was found") from None
        self._ask(goal)

    def timed_out(self, goal: ActiveGoal, seconds: float) -> CallError:
        """Return the error for a goal whose deadline has passed: it says how far the goal got."""
        if goal.acceptance is None:
            with suppress(ContextShutdown):
                if not self._watch.exists():
                    return self.errors.unavailable(goal)
            reason = "no place in the window" if seconds else "no time was left for it"
            what = f"the goal was not sent within {seconds:.3g} s: {reason}"
        elif not goal.answered.is_set():
            what = f"the goal was sent, but not answered within {seconds:.3g} s; it is cancelled"
        else:
            what = f"the goal has not ended within {seconds:.3g} s; it is cancelled"
        return self.errors.goal(GoalTimeout, goal, what)

    def leave(self, goal: ActiveGoal, queue: FeedbackQueue, owns: bool) -> None:
        """Let a handle go; if it owns the goal, the goal is cancelled unless it was detached."""
        goal.leave(queue)
        if owns:
            self._cancellations.abandon(goal)
        if goal.detached and not goal.has_readers and goal.outcome is None:
            self._remove(goal)
            goal.end_trace(None)

    # For the session.

    def on_graph(self) -> None:
        """Look whether the servers of the goals that are out have vanished.

        Raises:
            ContextShutdown: the node is down.
        """
        self._watch.reset()
        self._expect_loss(self.goals)

    def close(self, make_error: Callable[[], Exception]) -> set[asyncio.Task[None]]:
        """Let every caller go with an error, because the session closes, and cancel the goals.

        Returns:
            The tasks that do it; none if there is no server.
        """
        for goal in self.goals:
            goal.close(make_error)
        tasks = {task for goal in self.goals if (task := self._cancellations.abandon(goal))}
        with suppress(ContextShutdown):
            if tasks and self._watch.exists():
                return tasks
        return set()

    def end(self, make_error: Callable[[], Exception]) -> None:
        """End every goal with an error, and destroy the ports; idempotent."""
        for goal in self.goals:
            self._settle(goal, Outcome(goal.status, make_error=make_error))
            if goal.acceptance is not None:
                goal.acceptance.cancel()
        self._cancellations.close()
        self._close_ports()

    # The goals that are out.

    def _add(self, goal: ActiveGoal) -> None:
        self._owner.check_open()
        self._results.open()
        self._topics.open()
        self.goals.add(goal)

    def _remove(self, goal: ActiveGoal) -> None:
        """Drop a goal, if it is out. If it has not ended, nothing more is learnt of it."""
        if self.goals.remove(goal):
            self._results.forget(goal.key)
            if not goal.ended.is_set():
                goal.unfollow(partial(self.errors.not_followed, goal))

    def _settle(self, goal: ActiveGoal, outcome: Outcome) -> None:
        goal.settle(outcome)
        goal.end_trace(None)
        self._remove(goal)

    def _fail(self, goal: ActiveGoal, error: Exception) -> None:
        self._settle(goal, Outcome(goal.status, make_error=lambda: error))
        if isinstance(error, ServerGone) and not goal.detached:
            # If only the network was cut, the server still has the goal when it is matched again.
            self._cancel_failed(goal)

    def _cancel_failed(self, goal: ActiveGoal) -> None:
        """Cancel a goal that has ended for its callers, but may run on a server."""
        other = ActiveGoal(goal.id, goal.started)
        with suppress(SessionClosed, ContextShutdown):
            self._add(other)
            self._accepted(other, None)
            self._cancellations.abandon(other)

    def _let_go(self, goal: ActiveGoal) -> None:
        """Forget a goal whose caller has left, and for which nothing is left to do."""
        if goal.acceptance is not None:
            goal.acceptance.cancel()
        if not goal.has_readers:
            self._remove(goal)
            goal.end_trace(None)

    def _on_status(self, goal: ActiveGoal, status: GoalStatus) -> None:
        """Note a status that the server shows."""
        goal.show(status, self._loop.time())
        if goal.acceptance is None and not goal.answered.is_set():
            # An attached goal: no response is awaited, and a new server may have it.
            self._accepted(goal, None)
        self.goals.reschedule(goal)

    def _on_due(self, goal: ActiveGoal, due: Due) -> None:
        """Do for a goal what its plan demands."""
        if due is Due.GIVE_UP:
            status = goal.status.name
            what = f"it ended as {status}, and the server does not send its result"
            self._fail(goal, self.errors.goal(GoalTimeout, goal, what))
        elif goal.asked:
            self._ask(goal)
        else:
            # A status has shown the acceptance, and the response was lost.
            self._accepted(goal, None)
            if goal.acceptance is not None:
                goal.acceptance.cancel()

    def _ask(self, goal: ActiveGoal, room: bool = False) -> None:
        self._results.ask(goal.key, room=room)
        goal.asked = True
        goal.plan.asked(self._loop.time())
        self.goals.reschedule(goal)

    def _close_ports(self) -> None:
        self.goals.stop_timer()
        if self._gone_timer is not None:
            self._gone_timer.cancel()
            self._gone_timer = None
        self._results.close()
        self._topics.close()
        self._watch.reset()

    # Their acceptance.

    async def _lease(self, deadline: float | None) -> tuple[LeasedClient[Any, Any], AsyncExitStack]:
        """Return a client that may send a goal, and what gives it back."""
        service = self.action.send_goal
        left = None if deadline is None else max(0.0, deadline - self._loop.time())
        async with AsyncExitStack() as stack:
            client = await stack.enter_async_context(
                self._pool.lease(service.srv_type, service.srv_name, timeout=left)
            )
            self._owner.check_open()
            return client, stack.pop_all()

    async def _send(
        self, goal: ActiveGoal, client: LeasedClient[Any, Any], message: Any, lease: AsyncExitStack
    ) -> None:
        """Send a goal and take its answer. A task of its own."""
        request = self._types.SendGoalService.Request(goal=message)
        request.goal_id.uuid = list(goal.key)
        with suppress(ContextShutdown):
            goal.servers = self._watch.servers_now()
        try:
            response = await client.call(request, timeout=None)
        except Exception as error:
            self._fail(goal, self.errors.translate(goal, error, "the goal was not answered"))
        else:
            if response.accepted:
                self._accepted(goal, response.stamp)
            else:
                what = "the server rejected the goal"
                self._fail(goal, self.errors.goal(GoalRejected, goal, what))
                if not self._watch.is_single():
                    # Another server of the name may have accepted it.
                    self._cancel_failed(goal)
        finally:
            goal.answered.set()
            await lease.aclose()

    async def _wait_for_acceptance(self, goal: ActiveGoal, deadline: float | None) -> None:
        try:
            if not goal.answered.is_set():
                async with asyncio.timeout_at(deadline):
                    await goal.answered.wait()
        except TimeoutError:
            error = self.timed_out(goal, self._loop.time() - goal.started)
            self._cancellations.abandon(goal)
            raise error from None
        except BaseException:
            self._cancellations.abandon(goal)
            raise
        if goal.outcome is not None and goal.outcome.make_error is not None:
            raise goal.outcome.make_error()
        if goal.ended.is_set() and goal.outcome is None:
            self._cancellations.abandon(goal)
            goal.result()

    def _accepted(self, goal: ActiveGoal, stamp: Any) -> None:
        """Follow a goal from its acceptance on; without a stamp if there is no response."""
        if stamp is not None:
            goal.accepted_at = stamp.sec * 1_000_000_000 + stamp.nanosec
        if not goal.asked:
            goal.update(GoalStatus.ACCEPTED)
            if goal.trace is not None:
                goal.trace.enter("accepted")
            self._ask(goal, room=stamp is not None)
        if stamp is None:
            # A status may come before the event of the graph that shows its server.
            self._watch.reset()
        with suppress(ContextShutdown):
            goal.servers |= self._watch.servers_now()
            self._expect_loss((goal,))
        goal.answered.set()

    # Their results, and what takes their place.

    def _on_result(self, key: bytes, response: Any) -> None:
        goal = self.goals.find(key)
        if goal is None:
            return
        if response.status == GoalStatus.UNKNOWN:
            self._on_unknown(goal)
        elif response.status in TERMINAL:
            # The feedback was sent before the result.
            self._topics.drain_feedback()
            self._settle(goal, Outcome(GoalStatus(response.status), response.result))

    def _on_unknown(self, goal: ActiveGoal) -> None:
        """Decide about a goal that a server does not know."""
        with suppress(ContextShutdown):
            if self._watch.has_lost(goal):
                what = "the server was replaced by one that does not know the goal"
                self._fail(goal, self.errors.server_gone(goal, what))
                return
        if self._watch.is_single():
            what = "the server does not know the goal: it was never accepted, or it has expired"
            self._fail(goal, self.errors.goal(GoalRejected, goal, what))
        # Otherwise another server of the name may know it.

    def _expect_loss(self, goals: Iterable[ActiveGoal]) -> None:
        """End those of the goals that are lost, unless their results arrive in a moment."""
        if self._gone_timer is None and any(map(self._watch.has_lost, goals)):
            self._gone_timer = self._loop.call_later(GONE_DELAY, self._end_lost)

    def _end_lost(self) -> None:
        self._gone_timer = None
        what = "every server vanished before the goal ended"
        try:
            for goal in filter(self._watch.has_lost, self.goals):
                self._fail(goal, self.errors.server_gone(goal, what))
        except ContextShutdown:
            self._owner.on_shutdown()
