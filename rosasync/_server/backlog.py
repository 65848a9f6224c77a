"""The order in which waiting requests are served, and which are dropped: pure, without a loop."""

from __future__ import annotations

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from rosasync._server.turns import Turns

__all__ = ["INTERVAL", "SHORT", "TARGET", "Backlog"]

T = TypeVar("T")

TARGET = 0.2
"""Seconds that requests may wait. RFC 8289 has 0.005 for packets; callers wait for seconds. With
Poisson arrivals at 0.9 of what a handler of 10 ms can do, hardly any request waits longer."""
INTERVAL = 0.1
"""Seconds for which they must have waited longer before the backlog is standing, as in RFC 8289."""
SHORT = 20
"""So many requests may wait for longer than the target, if they do not for longer than so many
requests take: a few callers of a slow handler are no overload. A stock server queues ten."""
FRESH = 4
"""A request is fresh until it has waited for the target, or for as long as so many requests take if
that is longer."""
SMOOTHING = 1 / 8
"""The weight of the newest value in the time that a request takes."""


@dataclass(slots=True, eq=False)
class _Waiting(Generic[T]):
    """A request that waits; ``number`` is its place in the order of arrival."""

    number: int
    item: T
    client: Hashable
    size: int
    arrived: float


@dataclass(slots=True, eq=False)
class _Client(Generic[T]):
    """The requests of one client, the oldest first, and their size."""

    requests: deque[_Waiting[T]] = field(default_factory=deque)
    size: int = 0


class Backlog(Generic[T]):
    """Requests that wait, at most ``limit`` of them, and of ``limit_bytes`` together.

    While the backlog is short, it is a queue: first come, first served. When it is *standing*, that
    order is useless, because each request is served after its caller has left. Then the clients
    take turns, and the newest request of each is served first. Beyond the bounds, the oldest
    request is dropped, of the client that has most of them.

    A backlog is standing when its oldest request has been older than a target for an interval, or
    requests have been dropped for an interval; and until nothing waits, or nothing so old. That is
    how CoDel (RFC 8289) tells a burst, which is worked off soon, from a queue that stays. To serve
    the newest first is Facebook's adaptive LIFO (Maurer, "Fail at Scale", ACM Queue 13(8), 2015).
    The turns are those of FQ-CoDel (RFC 8290), see `Turns`. Nothing is dropped for its age, because
    a server does not know how long its callers wait.

    All times are arguments, in seconds of one clock.

    Args:
        limit: the maximum number of requests.
        limit_bytes: the maximum size of all together, unless only one waits.
        by_arrival: serve in the order of arrival also while the backlog is standing.

    Attributes:
        standing: whether requests have been waiting for too long, as of the last `put` or `pop`.
        last_age: for how many seconds the request that was popped last had waited.
    """

    def __init__(self, limit: int, limit_bytes: int, *, by_arrival: bool = False) -> None:
        self.standing = False
        self.last_age = 0.0
        self._limit = limit
        self._limit_bytes = limit_bytes
        self._size = 0
        self._number = 0
        # By number. Not a dict, which gets slow if its first entry is removed again and again.
        self._requests: OrderedDict[int, _Waiting[T]] = OrderedDict()
        # Those with requests.
        self._clients: dict[Hashable, _Client[T]] = {}
        # Up to date only while the backlog is standing.
        self._turns = None if by_arrival else Turns()
        # Since when there has been too much, see `_measure`.
        self._excess_since: float | None = None
        self._dropped_at = -math.inf
        # The mean time from one pop to the next while requests wait.
        self._pace = 0.0
        # When the last request was popped, if others were left waiting.
        self._popped_at: float | None = None

    def __len__(self) -> int:
        return len(self._requests)

    def oldest_age(self, now: float) -> float:
        """Return for how many seconds the oldest request has waited; 0 if nothing waits."""
        return now - self._oldest().arrived if self._requests else 0.0

    def put(
        self,
        item: T,
        client: Hashable,
        size: int,
        now: float,
        *,
        waited: float = 0.0,
        room: int = 0,
    ) -> Sequence[T]:
        """Add a request.

        Args:
            item: the request.
            client: who sent it. Requests of unknown clients share one key.
            size: its size in bytes.
            now: the time.
            waited: for how many seconds it has waited elsewhere.
            room: how many requests may wait beyond the limit, because they are about to be popped.

        Returns:
            What is dropped for it, mostly nothing. It may be the request itself.
        """
        self._number += 1
        waiting = _Waiting(self._number, item, client, size, now - waited)
        self._requests[waiting.number] = waiting
        owner = self._clients.get(client)
        if owner is None:
            owner = self._clients[client] = _Client()
        owner.requests.append(waiting)
        owner.size += size
        self._size += size
        if self.standing and self._turns is not None:
            self._turns.add(client)
        dropped = self._drop_excess(self._limit + room)
        if dropped:
            self._dropped_at = now
        self._measure(now)
        return dropped

    def pop(self, now: float) -> T:
        """Remove and return the request to serve next.

        Raises:
            IndexError: nothing waits.
        """
        if not self._requests:
            raise IndexError("nothing waits")
        if self._popped_at is not None:
            self._pace += SMOOTHING * (now - self._popped_at - self._pace)
        self._measure(now)
        waiting = self._next(now)
        self._remove(waiting)
        self.last_age = now - waiting.arrived
        self._popped_at = now if self._requests else None
        # Once more, because the oldest request may have been removed.
        self._measure(now)
        return waiting.item

    def remove(self, item: T) -> bool:
        """Remove a request, because its caller has left; return whether it was there."""
        for waiting in self._requests.values():
            if waiting.item is item:
                self._remove(waiting)
                if not self._requests:
                    self._popped_at = None
                return True
        return False

    def clear(self) -> Sequence[T]:
        """Remove all requests, and return them in the order of their arrival."""
        items = [waiting.item for waiting in self._requests.values()]
        self._requests.clear()
        self._clients.clear()
        self._size = 0
        self._popped_at = None
        self._excess_since = None
        self.standing = False
        return items

    def _oldest(self) -> _Waiting[T]:
        return next(iter(self._requests.values()))

    def _measure(self, now: float) -> None:
        """Find out whether the backlog is standing."""
        if not (self._is_late(now) or (self._requests and now - self._dropped_at < INTERVAL)):
            self._excess_since = None
            self.standing = False
            return
        if self._excess_since is None:
            # Not `now`: nothing is measured while a handler works, and the request gets older.
            self._excess_since = min(now, self._oldest().arrived + TARGET)
        if not self.standing and now - self._excess_since >= INTERVAL:
            self.standing = True
            if self._turns is not None:
                newest = {
                    client: owner.requests[-1].number for client, owner in self._clients.items()
                }
                self._turns.begin(sorted(newest, key=newest.__getitem__))

    def _is_late(self, now: float) -> bool:
        """Return whether the oldest request has waited too long."""
        age = self.oldest_age(now)
        if age < TARGET:
            return False
        return self.standing or len(self._requests) > SHORT or age >= SHORT * self._pace

    def _next(self, now: float) -> _Waiting[T]:
        if not self.standing or self._turns is None:
            return self._oldest()
        client = self._turns.next(self._newest_arrival, now - max(TARGET, FRESH * self._pace))
        return self._clients[client].requests[-1]

    def _newest_arrival(self, client: Hashable) -> float | None:
        owner = self._clients.get(client)
        return None if owner is None else owner.requests[-1].arrived

    def _remove(self, waiting: _Waiting[T]) -> None:
        del self._requests[waiting.number]
        self._size -= waiting.size
        owner = self._clients[waiting.client]
        owner.size -= waiting.size
        # Mostly it is the oldest or the newest of its client.
        if owner.requests[0] is waiting:
            owner.requests.popleft()
        elif owner.requests[-1] is waiting:
            owner.requests.pop()
        else:
            owner.requests.remove(waiting)
        if not owner.requests:
            del self._clients[waiting.client]
            if self.standing and self._turns is not None:
                self._turns.remove(waiting.client)

    def _drop_excess(self, limit: int) -> Sequence[T]:
        if len(self._requests) <= limit and self._size <= self._limit_bytes:
            return ()
        dropped = []
        while len(self._requests) > limit:
            dropped.append(self._drop(lambda client: len(client.requests)))
        while self._size > self._limit_bytes and len(self._requests) > 1:
            dropped.append(self._drop(lambda client: client.size))
        return dropped

    def _drop(self, weigh: Callable[[_Client[T]], int]) -> T:
        """Remove the oldest request of the heaviest client; of several, the oldest of them all."""
        heaviest = max(map(weigh, self._clients.values()))
        waiting = min(
            (owner.requests[0] for owner in self._clients.values() if weigh(owner) == heaviest),
            key=lambda waiting: waiting.number,
        )
        self._remove(waiting)
        return waiting.item
