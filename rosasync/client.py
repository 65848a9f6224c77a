"""One client: sequence number → asyncio future."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rosasync.deadlines import Deadlines
from rosasync.limits import Limits, Retry

if TYPE_CHECKING:
    from rosasync.ros.ports import ClientPort, Deliver

__all__ = ["Client", "Counts"]


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


class Client:
    """A rcl client and the requests it carries. Confined to the loop's thread.

    ``leases`` counts those who may send; an abandoned request (nobody waits for it any more, but
    it is still in the server's queue) holds a place like a lease, until its late response arrives
    or the grace period is over. ``graph`` is the pool's: at which state of the ROS graph a server
    was last seen matched.
    """

    __slots__ = (
        "_abandoned",
        "_deadlines",
        "_grace_timer",
        "_loop",
        "_on_room",
        "_pending",
        "_port",
        "_window",
        "closed",
        "counts",
        "grace",
        "graph",
        "idle_since",
        "leases",
    )

    def __init__(
        self,
        open_port: Callable[[Deliver], ClientPort],
        limits: Limits,
        counts: Counts,
        on_room: Callable[[], None],
        deadlines: Deadlines,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._window = limits.in_flight
        self.grace = limits.grace
        self._on_room = on_room
        self._deadlines = deadlines
        self._pending: dict[int, asyncio.Future[Any]] = {}
        self._abandoned: dict[int, float] = {}
        self._grace_timer: asyncio.TimerHandle | None = None
        self.counts = counts
        self.leases = 0
        self.graph = -1
        self.idle_since = self._loop.time()
        self.closed = False
        self._port = open_port(self._deliver)

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

    async def call(
        self, request: Any, deadline: float | None = None, retry: Retry | None = None
    ) -> Any:
        """Send a request and wait for the response.

        Args:
            request: a message of the service's request type.
            deadline: in the loop's time, or None.
            retry: when to send again.

        Raises:
            Expired: the deadline passed.
            Exception: what `fail` was given while the request was out.
        """
        future: asyncio.Future[Any] = self._loop.create_future()
        pending = self._pending
        sequence_number = self._port.send(request)
        pending[sequence_number] = future
        counts = self.counts
        counts.in_flight += 1
        if counts.in_flight > counts.peak:
            counts.peak = counts.in_flight
        entry = None if deadline is None else self._deadlines.set(future, deadline)
        resend = None if retry is None else _Resend(self, request, future, retry, sequence_number)
        try:
            return await future
        except asyncio.CancelledError:
            # Answered, but its task was cancelled before it woke up.
            if not future.cancelled() and future.exception() is None:
                counts.late += 1
            raise
        finally:
            counts.in_flight -= 1
            if entry is not None:
                self._deadlines.met(entry)
            if resend is not None:
                resend.end()
            elif pending.pop(sequence_number, None) is not None:
                self._abandon(sequence_number)

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call that is out with an error, and forget what was abandoned."""
        for future in self._pending.values():
            if not future.done():
                future.set_exception(error())
        for sequence_number in (*self._pending, *self._abandoned):
            self._port.forget(sequence_number)
        self._pending.clear()
        if self._abandoned:
            self._abandoned.clear()
            self._on_room()

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
        future = self._pending.pop(sequence_number, None)
        if future is not None and not future.done():
            future.set_result(response)
            return
        self.counts.late += 1
        if self._abandoned.pop(sequence_number, None) is not None:
            self._on_room()

    def _send_again(self, request: Any, future: asyncio.Future[Any]) -> int:
        sequence_number = self._port.send(request)
        self._pending[sequence_number] = future
        self.counts.retried += 1
        return sequence_number

    def _withdraw(self, sequence_number: int, *, still_queued: bool) -> None:
        if self._pending.pop(sequence_number, None) is None:
            return
        if still_queued:
            self._abandon(sequence_number)
        else:
            self._loop.call_later(self.grace, self._port.forget, sequence_number)

    def _abandon(self, sequence_number: int) -> None:
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
        self._on_room()


class _Resend:
    """Sends one request again while it is unanswered."""

    __slots__ = ("_client", "_future", "_request", "_retry", "_sent", "_timer", "_wait")

    def __init__(
        self,
        client: Client,
        request: Any,
        future: asyncio.Future[Any],
        retry: Retry,
        sequence_number: int,
    ) -> None:
        self._client = client
        self._request = request
        self._future = future
        self._retry = retry
        self._sent = [sequence_number]
        self._wait = retry.after
        self._timer: asyncio.TimerHandle | None = None
        self._arm()

    def _arm(self) -> None:
        if len(self._sent) < self._retry.attempts:
            self._timer = self._future.get_loop().call_later(self._wait, self._fire)
            self._wait *= self._retry.backoff

    def _fire(self) -> None:
        if self._future.done():
            return
        try:
            self._sent.append(self._client._send_again(self._request, self._future))
        except Exception as error:
            self._future.set_exception(error)
            return
        self._arm()

    def end(self) -> None:
        """Withdraw the attempts that are still out.

        One queue leads to the server, and it keeps its order. So what was sent before an attempt
        that was answered has left that queue; only what was sent after it may still be there.
        """
        if self._timer is not None:
            self._timer.cancel()
        answered = max((n for n in self._sent if n not in self._client._pending), default=-1)
        for sequence_number in self._sent:
            self._client._withdraw(sequence_number, still_queued=sequence_number > answered)
