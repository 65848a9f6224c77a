"""One client, and the calls it carries: sequence number → call → asyncio future."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rosasync.options import Limits, Retry

if TYPE_CHECKING:
    from rosasync.ports import ClientPort, Deliver

__all__ = ["Call", "Client", "Counts"]

NOT_SENT = 0
"""Is no sequence number: those of rcl begin with 1."""


@dataclass(slots=True)
class Counts:
    """What happened to the calls of one service, whichever client carried them."""

    in_flight: int = 0
    peak: int = 0
    created: int = 0
    completed: int = 0
    timed_out: int = 0
    cancelled: int = 0
    failed: int = 0
    late: int = 0
    retried: int = 0


class Call:
    """One request: in line for a client, sent with it, answered or given up.

    Confined to the loop's thread. From `start` to `end` it holds a place in the client's window;
    with a client that its caller leases (``leased``), the lease holds it.
    """

    __slots__ = (
        "_leased",
        "_resend",
        "_retry",
        "_sequence_number",
        "client",
        "future",
        "out",
        "request",
        "started",
    )

    client: Client
    _resend: _Resend
    _sequence_number: int

    def __init__(
        self, future: asyncio.Future[Any], request: Any, retry: Retry | None, leased: bool = False
    ) -> None:
        self.future = future
        self.request = request
        self.started = False
        self.out = False
        self._leased = leased
        self._retry = retry

    def start(self, client: Client) -> None:
        """Send the request; where that fails, the future is told."""
        self.client = client
        self.started = self.out = True
        counts = client.counts
        counts.in_flight += 1
        if counts.in_flight > counts.peak:
            counts.peak = counts.in_flight
        try:
            sequence_number = client.send(self.request)
        except Exception as error:
            self._retry = None
            self._sequence_number = NOT_SENT
            self.future.set_exception(error)
            return
        client.unanswered[sequence_number] = self
        self._sequence_number = sequence_number
        if self._retry is not None:
            self._resend = _Resend(self, client, self._retry, sequence_number)

    def end(self) -> None:
        """Give the place back: the response is there, or nobody waits for it any more."""
        self.out = False
        client = self.client
        client.counts.in_flight -= 1
        if self._retry is not None:
            self._resend.end()
            del self._resend  # which knows this call
        elif client.unanswered.pop(self._sequence_number, None) is not None:
            client.abandon(self._sequence_number)
        if not self._leased:
            client.leases -= 1
            client.on_room()


class Client:
    """A rcl client and the requests it carries. Confined to the loop's thread.

    ``unanswered`` are the calls that are out, by sequence number. ``leases`` counts those who may
    send; an abandoned request (nobody waits for it any more, but it is still in the server's queue)
    holds a place like a lease, until its late response arrives or the grace period is over.
    ``graph`` is the pool's: at which state of the ROS graph a server was last seen matched.
    """

    __slots__ = (
        "_abandoned",
        "_grace_timer",
        "_loop",
        "_port",
        "_window",
        "closed",
        "counts",
        "grace",
        "graph",
        "idle_since",
        "leases",
        "on_room",
        "send",
        "unanswered",
    )

    def __init__(
        self,
        open_port: Callable[[Deliver], ClientPort],
        limits: Limits,
        counts: Counts,
        on_room: Callable[[], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._window = limits.in_flight
        self.grace = limits.grace
        self.on_room = on_room
        self.unanswered: dict[int, Call] = {}
        self._abandoned: dict[int, float] = {}
        self._grace_timer: asyncio.TimerHandle | None = None
        self.counts = counts
        self.leases = 0
        self.graph = -1
        self.idle_since = self._loop.time()
        self.closed = False
        self._port = open_port(self._deliver)
        self.send = self._port.send

    def __repr__(self) -> str:
        state = "closed" if self.closed else "idle" if self.is_idle else "in use"
        return f"<Client {state}, {self.leases} leases, {self.abandoned} abandoned>"

    @property
    def abandoned(self) -> int:
        """Requests nobody waits for that still hold a place."""
        return len(self._abandoned)

    @property
    def room(self) -> int:
        """How many more leases fit into the window."""
        return self._window - self.leases - len(self._abandoned)

    @property
    def is_idle(self) -> bool:
        """Whether nobody leases it and nothing is in flight."""
        return not self.leases and not self._abandoned

    def ready(self) -> bool:
        """Tell whether a server is matched."""
        return self._port.ready()

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call that is out with an error, and forget what was abandoned."""
        for call in self.unanswered.values():
            if not call.future.done():
                call.future.set_exception(error())
        for sequence_number in (*self.unanswered, *self._abandoned):
            self._port.forget(sequence_number)
        self.unanswered.clear()
        if self._abandoned:
            self._abandoned.clear()
            self.on_room()

    def close(self) -> None:
        """Destroy the rcl client; idempotent. What is still out never ends: `fail` it first."""
        if self.closed:
            return
        self.closed = True
        if self._grace_timer is not None:
            self._grace_timer.cancel()
        self._abandoned.clear()
        self._port.close()

    def _deliver(self, sequence_number: int, response: Any) -> None:
        call = self.unanswered.pop(sequence_number, None)
        if call is not None:
            if call.future.done():
                self.counts.late += 1
            else:
                call.future.set_result(response)
            call.end()
            return
        self.counts.late += 1
        if self._abandoned.pop(sequence_number, None) is not None:
            self.on_room()

    def outrun(self, sequence_number: int) -> None:
        """Expect no response to a request that has left the server's queue, after a while."""
        self._loop.call_later(self.grace, self._port.forget, sequence_number)

    def abandon(self, sequence_number: int) -> None:
        """Let a request hold a place of its own that may still be in the server's queue."""
        if self.closed:
            return
        ends = self._loop.time() + self.grace
        self._abandoned[sequence_number] = ends
        if self._grace_timer is None:
            self._grace_timer = self._loop.call_at(ends, self._end_grace)

    def _end_grace(self) -> None:
        self._grace_timer = None
        now = self._loop.time()
        while self._abandoned:
            sequence_number, ends = next(iter(self._abandoned.items()))
            if ends > now:
                self._grace_timer = self._loop.call_at(ends, self._end_grace)
                break
            del self._abandoned[sequence_number]
            self._port.forget(sequence_number)
        self.on_room()


class _Resend:
    """Sends one request again while it is unanswered."""

    __slots__ = ("_call", "_client", "_retry", "_sent", "_timer", "_wait")

    def __init__(self, call: Call, client: Client, retry: Retry, sequence_number: int) -> None:
        self._call = call
        self._client = client
        self._retry = retry
        self._sent = [sequence_number]
        self._wait = retry.after
        self._timer: asyncio.TimerHandle | None = None
        self._arm()

    def _arm(self) -> None:
        if len(self._sent) < self._retry.attempts:
            self._timer = self._call.future.get_loop().call_later(self._wait, self._fire)
            self._wait *= self._retry.backoff

    def _fire(self) -> None:
        future = self._call.future
        if future.done():
            return
        try:
            sequence_number = self._client.send(self._call.request)
        except Exception as error:
            future.set_exception(error)
            return
        self._client.unanswered[sequence_number] = self._call
        self._sent.append(sequence_number)
        self._client.counts.retried += 1
        self._arm()

    def end(self) -> None:
        """Withdraw the attempts that are still out.

        One queue leads to the server, and it keeps its order. So what was sent before an attempt
        that was answered has left that queue; only what was sent after it may still be there.
        """
        if self._timer is not None:
            self._timer.cancel()
        client = self._client
        answered = max((n for n in self._sent if n not in client.unanswered), default=-1)
        for sequence_number in self._sent:
            if client.unanswered.pop(sequence_number, None) is None:
                continue
            if sequence_number > answered:
                client.abandon(sequence_number)
            else:
                client.outrun(sequence_number)
