"""One client, and the calls it carries: sequence number → call → asyncio future."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync.call import Call
    from rosasync.options import Limits
    from rosasync.ports import ClientPort, Deliver, Servers

__all__ = ["Client", "Counts"]


@dataclass(slots=True)
class Counts:
    """The counters of one service, over all its clients.

    Shared by `Call`, `Client`, `ClientSet` and `ServicePool`, which count what they see happen. All
    of them run on the loop's thread.
    """

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

    An abandoned request no longer has a caller, but may still be in the server's queue. It takes a
    place in the window, like a lease. The place is freed by its late response, by the response to a
    later request, or at the end of the grace period.

    Attributes:
        unanswered: the calls in flight, by sequence number. `Call` adds itself and its attempts.
        leases: the number of open leases. `ClientSet.lease` adds one, `release` ends one.
        matched_generation: the generation of the graph in which a server was last seen matched.
            Written by the `ClientSet`.
        idle_since: the loop time at which the last lease ended. Written by the `ClientSet` as well.
        servers: the servers that receive the requests sent now; None if they are not known yet.
            Reset by the `ClientSet` when the graph has changed.
        window: the number of places. Written by the `ClientSet`.
    """

    __slots__ = (
        "_abandoned",
        "_grace",
        "_grace_timer",
        "_loop",
        "_on_capacity",
        "_port",
        "_superseded",
        "closed",
        "counts",
        "idle_since",
        "leases",
        "matched_generation",
        "send",
        "servers",
        "unanswered",
        "window",
    )

    def __init__(
        self,
        open_port: Callable[[Deliver], ClientPort],
        limits: Limits,
        counts: Counts,
        on_capacity: Callable[[], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.window = limits.in_flight
        self._grace = limits.grace
        self._on_capacity = on_capacity
        self.unanswered: dict[int, Call] = {}
        # With the end of each grace period, and the servers that the graph showed at the send.
        self._abandoned: dict[int, tuple[float, Servers | None]] = {}
        # Requests that take no place, with the timers that end the wait for their late responses.
        self._superseded: dict[int, asyncio.TimerHandle] = {}
        # The first abandoned request starts it. It stops when no abandoned request is left.
        self._grace_timer: asyncio.TimerHandle | None = None
        self.counts = counts
        self.leases = 0
        self.matched_generation = -1
        self.servers: Servers | None = None
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
        """How many more leases fit into the window.

        It is negative while callers with leases wait for their places.
        """
        return self.window - self.leases - len(self._abandoned)

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

    def learn_servers(self, servers: Servers) -> None:
        """Set the servers of later requests, and of those whose servers are not known yet."""
        self.servers = servers
        for call in self.unanswered.values():
            if call.servers is None:
                call.servers = servers
        for number, (ends, known) in self._abandoned.items():
            if known is None:
                self._abandoned[number] = ends, servers

    def has_lost(self, servers: Servers) -> bool:
        """Return whether there is a request whose servers are all gone."""
        outstanding = [call.servers for call in self.unanswered.values()]
        outstanding += [known for _, known in self._abandoned.values()]
        return any(known and known.isdisjoint(servers) for known in outstanding)

    def fail_lost(self, servers: Servers, error: Callable[[], Exception]) -> None:
        """End the calls whose servers are all gone, and forget the abandoned ones of them."""
        for number, call in tuple(self.unanswered.items()):
            if call.servers and call.servers.isdisjoint(servers):
                del self.unanswered[number]
                self._port.forget(number)
                if not call.future.done():
                    call.future.set_exception(error())
        for number, (_, known) in tuple(self._abandoned.items()):
            if known and known.isdisjoint(servers):
                del self._abandoned[number]
                self._port.forget(number)
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

    def abandon(self, sequence_number: int, servers: Servers | None = None) -> None:
        """Keep the place of a request whose caller has left.

        Args:
            sequence_number: the number of the request.
            servers: the servers that had the request, None if not known yet.
        """
        # The loop is closed if a task that was still pending is collected.
        if self.closed or self._loop.is_closed():
            return
        ends = self._loop.time() + self._grace
        self._abandoned[sequence_number] = ends, servers
        if self._grace_timer is None:
            self._grace_timer = self._loop.call_at(ends, self._end_grace)

    def forget_later(self, sequence_number: int) -> None:
        """Expect a late response for the grace period, without keeping a place for it."""
        if self.closed or self._loop.is_closed():
            return
        timer = self._loop.call_later(self._grace, self._forget, sequence_number)
        self._superseded[sequence_number] = timer

    def _deliver(self, sequence_number: int, response: Any) -> None:
        call = self.unanswered.pop(sequence_number, None)
        if self._abandoned:
            self._free_earlier(sequence_number)
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

    def _free_earlier(self, sequence_number: int) -> None:
        """Free the places of the abandoned requests that were sent before an answered one.

        A server's queue keeps the order of one client's requests, so they have left it.
        """
        earlier = [number for number in self._abandoned if number < sequence_number]
        for number in earlier:
            del self._abandoned[number]
            self.forget_later(number)
        if earlier:
            self._on_capacity()

    def _end_grace(self) -> None:
        self._grace_timer = None
        now = self._loop.time()
        while self._abandoned:
            sequence_number, (ends, _) = next(iter(self._abandoned.items()))
            if ends > now:
                self._grace_timer = self._loop.call_at(ends, self._end_grace)
                break
            del self._abandoned[sequence_number]
            self._port.forget(sequence_number)
        self._on_capacity()
