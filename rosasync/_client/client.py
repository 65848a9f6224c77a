"""One client, and the calls it carries: sequence number → call → asyncio future."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from rosasync._client.response_times import ResponseTimes

if TYPE_CHECKING:
    from rosasync._client.call import Call
    from rosasync._client.retry import Attempts
    from rosasync._core.ports import ClientPort, Deliver, Servers
    from rosasync.options import Limits

__all__ = ["Client", "ClientOwner", "Counts"]


@dataclass(slots=True)
class Counts:
    """The counters of one service, over all its clients.

    Shared by `Call`, `Attempts`, `Client`, `ClientSet` and `ServicePool`, which count what they see
    happen. All of them run on the loop's thread.
    """

    in_flight: int = 0
    sent: int = 0
    peak: int = 0
    created: int = 0
    completed: int = 0
    timed_out: int = 0
    cancelled: int = 0
    failed: int = 0
    late: int = 0
    retried: int = 0
    fast_retries: int = 0


class _Abandoned(NamedTuple):
    """A request that takes a place without a lease.

    Attributes:
        grace_ends: the loop time at which its place is given back in any case, infinite while its
            call is in flight.
        servers: the servers that have had it, None if they are not known yet.
    """

    grace_ends: float
    servers: Servers | None


class ClientOwner(Protocol):
    """What a client needs to know of its service, and reports to it."""

    def is_matched(self, client: Client) -> bool:
        """Return whether a client is matched, and reset its servers if the graph has changed."""

    def on_capacity(self) -> None:
        """React to places in the window that may have become free."""

    def on_resend_waiting(self) -> None:
        """React to a request that waits to be sent again."""

    def has_callers(self) -> bool:
        """Return whether callers wait for a place or for a match."""


class Client:
    """An rcl client, its window, and the requests it carries. Confined to the loop's thread.

    The invariant: every request that may still be in the server's queue has a place in the window.
    A request in flight has the place of its lease. An abandoned request, whose caller has left, has
    a place of its own, and so has the earlier attempt of a retried call. There are never more
    requests with a place than the window has places.

    The place of an abandoned request is given back if the request is known to have left the queue:

    - it is answered, late, or a later request of this client is: the queue keeps their order;
    - all servers that had it are gone, or a server has come that has not had it.

    Otherwise it is given up if callers wait and the client has got no answer at all for
    `ResponseTimes.patience`: then a request is more likely lost than queued. Only one place is
    given up in each such period, the oldest one, so a server that is only slow gets few requests
    beyond its queue. `Limits.grace` bounds the time in any case. If requests wait to be sent again
    and there is no such place, the first of them is sent in the place of its earlier attempt.

    Attributes:
        unanswered: the calls in flight, by sequence number. `Call` adds itself and its attempts.
        leases: the number of open leases. `ClientSet.lease` adds one, `release` ends one.
        answered: the highest sequence number that was answered.
        matched_generation: the generation of the graph in which a server was last seen matched.
            Written by the `ClientSet`.
        idle_since: the loop time at which the last lease ended. Written by the `ClientSet` as well.
        servers: the servers that receive the requests sent now; None if they are not known yet.
            Reset by the `ClientSet` when the graph has changed.
        window: the number of places.
    """

    __slots__ = (
        "_abandoned",
        "_grace",
        "_late",
        "_loop",
        "_on_capacity",
        "_owner",
        "_port",
        "_resends",
        "_response_times",
        "_retried",
        "_silent_since",
        "_timed",
        "_timed_at",
        "_timer",
        "_timer_due",
        "answered",
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
        owner: ClientOwner,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.window = limits.in_flight
        self._grace = limits.grace
        self._owner = owner
        self._on_capacity = owner.on_capacity
        self.unanswered: dict[int, Call] = {}
        self._abandoned: dict[int, _Abandoned] = {}
        # Requests that take no place, with the timers that end the wait for their late responses.
        self._late: dict[int, asyncio.TimerHandle] = {}
        # The retried calls in flight, and those of them that wait to be sent again.
        self._retried: dict[Attempts, None] = {}
        self._resends: dict[Attempts, None] = {}
        # Abandoned and waiting requests start it, and a caller that waits for the place of one may
        # set it to an earlier time. It stops when no such request is left.
        self._timer: asyncio.TimerHandle | None = None
        self._timer_due = math.inf
        # The time of the last answer, or at which a place was last given up. Up to date while there
        # are abandoned requests or retried calls.
        self._silent_since = 0.0
        self._response_times = ResponseTimes()
        # The request that is being timed, and when it was sent.
        self._timed = 0
        self._timed_at = 0.0
        self.answered = 0
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
        """The number of requests that take a place without a lease."""
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

    @property
    def is_outstanding(self) -> bool:
        """Whether a server may have a request of this client."""
        return bool(self.unanswered or self._abandoned)

    @property
    def awaits_resend(self) -> bool:
        """Whether a call waits to be sent again."""
        return bool(self._resends)

    def ready(self) -> bool:
        """Return whether a server is matched; raises as `ClientPort.ready`."""
        return self._port.ready()

    def release(self) -> None:
        """End a lease."""
        self.leases -= 1
        if not self.leases:
            self.idle_since = self._loop.time()
        if self._resends:
            self.send_resends()
        self._on_capacity()

    def resize(self, window: int) -> None:
        """Set the number of places."""
        grows, self.window = self.window < window, window
        if grows:
            self._places_freed()

    def close(self) -> None:
        """Destroy the rcl client; idempotent. `fail` it first, or its calls never end."""
        if self.closed:
            return
        self.closed = True
        if self._timer is not None:
            self._timer.cancel()
        for timer in self._late.values():
            timer.cancel()
        self._late.clear()
        self._abandoned.clear()
        self._port.close()

    # Servers that come and go.

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call in flight with an error, and forget the abandoned requests."""
        calls = [*self.unanswered.values(), *(attempts.call for attempts in self._retried)]
        for sequence_number in (*self.unanswered, *self._abandoned):
            self._port.forget(sequence_number)
        self.unanswered.clear()
        self._resends.clear()
        for call in calls:
            if not call.future.done():
                call.future.set_exception(error())
        if self._abandoned:
            self._abandoned.clear()
            self._on_capacity()

    def learn_servers(self, servers: Servers) -> None:
        """Set the servers of later requests, and of those whose servers are not known yet."""
        self.servers = servers
        for call in self.unanswered.values():
            if call.servers is None:
                call.servers = servers
        for number, request in self._abandoned.items():
            if request.servers is None:
                self._abandoned[number] = request._replace(servers=servers)

    def free_predecessors(self, servers: Servers) -> None:
        """Free the places of the abandoned requests that one of these servers has not had."""
        earlier = [
            number
            for number, request in self._abandoned.items()
            if request.servers and servers - request.servers
        ]
        self._free_places(earlier)

    def has_lost(self, servers: Servers) -> bool:
        """Return whether there is a request whose servers are all gone."""
        outstanding = [call.servers for call in self.unanswered.values()]
        outstanding += [request.servers for request in self._abandoned.values()]
        return any(_is_lost(known, servers) for known in outstanding)

    def fail_lost(self, servers: Servers, error: Callable[[], Exception]) -> None:
        """End the calls whose servers are all gone, unless they may go to the next server.

        Args:
            servers: the servers that there are now. If there is none, every request is lost.
            error: makes the error for a call that ends.
        """
        calls: dict[Call, None] = {}
        for number, call in tuple(self.unanswered.items()):
            if _is_lost(call.servers, servers):
                del self.unanswered[number]
                self._port.forget(number)
                calls[call] = None
        for number, request in tuple(self._abandoned.items()):
            if _is_lost(request.servers, servers):
                del self._abandoned[number]
                self._port.forget(number)
        for call in calls:
            call.lose_servers(error)
        self._places_freed()

    # Requests without a caller.

    def abandon(self, sequence_number: int, servers: Servers | None = None) -> None:
        """Keep a place for a request that has none any more, if it may still be in the queue.

        Args:
            sequence_number: the number of the request.
            servers: the servers that had the request, None if not known yet.
        """
        # The loop is closed if a task that was still pending is collected.
        if self.closed or self._loop.is_closed():
            return
        if sequence_number < self.answered or (servers and self.servers and self.servers - servers):
            self._abandoned.pop(sequence_number, None)
            self.expect_late(sequence_number)
            return
        self._watch_silence()
        in_flight = sequence_number in self.unanswered
        grace_ends = math.inf if in_flight else self._loop.time() + self._grace
        self._abandoned[sequence_number] = _Abandoned(grace_ends, servers)
        self.start_timer()

    def has_place(self, sequence_number: int) -> bool:
        """Return whether a request takes a place without a lease."""
        return sequence_number in self._abandoned

    def expect_late(self, sequence_number: int) -> None:
        """Expect a late response for the grace period, without a place for it."""
        if self.closed or self._loop.is_closed():
            return
        # A retried call leaves an attempt whose place was given up before.
        if earlier := self._late.get(sequence_number):
            earlier.cancel()
        timer = self._loop.call_later(self._grace, self._forget, sequence_number)
        self._late[sequence_number] = timer

    def time_response(self, sequence_number: int) -> None:
        """Measure the response time of the request just sent, unless another is being measured."""
        if self._timed in self.unanswered:
            return
        self._timed = sequence_number
        self._timed_at = self._loop.time()

    # Requests that are sent again.

    def add_retried(self, attempts: Attempts) -> None:
        """Report the answers to later requests to a call."""
        self._watch_silence()
        self._retried[attempts] = None

    def remove_retried(self, attempts: Attempts) -> None:
        """Stop reporting to a call, which has ended."""
        self._retried.pop(attempts, None)
        self.cancel_resend(attempts)

    def queue_resend(self, attempts: Attempts) -> None:
        """Send a request again as soon as there are a server and room."""
        self._resends[attempts] = None
        self.send_resends()
        if attempts in self._resends:
            self.start_timer()
            self._owner.on_resend_waiting()

    def cancel_resend(self, attempts: Attempts) -> None:
        """Stop waiting: the request is sent now, or not at all."""
        self._resends.pop(attempts, None)

    def send_resends(self) -> None:
        """Send the requests again for which there are a server and room."""
        for attempts in tuple(self._resends):
            if self.capacity <= 0 and attempts.needs_room:
                continue
            if not self._has_server(attempts):
                break
            attempts.send_again()

    def _has_server(self, attempts: Attempts) -> bool:
        try:
            # `ready` as well: a server may vanish before the graph changes.
            return self.ready() and self._owner.is_matched(self)
        except Exception as error:
            if not attempts.call.future.done():
                attempts.call.future.set_exception(error)
            return False

    # Answers, and the time without any.

    def _deliver(self, sequence_number: int, response: Any) -> None:
        call = self.unanswered.pop(sequence_number, None)
        if sequence_number > self.answered:
            self.answered = sequence_number
        if sequence_number == self._timed:
            self._response_times.add(self._loop.time() - self._timed_at)
        if call is None or call.future.done():
            self.counts.late += 1
        else:
            call.future.set_result(response)
        if call is not None:
            call.end()
        elif (timer := self._late.pop(sequence_number, None)) is not None:
            timer.cancel()
        if self._abandoned or self._retried:
            self._note_answer(sequence_number)

    def _note_answer(self, sequence_number: int) -> None:
        """Free the places of the requests up to this one, and report it to the retried calls."""
        self._silent_since = self._loop.time()
        answered = self._abandoned.pop(sequence_number, None) is not None
        earlier = [number for number in self._abandoned if number < sequence_number]
        for attempts in tuple(self._retried):
            attempts.note_answer(sequence_number)
        self._free_places(earlier, answered)

    def _free_places(self, sequence_numbers: list[int], freed: bool = False) -> None:
        """Free the places of abandoned requests; report it, too, if others were freed."""
        for number in sequence_numbers:
            self._give_up(number)
        if sequence_numbers or freed or self._resends:
            self._places_freed()

    def _give_up(self, sequence_number: int) -> None:
        del self._abandoned[sequence_number]
        if sequence_number not in self.unanswered:
            self.expect_late(sequence_number)

    def _places_freed(self) -> None:
        self.send_resends()
        self._on_capacity()

    def _forget(self, sequence_number: int) -> None:
        del self._late[sequence_number]
        self._port.forget(sequence_number)

    def _watch_silence(self) -> None:
        if not self._abandoned and not self._retried:
            self._silent_since = self._loop.time()

    def start_timer(self) -> None:
        """Wait until a place may be given up. Call it if a caller has begun to wait for one."""
        due = min((request.grace_ends for request in self._abandoned.values()), default=math.inf)
        if self._is_place_wanted():
            due = min(due, self._silent_since + self._response_times.patience)
        if self._timer is not None and self._timer_due > due:
            self._timer.cancel()
            self._timer = None
        if self._timer is None and due < math.inf:
            self._timer = self._loop.call_at(due, self._on_timer, due)
            # Not `when()`: uvloop gives no timer for a time that has come.
            self._timer_due = due

    def _on_timer(self, due: float) -> None:
        self._timer = None
        # The loop runs timers up to one clock resolution early.
        now = max(due, self._loop.time())
        self._end_grace(now)
        silence_ends = self._silent_since + self._response_times.patience
        if now >= silence_ends and self._is_place_wanted():
            self._silent_since = now
            self._give_up_place()
        self._places_freed()
        self.start_timer()

    def _is_place_wanted(self) -> bool:
        return bool(self._resends) or (bool(self._abandoned) and self._owner.has_callers())

    def _end_grace(self, now: float) -> None:
        for number, request in tuple(self._abandoned.items()):
            if request.grace_ends <= now:
                del self._abandoned[number]
                self._port.forget(number)

    def _give_up_place(self) -> None:
        if self._abandoned:
            self._give_up(next(iter(self._abandoned)))
        elif self._resends:
            attempts = next(iter(self._resends))
            if self._has_server(attempts):
                attempts.send_again()


def _is_lost(known: Servers | None, servers: Servers) -> bool:
    return not servers or bool(known and known.isdisjoint(servers))
