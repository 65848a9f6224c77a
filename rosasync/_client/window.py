"""The window of one client: which requests take a place, and when each place comes back."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

from rosasync._client.pace import RECENT, Measured, Pace
from rosasync._client.response_times import ResponseTimes

if TYPE_CHECKING:
    from rosasync._client.sent import Sent
    from rosasync._core.ports import Servers

__all__ = ["Window"]

TIMED = 16
"""The first requests are timed, and then one of this many."""


class Window:
    """The places of one client in the server's queue.

    Pure: it has no loop, port or future, and learns the time from its caller.

    The invariant: every request that may still be in the server's queue takes a place, or uses the
    place of its call's lease. No more places are taken than there are, except after the window has
    shrunk, and while a lease waits for the place that its abandoned request took.

    A request whose caller has left, or that was sent again, is *abandoned*. It gives its place back
    if it is known to have left the queue:

    - it is answered, late, or a later request of this client is: the queue keeps their order;
    - all servers that had it are gone, or a server has come that has not had it.

    Otherwise one place, the oldest, is given up in each `ResponseTimes.patience` for which callers
    wait and no answer comes at all: a request is then more likely lost than queued, and a server
    that is only slow gets few requests beyond its queue. `Limits.grace` bounds the time in any
    case.

    A request that is still waited for keeps its place until it is answered, or its servers are
    gone. If a server has come that has not had it, and none of the requests of this kind is
    answered for the time of the patience, then the old server is taken for dead, and all of them
    give their places back at once. Not sooner: if the old server lives, the requests for the new
    one go to both, and would push these out of the old one's queue. If the process of the old
    server has certainly ended, nothing is waited for.

    Attributes:
        size: the number of places.
        taken: the places taken by leases and requests. Written by `Client.send` as well.
        leases: the number of places held by leases.
        sent: all outstanding requests in the order in which they were sent, including those
            without a place whose late responses are expected. Written by `Client.send` as well.
        abandoned: those of them that are abandoned and take a place.
        answered: the highest number that was answered.
        answered_at: the time of the last answer.
        last: the highest number that was sent. Written by `Client.send`.
        servers: the servers that the graph showed last.
        times: the response times, and the patience.
        silent_since: the time of the last answer, of the last place that was given up, or of the
            first send into an empty window. Written by `Client.send` as well.
    """

    __slots__ = (
        "_grace",
        "_leaving",
        "_longest",
        "_outdated",
        "_outdated_since",
        "_pace",
        "_recent",
        "abandoned",
        "answered",
        "answered_at",
        "last",
        "leases",
        "sent",
        "servers",
        "silent_since",
        "size",
        "taken",
        "times",
    )

    def __init__(self, size: int, grace: float) -> None:
        self.size = size
        self.taken = 0
        self.leases = 0
        self.sent: dict[int, Sent] = {}
        self.abandoned: dict[int, Sent] = {}
        self.answered = 0
        self.last = 0
        self.servers: Servers = frozenset()
        self.times = ResponseTimes()
        self._grace = grace
        self._recent: deque[Measured] = deque(maxlen=RECENT)
        # None of them is longer.
        self._longest = 0.0
        # What they say, until the next answer: one batch of answers lets many callers go.
        self._pace: Pace | None = None
        self.answered_at = 0.0
        # The requests without a caller, each with the time until which it is remembered. Requests
        # that have been answered in the meantime are dropped when they come to the front.
        self._leaving: deque[tuple[float, Sent]] = deque()
        self.silent_since = 0.0
        # The requests that are waited for and that the newest server has not had, and the time at
        # which it came or one of them was last answered.
        self._outdated: dict[int, Sent] = {}
        self._outdated_since = 0.0

    def __repr__(self) -> str:
        return (
            f"<Window {self.taken}/{self.size} places, {self.leases} leases, "
            f"{len(self.abandoned)} abandoned>"
        )

    @property
    def free(self) -> int:
        """How many places are free; negative if more are taken than there are."""
        return self.size - self.taken

    @property
    def idle(self) -> bool:
        """Whether no request takes a place of its own."""
        return self.taken == self.leases

    def lease(self) -> None:
        """Take a place for a lease."""
        self.leases += 1
        self.taken += 1

    def release(self) -> None:
        """Give the place of a lease back."""
        self.leases -= 1
        self.taken -= 1

    def add(self, sent: Sent) -> None:
        """Add a request that was just sent."""
        if self.taken == self.leases:
            self.silent_since = sent.at
        self.taken += sent.place
        sent.out = self.taken
        self.sent[sent.number] = sent
        self.last = sent.number

    def may_send_again(self, newest: Sent | None, leased: bool) -> bool:
        """Return whether there is a place for the next attempt of a call.

        Args:
            newest: the attempt before it; None if its servers are gone.
            leased: whether the call is made on a lease.
        """
        if self.size > self.taken:
            return True
        if newest is None:
            return leased
        return (newest.place or newest.leased) and self._has_left(newest)

    def supersede(self, sent: Sent) -> None:
        """Record that a request is about to be sent again.

        If the attempt before may still be in the queue, it keeps a place of its own.
        """
        if self._has_left(sent) or (sent.servers and self.servers - sent.servers):
            self._free(sent)
            sent.leased = False
        elif sent.place or sent.leased:
            if sent.leased:
                # The lease's place is the next attempt's.
                sent.leased = False
                sent.place = True
                self.taken += 1
            self.abandoned[sent.number] = sent

    def leave(self, sent: Sent, now: float) -> None:
        """Record that the caller of a request has left.

        The request keeps a place if it may still be in the queue. Its late response is expected for
        the grace period in any case.
        """
        sent.call = None
        self._outdated.pop(sent.number, None)
        self.supersede(sent)
        self._leaving.append((now + self._grace, sent))

    def forgive(self, sent: Sent) -> None:
        """Give the place of a request back that its servers drop; its response may still come."""
        self._free(sent)
        sent.leased = False

    def remove(self, sent: Sent) -> None:
        """Forget a request and give its place back."""
        self.sent.pop(sent.number, None)
        self._free(sent)
        sent.leased = False

    def clear(self) -> None:
        """Forget all requests."""
        for sent in tuple(self.sent.values()):
            self.remove(sent)
        self._leaving.clear()

    def on_answer(self, number: int, now: float) -> Sent | None:
        """Take out the request that is answered; None if it is not outstanding.

        Its place is given back, and those of the earlier abandoned requests.
        """
        sent = self.sent.pop(number, None)
        if sent is None:
            return None
        if number > self.answered:
            self.answered = number
        self.silent_since = now
        seconds = now - sent.at
        if seconds > self._longest:
            self._longest = seconds
        # Both without a call, because every answer comes here.
        work = seconds if sent.at > self.answered_at else now - self.answered_at
        self.answered_at = now
        self._recent.append((now, seconds, sent.out, work))
        self._pace = None
        if number <= TIMED or not number % TIMED:
            self.times.add(seconds)
        if number in self._outdated:
            self._outdated_since = now
        if self.abandoned or self._outdated:
            self._free(sent)
            for earlier in [other for other in self.abandoned.values() if other.number < number]:
                self._free(earlier)
        elif sent.place:
            # As `_free`, inlined because almost every call comes here.
            sent.place = False
            self.taken -= 1
        leaving = self._leaving
        while leaving and leaving[0][1].number not in self.sent:
            leaving.popleft()
        return sent

    def on_servers(self, servers: Servers, now: float, ended: Servers = frozenset()) -> None:
        """Free the places of the abandoned requests that one of these servers has not had.

        Requests whose servers are not known yet have gone to these.

        Args:
            servers: the servers that the graph shows.
            now: the time.
            ended: those of them whose process has ended; also requests that are waited for give
                their places back if no other server has had them.
        """
        came = servers - self.servers
        self.servers = servers
        if came:
            # The new server may be quicker.
            self._recent.clear()
            self._pace = None
        for sent in self.sent.values():
            if not sent.servers:
                sent.servers = servers
            elif not sent.place or servers <= sent.servers:
                continue
            elif sent.number in self.abandoned or _all_in(sent.servers & servers, ended):
                self._free(sent)
            elif came:
                self._outdated[sent.number] = sent
                self._outdated_since = now

    def find_lost(self, servers: Servers) -> list[Sent]:
        """Return the requests that no server has, given the servers that are there."""
        if not servers:
            return list(self.sent.values())
        return [
            sent for sent in self.sent.values() if sent.servers and sent.servers.isdisjoint(servers)
        ]

    def answers_in(self, seconds: float, now: float) -> bool:
        """Return whether the answer of a request that is sent now is expected in so many seconds.

        Most callers have far more time, and nothing has to be estimated for them.
        """
        # No work is longer than its response time, and nothing is expected to take longer than one
        # work for each request that is out, and one more: see `Pace.expected`.
        limit = (self.taken + 2) * self._longest
        return seconds >= limit or seconds >= self.expected(now)

    def expected(self, now: float) -> float:
        """Return the seconds to the answer of a request that is sent now, at most; 0 if unknown."""
        if self._pace is None or now > self._pace.until:
            self._pace = Pace.of(self._recent, now)
            self._longest = max((seconds for _, seconds, _, _ in self._recent), default=0.0)
        return self._pace.expected(self.taken + 1)

    def due(self, callers_wait: bool, resend: Sent | None) -> float:
        """Return the time at which `on_time` has something to do; infinite if it never has.

        For the arguments, see `on_time`.
        """
        due = self._leaving[0][0] if self._leaving else math.inf
        if (callers_wait and self.abandoned) or _yields(resend):
            due = min(due, self.silent_since + self.times.patience)
        if callers_wait and self._outdated:
            due = min(due, self._outdated_since + self.times.patience)
        return due

    def on_time(self, now: float, callers_wait: bool, resend: Sent | None) -> list[Sent]:
        """Give up the places whose time has come, and return the requests that are forgotten.

        Args:
            now: the time.
            callers_wait: whether callers wait for a place, or calls wait to be sent again.
            resend: the newest attempt of the first call that waits to be sent again.
        """
        forgotten = []
        while self._leaving and self._leaving[0][0] <= now:
            _, sent = self._leaving.popleft()
            if sent.number in self.sent:
                self.remove(sent)
                forgotten.append(sent)
        patience = self.times.patience
        if callers_wait and self._outdated and now >= self._outdated_since + patience:
            for sent in tuple(self._outdated.values()):
                self._free(sent)
        if now < self.silent_since + patience:
            return forgotten
        if callers_wait and self.abandoned:
            self.silent_since = now
            self._free(next(iter(self.abandoned.values())))
        elif resend is not None and _yields(resend):
            self.silent_since = now
            resend.lost = True
        return forgotten

    def _has_left(self, sent: Sent) -> bool:
        """Return whether a request is known or presumed to have left the server's queue."""
        return sent.number < self.answered or sent.lost

    def _free(self, sent: Sent) -> None:
        """Give the place of a request back, if it takes one."""
        self.abandoned.pop(sent.number, None)
        self._outdated.pop(sent.number, None)
        if sent.place:
            sent.place = False
            self.taken -= 1


def _all_in(had: Servers, ended: Servers) -> bool:
    """Return whether there is a server that had a request, and all of them have ended."""
    return bool(had) and had <= ended


def _yields(resend: Sent | None) -> bool:
    """Return whether an attempt has a place that the next one could take if it were lost."""
    return resend is not None and (resend.place or resend.leased) and not resend.lost
