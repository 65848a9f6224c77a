"""One call: from the queue to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._client.call_errors import Refused
from rosasync._client.retry import Action
from rosasync._core.ports import PortDestroyed
from rosasync._status.wire import Outcome
from rosasync.errors import UsageError

if TYPE_CHECKING:
    from rosasync._client.client import Client
    from rosasync._client.retry import Plan
    from rosasync._client.sent import Sent
    from rosasync._status.wire import Report
    from rosasync.tracing import CallTrace

__all__ = ["Call", "CallOwner"]


class CallOwner(Protocol):
    """What a call needs to know of its service, and reports to it."""

    def make_response(self, value: object) -> Any:
        """Return the response in a value that `Retry.verify` has returned.

        Raises:
            TypeError, ValueError: it is neither a response nor a mapping of its fields.
        """

    def send_again(self, call: Call) -> None:
        """Send a call again as soon as there are a server and a place."""

    def drop(self, client: Client) -> None:
        """Remove a client that other code has destroyed."""


class Call:
    """One call: queued, sent, perhaps sent again, and ended. Confined to the loop's thread.

    Attributes:
        owner: its service.
        future: receives the response, or the error that the caller gets.
        request: the message.
        plan: decides when to send again; None if the request is sent only once.
        lease: the leased client whose place the call uses; None if it takes one of its own.
        deadline: the loop time at which the caller gives up; None for never.
        trace: follows the call, if something listens.
        is_cancelled: returns whether the call was cancelled in a way that its future does not show
            yet: the task of `Session.start` is cancelled before its first step, or another thread
            has cancelled. Nothing may be sent then.
        passed: the seconds until the server answers and the seconds that were left, when the call
            was passed over because it would have been answered too late; None if it was not.
        client: the client that sends it, set when it starts.
        newest: the newest attempt that is outstanding; None before it is sent, and while there is
            no server that has had it.
        earlier: the attempts before it that are outstanding.
        started: whether `start` was called.
        in_flight: whether it has started and not ended.
    """

    __slots__ = (
        "_fast",
        "_timer",
        "_verifying",
        "client",
        "deadline",
        "earlier",
        "future",
        "in_flight",
        "is_cancelled",
        "lease",
        "newest",
        "owner",
        "passed",
        "plan",
        "request",
        "started",
        "trace",
    )

    client: Client

    def __init__(
        self,
        owner: CallOwner,
        future: asyncio.Future[Any],
        request: Any,
        plan: Plan | None = None,
        lease: Client | None = None,
        trace: CallTrace | None = None,
        is_cancelled: Callable[[], bool] | None = None,
        deadline: float | None = None,
    ) -> None:
        self.owner = owner
        self.future = future
        self.request = request
        self.plan = plan
        self.lease = lease
        self.trace = trace
        self.is_cancelled = is_cancelled
        self.deadline = deadline
        self.passed: tuple[float, float] | None = None
        self.newest: Sent | None = None
        self.earlier: tuple[Sent, ...] = ()
        self.started = False
        self.in_flight = False
        # Started by each attempt except the last, for the next one. Stopped by the next attempt,
        # by the loss of the servers, and by the end of the call.
        self._timer: asyncio.TimerHandle | None = None
        # Runs `Retry.verify` before the next attempt. Cancelled by the end of the call.
        self._verifying: asyncio.Task[Any] | None = None
        # Whether the next attempt is due because later requests were answered.
        self._fast = False

    @property
    def gone(self) -> bool:
        """Whether nothing may be sent for the caller any more."""
        return self.future.done() or (self.is_cancelled is not None and self.is_cancelled())

    @property
    def repeats(self) -> bool:
        """Whether the next attempt goes to servers that have had one, be it dropped or not."""
        return self.plan is not None and self.plan.sent > 0

    def start(self, client: Client, now: float) -> None:
        """Send the request for the first time. If that fails, set the error on the future."""
        self.client = client
        self.started = self.in_flight = True
        client.calls += 1
        counts = client.counts
        counts.in_flight += 1
        if counts.in_flight > counts.peak:
            counts.peak = counts.in_flight
        try:
            # Before `begin`, because a send that fails is no attempt.
            self.newest = client.send(self, now)
        except Exception as error:
            self.fail_send(error)
            return
        counts.sent += 1
        if self.trace is not None:
            self.trace.enter("sent")
        if self.plan is not None:
            self.plan.begin()
            client.retried[self] = None
            self._wait(self.plan.next_delay())

    def send_again(self, now: float, overloaded: bool = False) -> None:
        """Send the next attempt, if the plan allows it. There has to be a place for it.

        Args:
            now: the loop time.
            overloaded: whether the service has callers that it cannot answer in time.
        """
        plan, client = self.plan, self.client
        assert plan is not None
        fast, self._fast = self._fast, False
        if plan.begin(overloaded) is not Action.SEND:
            self._wait(plan.refused_delay())
            return
        if self.newest is not None:
            # Before the send, which takes the place that this may give back.
            client.window.supersede(self.newest)
            self.earlier = (*self.earlier, self.newest)
        try:
            self.newest = client.send(self, now)
        except Exception as error:
            self.fail_send(error)
            return
        if self.trace is not None:
            self.trace.enter("sent again")
        client.counts.retried += 1
        client.counts.fast_retries += fast
        self._wait(plan.next_delay())

    def on_later_answer(self, number: int) -> None:
        """Record that a request of the client was answered; the third later one is decisive."""
        if self.plan is None or self.newest is None or number <= self.newest.number:
            return
        if self.plan.on_later_answer() is Action.SEND:
            self._fast = True
            self._send_again()

    def lose(self, lost: Sent, error: Callable[[], Exception]) -> None:
        """Record that no server has an attempt any more.

        If it was the last one, go to the next server if the plan allows it; otherwise set the
        error.
        """
        if self._drop(lost) or self.future.done():
            return
        if self.plan is None or self.plan.on_servers_lost() is Action.FAIL:
            self.future.set_exception(error())
            return
        self._wait(None)
        self._send_again()

    def refuse(self, refused: Sent, report: Report) -> None:
        """Record that the servers of an attempt have reported not to answer it.

        If it was the last one: a server that has closed is like one that is gone. A request that
        was dropped is sent again when it is due, if the plan has an attempt left. All else ends the
        call.
        """
        if report.outcome is Outcome.CLOSED:
            self.lose(refused, lambda: Refused(report))
            return
        if self._drop(refused) or self.future.done():
            return
        dropped = report.outcome is Outcome.DROPPED
        if not (dropped and self.plan is not None and self.plan.on_due() is Action.SEND):
            self.future.set_exception(Refused(report))

    def outstanding(self) -> list[Sent]:
        """Return the attempts that may still be answered, in the order of their sends."""
        sent = self.client.window.sent
        attempts = self.earlier if self.newest is None else (*self.earlier, self.newest)
        return [attempt for attempt in attempts if attempt.number in sent]

    def _drop(self, attempt: Sent) -> bool:
        """Forget an attempt, and return whether another is outstanding."""
        outstanding = [sent for sent in self.outstanding() if sent is not attempt]
        self.newest = outstanding[-1] if outstanding else None
        self.earlier = tuple(outstanding[:-1])
        return bool(outstanding)

    def end(self, now: float) -> None:
        """Return what the call holds. Called once, by the first of these:

        - its client, as it delivers the response: so the place is free before the caller's task
          runs, and an answered call holds nothing while that task waits for its turn;
        - the caller, as it leaves `ServicePool.call` in any other way: cancelled, timed out, or
          with the error that a lost server, a failed send or the end of the session has set.
        """
        self.in_flight = False
        client = self.client
        client.calls -= 1
        client.counts.in_flight -= 1
        if not client.calls:
            client.idle_since = now
        newest = self.newest
        if newest is not None and newest.number in client.window.sent:
            client.leave(newest, now)
        if self.plan is not None:
            for sent in self.earlier:
                if sent.number in client.window.sent:
                    client.leave(sent, now)
            self._wait(None)
            if self._verifying is not None:
                self._verifying.cancel()
            client.retried.pop(self, None)
        # Break the reference cycles.
        self.newest = None
        self.earlier = ()
        # Last, because the assignment looks at the places that were given back above. This is
        # `ClientOwner.on_places`, inlined because every call comes here.
        owner = client.owner
        if owner.queue or owner.passed or owner.resends or owner.leased:
            owner.schedule()

    def fail_send(self, error: Exception) -> None:
        """End the call with the error of a failed send."""
        if isinstance(error, PortDestroyed):
            self.owner.drop(self.client)
        if not self.future.done():
            self.future.set_exception(error)

    def _wait(self, delay: float | None) -> None:
        """Wait for the next attempt; None for none."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if delay is not None:
            self._timer = self.future.get_loop().call_later(delay, self._on_due)

    def _on_due(self) -> None:
        self._timer = None
        if not self.future.done() and self.plan is not None and self.plan.on_due() is Action.SEND:
            self._send_again()

    def _send_again(self) -> None:
        """Send the call again, after `Retry.verify` has found that it did not run."""
        assert self.plan is not None
        if self.plan.verify is None:
            self.owner.send_again(self)
        elif self._verifying is None:
            self._verifying = self.future.get_loop().create_task(_verify(self.plan.verify))
            self._verifying.add_done_callback(self._verified)

    def _verified(self, task: asyncio.Task[Any]) -> None:
        self._verifying = None
        if self.future.done():
            # Retrieved, so that asyncio does not log it: the call has ended meanwhile.
            _ = task.cancelled() or task.exception()
        elif task.cancelled():
            self.future.set_exception(UsageError("Retry.verify was cancelled"))
        elif (error := task.exception()) is not None:
            self.future.set_exception(error)
        elif (found := task.result()) is None:
            self.owner.send_again(self)
        else:
            self._answer(found)

    def _answer(self, found: object) -> None:
        """End the call with what `Retry.verify` has found."""
        try:
            self.future.set_result(self.owner.make_response(found))
        except (TypeError, ValueError) as error:
            self.future.set_exception(
                type(error)(f"Retry.verify returned no response: {error}; None sends it again")
            )


async def _verify(verify: Callable[[], Awaitable[Any]]) -> Any:
    return await verify()
