"""The clients of one service: created on demand, matched with servers, evicted when idle."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol

from rosasync._client.call_errors import AllServersGone
from rosasync._client.client import Client, ClientOwner
from rosasync._client.matching import Matching
from rosasync._core.ports import PortDestroyed

if TYPE_CHECKING:
    from rosasync._client.call_errors import CallErrors
    from rosasync._client.counts import Counts
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.ports import NodePort, Servers, Service
    from rosasync._status.listener import Listener
    from rosasync.options import Limits

__all__ = ["Clients", "ClientsOwner"]

logger = logging.getLogger("rosasync")

EVICT_MIN = 0.05
"""Minimum number of seconds between two checks for idle clients."""


class ClientsOwner(ClientOwner, Protocol):
    """What the clients of a service report to it."""

    def on_matched(self) -> None:
        """React to a client that is matched with a server."""


class Clients:
    """The clients of one service. Confined to the loop's thread.

    Args:
        service: the service.
        node: creates the clients, and counts them.
        limits: how many clients there may be, and how long an idle one is kept.
        watch: counts the generations of the graph.
        errors: makes the errors of the service's calls.
        counts: the counters of the service.
        owner: the service. No client is evicted while it has callers that wait.
        listener: the reports of servers that take part.

    Attributes:
        share: the share of the server's queue, in places.
        others: the number of clients of the service in other sessions.
    """

    def __init__(
        self,
        service: Service,
        node: NodePort,
        limits: Limits,
        watch: GraphWatch,
        errors: CallErrors,
        counts: Counts,
        owner: ClientsOwner,
        listener: Listener,
    ) -> None:
        self.share = 0
        self.others = 0
        self.matching = Matching(service, node.queries, watch, self)
        self._service = service
        self._node = node
        self._limits = limits
        self._watch = watch
        self._errors = errors
        self._counts = counts
        self._owner = owner
        self._listener = listener
        self._loop = asyncio.get_running_loop()
        self._clients: list[Client] = []
        # The first client starts it. It stops when no client is left.
        self._evict_timer: asyncio.TimerHandle | None = None
        # Whether the warning was logged since a client was last created.
        self._growth_failed = False

    def __len__(self) -> int:
        return len(self._clients)

    def __iter__(self) -> Iterator[Client]:
        # A copy, because matching a client removes it if it turns out to be destroyed.
        return iter(tuple(self._clients))

    # Queries.

    @property
    def free(self) -> int:
        """How many more requests fit into the windows of all clients, matched or not."""
        # No generator, because every call that has to wait comes here.
        free = 0
        for client in self._clients:
            free += max(client.window.free, 0)
        return free

    @property
    def abandoned(self) -> int:
        """The number of abandoned requests that take a place."""
        return sum(len(client.window.abandoned) for client in self._clients)

    @property
    def awaits_match(self) -> bool:
        """Whether there is a client with a free place that is not known to be matched."""
        generation = self._watch.generation
        return any(
            client.window.free > 0 and client.matched_generation != generation
            for client in self._clients
        )

    @property
    def lacks_server(self) -> bool:
        """Whether callers wait for a server, because no client is known to be matched."""
        generation = self._watch.generation
        matched = any(client.matched_generation == generation for client in self._clients)
        return not self._clients or (not matched and self.awaits_match)

    @property
    def is_outstanding(self) -> bool:
        """Whether a server may have a request."""
        return any(client.is_outstanding for client in self._clients)

    @property
    def nothing_out(self) -> bool:
        """Whether no request takes a place of its own."""
        return all(client.window.idle for client in self._clients)

    def any_ready(self) -> bool:
        """Return whether the middleware shows a client as matched."""
        return any(_is_ready(client) for client in self._clients)

    def has_lost(self, servers: Servers) -> bool:
        """Return whether there is a request that none of these servers has."""
        return any(client.window.find_lost(servers) for client in self._clients)

    def count_answers(self) -> int:
        """Return how many calls were answered so far."""
        return self._counts.completed

    # Matches, and servers that come and go.

    def choose(self) -> Client | None:
        """Return a matched client with a free place, if there is one.

        Match the clients whose match is not known in this generation of the graph.
        """
        watch = self._watch
        if not watch.polling:
            watch.keep_polling()
        generation = watch.generation
        for client in self._clients:
            window = client.window
            if window.taken < window.size and (
                client.matched_generation == generation or self.match(client)
            ):
                return client
        return None

    def match(self, client: Client) -> bool:
        """Match a client in this generation of the graph, and return whether that is done."""
        generation = self._watch.generation
        if client.matched_generation == generation:
            return True
        try:
            if not client.ready():
                return False
        except PortDestroyed:
            self.drop(client)
            return False
        # Before anything is sent in this generation: each request is sent to known servers.
        self.matching.learn()
        if client.matched_generation < 0:
            logger.debug("%s: a client is matched with a server", self._service.key.srv_name)
        client.matched_generation = generation
        self._owner.on_matched()
        self.matching.warn_of_several()
        return True

    def match_any(self) -> bool:
        """Match the clients, and return whether one of them is matched."""
        return any(self.match(client) for client in self)

    def on_graph(self) -> None:
        """Check the graph again: the share of the server's queue, and the clients themselves."""
        self.resize()
        for client in self:
            try:
                client.ready()
            except PortDestroyed:
                self.drop(client)

    def on_servers(self, servers: Servers, ended: Servers = frozenset()) -> None:
        """React to the servers of a new generation, before anything is sent in it."""
        self._listener.on_servers(servers)
        for client in self._clients:
            client.on_servers(servers, ended)

    def lose_servers(self, servers: Servers) -> None:
        """End the requests that no server has, or let them go on; ``servers`` are those left."""
        for client in self:
            client.lose_servers(servers, AllServersGone)

    def set_timers(self) -> None:
        """Let the clients give up the places of lost requests, because a caller waits."""
        for client in self:
            client.set_timer()

    def resize(self) -> None:
        """Set the window of every client to its share of the server's queue."""
        self.matching.count_servers()
        clients = self._node.queries.count_clients(self._service)
        self.share = self._limits.share(clients)
        self.others = max(0, clients - len(self._clients))
        for client in self._clients:
            client.resize(self._limits.window(clients))

    # Growth, use and end.

    def grow(self, callers: int) -> None:
        """Create clients while there are fewer free places than ``callers``, matched or not.

        Raises:
            Exception: there is no client, and none can be created.
        """
        try:
            while len(self._clients) < self._limits.clients and self.free < callers:
                self.open()
        except Exception as error:
            if not self._clients:
                raise
            if not self._growth_failed:
                self._growth_failed = True
                logger.warning(
                    "%s: no further client can be created, so the calls share %d: %s",
                    self._service.key.srv_name,
                    len(self._clients),
                    error,
                )

    def open(self) -> None:
        """Create a client; raises as `NodePort.open_client`."""
        client = Client(
            lambda deliver: self._node.open_client(self._service, deliver),
            self._limits,
            self._counts,
            self._owner,
            self._listener,
        )
        client.on_servers(self.matching.servers)
        self._clients.append(client)
        logger.debug("%s: created client %d", self._service.key.srv_name, len(self._clients))
        self.resize()
        self._counts.created += 1
        self._growth_failed = False
        self._watch.poll_soon()
        if self._evict_timer is None:
            self._evict_at(self._loop.time() + self._limits.idle)

    def touch(self) -> None:
        """Begin the idle time of the clients again."""
        now = self._loop.time()
        for client in self._clients:
            client.idle_since = now

    def drop(self, client: Client) -> None:
        """Remove a client that other code has destroyed, for example by ``Node.destroy_client``."""
        if client in self._clients:
            self._clients.remove(client)
            logger.debug("%s: a client was destroyed by other code", self._service.key.srv_name)
            client.fail(self._errors.client_destroyed)
            client.close()
            self._owner.on_places()

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call in flight with an error."""
        for client in self._clients:
            client.fail(error)

    def close(self) -> None:
        """Destroy the clients; `fail` their calls first. Idempotent."""
        self.matching.close()
        if self._evict_timer is not None:
            self._evict_timer.cancel()
        for client in self._clients:
            client.close()
        self._clients.clear()

    def _evict_at(self, when: float) -> None:
        self._evict_timer = self._loop.call_at(when, self._evict) if when < math.inf else None

    def _evict(self) -> None:
        """Destroy the clients that have been idle for `Limits.idle` seconds."""
        now, idle = self._loop.time(), self._limits.idle
        self._evict_timer = None
        for client in self:
            due = client.idle_since + idle <= now
            if client.is_idle and due and not self._owner.callers_wait():
                self._clients.remove(client)
                client.close()
                logger.debug(
                    "%s: destroyed a client that was idle for %g s, %d left",
                    self._service.key.srv_name,
                    idle,
                    len(self._clients),
                )
        if self._clients:
            since = min(c.idle_since if c.is_idle else now for c in self._clients)
            self._evict_at(max(since + idle, now + EVICT_MIN))


def _is_ready(client: Client) -> bool:
    try:
        return client.ready()
    except PortDestroyed:
        return False
