"""One client, and the calls it carries: sequence number → call → asyncio future."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync.call import Call
    from rosasync.options import Limits
    from rosasync.ports import ClientPort, Deliver

__all__ = ["Client", "Counts"]


@dataclass(slots=True)
class Counts:
    """The running totals of one service, over all its clients."""

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
    """An rcl client, its window, and the requests it carries. Confined to the loop's thread.

    An abandoned request has no caller any more, but may still be in the server's queue. It takes a
    place in the window, as a lease does, until its late response arrives or the grace period ends.

    Attributes:
        unanswered: the calls in flight, by sequence number. Written by `Call` as well.
        leases: how many callers may send.
        matched_generation: the generation of the graph in which a server was last seen matched.
            Written by the `ServicePool`.
        idle_since: the loop time at which the last lease ended. Written by the `ClientSet` as well.
    """

    __slots__ = (
        "_abandoned",
        "_grace",
        "_grace_timer",
        "_loop",
        "_on_capacity",
        "_port",
        "_superseded",
        "_window",
        "closed",
        "counts",
        "idle_since",
        "leases",
        "matched_generation",
        "send",
        "unanswered",
    )

    def __init__(
        self,
        open_port: Callable[[Deliver], ClientPort],
        limits: Limits,
        counts: Counts,
        on_capacity: Callable[[], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._window = limits.in_flight
        self._grace = limits.grace
        self._on_capacity = on_capacity
        self.unanswered: dict[int, Call] = {}
        self._abandoned: dict[int, float] = {}
        # Requests that take no place, with the timers that end the wait for their late responses.
        self._superseded: dict[int, asyncio.TimerHandle] = {}
        # Runs from the first abandoned request to the end of the last grace period.
        self._grace_timer: asyncio.TimerHandle | None = None
        self.counts = counts
        self.leases = 0
        self.matched_generation = -1
        self.idle_since = self._loop.time()
        self.closed = False
        self._port = open_port(self._deliver)
        self.send = self._port.send

    def __repr__(self) -> str:
        state = "closed" if self.closed else "idle" if self.is_idle else "in use"
        return f"<Client {state}, {self.leases} leases, {self.abandoned} abandoned>"

    @property
    def abandoned(self) -> int:
        """The number of requests without a caller that still take a place."""
        return len(self._abandoned)

    @property
    def capacity(self) -> int:
        """How many more leases fit into the window; negative if leases wait for their place."""
        return self._window - self.leases - len(self._abandoned)

    @property
    def is_idle(self) -> bool:
        """Whether it has neither leases nor requests."""
        return not self.leases and not self._abandoned

    def ready(self) -> bool:
        """Return whether a server is matched; raises as `ClientPort.ready`."""
        return self._port.ready()

    def release(self) -> None:
        """End a lease."""
        self.leases -= 1
        if not self.leases:
            self.idle_since = self._loop.time()
        self._on_capacity()

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call in flight with an error, and forget the abandoned requests."""
        for call in self.unanswered.values():
            if not call.future.done():
                call.future.set_exception(error())
        for sequence_number in (*self.unanswered, *self._abandoned):
            self._port.forget(sequence_number)
        self.unanswered.clear()
        if self._abandoned:
            self._abandoned.clear()
            self._on_capacity()

    def close(self) -> None:
        """Destroy the rcl client; idempotent. `fail` it first, or its calls never end."""
        if self.closed:
            return
        self.closed = True
        if self._grace_timer is not None:
            self._grace_timer.cancel()
        for timer in self._superseded.values():
            timer.cancel()
        self._superseded.clear()
        self._abandoned.clear()
        self._port.close()

    def abandon(self, sequence_number: int) -> None:
        """Keep a place for a request that has lost its caller."""
        # The loop is closed if a task that was still pending is collected.
        if self.closed or self._loop.is_closed():
            return
        ends = self._loop.time() + self._grace
        self._abandoned[sequence_number] = ends
        if self._grace_timer is None:
            self._grace_timer = self._loop.call_at(ends, self._end_grace)

    def forget_later(self, sequence_number: int) -> None:
        """Expect a late response for the grace period, without keeping a place for it."""
        timer = self._loop.call_later(self._grace, self._forget, sequence_number)
        self._superseded[sequence_number] = timer

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
            self._on_capacity()
        elif (timer := self._superseded.pop(sequence_number, None)) is not None:
            timer.cancel()

    def _forget(self, sequence_number: int) -> None:
        del self._superseded[sequence_number]
        self._port.forget(sequence_number)

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
        self._on_capacity()
