"""Whose turn it is among the clients of an overloaded server: pure, without a loop."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable

__all__ = ["Turns"]

GUARANTEE = 8
"""Every so many turns, one goes to the client that has waited for its turn longest."""
SPARE = 64
"""Clients that have nothing waiting are swept when there are this many more than others."""

Arrival = Callable[[Hashable], float | None]
"""Returns when the newest request of a client arrived; None if it has none waiting."""


class Turns:
    """The turns of clients, as in the fair queueing of FQ-CoDel (RFC 8290), the newest first.

    In a round each client has one turn. Those with the newest requests come first, because their
    callers are most likely still there: in a fixed order, a request would be as old as a round is
    long. A client without a turn in this round comes before those that have had one, so it does not
    feel a client that floods.

    A client whose newest request is no longer fresh has probably been left by its callers, so it
    only gets turns that no other wants. It may also be one that waits patiently. So every eighth
    turn goes to the client that was served longest ago, and no client starves.
    """

    def __init__(self) -> None:
        # Both in the order of each client's newest request. Those without a turn in this round; a
        # client whose newest request is not fresh leaves it, until it sends another.
        self._eligible: OrderedDict[Hashable, None] = OrderedDict()
        # Those that have had one. A client without requests stays here until the end of the round,
        # because it would otherwise be eligible again with its next request.
        self._served: OrderedDict[Hashable, None] = OrderedDict()
        # All clients with requests, the one served longest ago first.
        self._queue: OrderedDict[Hashable, None] = OrderedDict()
        self._turns = 0

    def begin(self, clients: Iterable[Hashable]) -> None:
        """Begin with these clients, in the order of their newest requests."""
        self._eligible = OrderedDict.fromkeys(clients)
        self._queue = OrderedDict.fromkeys(reversed(self._eligible))
        self._served.clear()
        self._turns = 0

    def add(self, client: Hashable) -> None:
        """Note that a client has sent a request."""
        turns = self._served if client in self._served else self._eligible
        turns[client] = None
        turns.move_to_end(client)
        self._queue[client] = None

    def remove(self, client: Hashable) -> None:
        """Note that a client has no request left."""
        self._eligible.pop(client, None)
        self._queue.pop(client, None)
        if len(self._served) > len(self._queue) + SPARE:
            for served in tuple(self._served):
                if served not in self._queue:
                    del self._served[served]

    def next(self, newest: Arrival, fresh_after: float) -> Hashable:
        """Give the next turn to a client and return the client.

        Args:
            newest: when the newest request of a client arrived.
            fresh_after: requests that arrived later are fresh.
        """
        self._turns += 1
        guaranteed = self._turns % GUARANTEE == 0
        client = None if guaranteed else self._take_freshest(newest, fresh_after)
        if client is None:
            client = next(iter(self._queue))
            self._eligible.pop(client, None)
        self._queue.move_to_end(client)
        self._served[client] = None
        return client

    def _take_freshest(self, newest: Arrival, fresh_after: float) -> Hashable | None:
        """Take the client with the newest request from this round, or else from the next one."""
        for _ in range(2):
            while self._eligible:
                client, _ = self._eligible.popitem(last=True)
                arrived = newest(client)
                if arrived is not None and arrived > fresh_after:
                    return client
            self._eligible, self._served = self._served, self._eligible
        return None
