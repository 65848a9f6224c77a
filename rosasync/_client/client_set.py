"""The clients of one service: created on demand, matched with servers, evicted when idle."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Protocol

from rosasync._client.client import Client, ClientOwner, Counts
from rosasync._core.ports import PortDestroyed

if TYPE_CHECKING:
    from rosasync._client.call_errors import CallErrors
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.ports import NodePort, Servers, Service
    from rosasync.options import Limits

__all__ = ["ClientSet", "ClientSetOwner"]

logger = logging.getLogger("rosasync")

EVICT_MIN = 0.05
"""Minimum number of seconds between two checks for idle clients."""


class ClientSetOwner(ClientOwner, Protocol):
    """What the clients of a service report to it."""

    def on_matched(self) -> None:
        """React to a client that is matched with a server."""


class ClientSet:
    """The clients of one service. Confined to the loop's thread.

    Args:
        service: the service.
        node: creates the clients, and counts and identifies the servers.
        limits: how many clients there may be, and how long an idle one is kept.
        watch: counts the generations of the graph.
        errors: makes the errors of the service's calls.
        owner: the service. No client is evicted while it has callers that wait.
    """

    def __init__(
        self,
        service: Service,
        node: NodePort,
        limits: Limits,
        watch: GraphWatch,
        errors: CallErrors,
        owner: ClientSetOwner,
    ) -> None:
        self.counts = Counts()
        # What the graph showed when it last changed.
        self.share = 0
        self.servers = 0
        self._service = service
        self._node = node
        self._limits = limits
        self._watch = watch
        self._errors = errors
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        self._clients: list[Client] = []
        # The first client starts it. It stops when no client is left.
        self._evict_timer: asyncio.TimerHandle | None = None
        # The highest count so far, so that each further server is reported once.
        self._servers_counted = 1
        # The generations of the graph in which the servers were last queried, and in which requests
        # without servers were last searched for.
        self._servers_generation = -1
        self._lost_generation = -1
        # Whether the warning was logged since a client was last created.
        self._growth_failed = False

    def __len__(self) -> int:
        return len(self._clients)

    def __iter__(self) -> Iterator[Client]:
        # A copy, because checking a client removes it if it turns out to be destroyed.
        return iter(tuple(self._clients))

    @property
    def capacity(self) -> int:
        """How many more requests fit into the windows of all clients, matched or not."""
        return sum(max(client.capacity, 0) for client in self._clients)

    @property
    def abandoned(self) -> int:
        """The number of requests without a caller that still take a place."""
        return sum(client.abandoned for client in self._clients)

    @property
    def window(self) -> int:
        """The sum of the windows."""
        return sum(client.window for client in self._clients)

    @property
    def idle(self) -> int:
        """The number of idle clients."""
        return sum(client.is_idle for client in self._clients)

    @property
    def awaits_match(self) -> bool:
        """Whether there is a client with capacity that is not known to be matched."""
        generation = self._watch.generation
        return any(
            client.capacity > 0 and client.matched_generation != generation
            for client in self._clients
        )

    @property
    def lacks_server(self) -> bool:
        """Whether callers wait for a server, because no client is known to be matched."""
        if not self._clients:
            return True
        generation = self._watch.generation
        matched = any(client.matched_generation == generation for client in self._clients)
        return not matched and self.awaits_match

    @property
    def awaits_resend(self) -> bool:
        """Whether a request waits to be sent again."""
        return any(client.awaits_resend for client in self._clients)

    @property
    def awaits_match_to_resend(self) -> bool:
        """Whether such a request waits with a client that is not known to be matched."""
        generation = self._watch.generation
        return any(
            client.awaits_resend and client.matched_generation != generation
            for client in self._clients
        )

    @property
    def is_outstanding(self) -> bool:
        """Whether a server may have a request."""
        return any(client.is_outstanding for client in self._clients)

    def lease(self) -> Client | None:
        """Lease a matched client that has capacity, if there is one."""
        watch = self._watch
        if not watch.polling:
            watch.keep_polling()
        generation = watch.generation
        for client in self._clients:
            if client.capacity > 0 and (
                client.matched_generation == generation or self.is_matched(client)
            ):
                client.leases += 1
                return client
        return None

    def is_matched(self, client: Client) -> bool:
        """Return whether a client is matched with a server, in this generation of the graph."""
        generation = self._watch.generation
        if client.matched_generation == generation:
            return True
        if not self._is_ready(client):
            return False
        if client.matched_generation < 0:
            logger.debug("%s: a client is matched with a server", self._service.key.srv_name)
        client.matched_generation = generation
        self._owner.on_matched()
        self._warn_of_several_servers()
        if self._servers_generation != generation:
            # In a later turn, because the query takes 0.3 ms and the caller is about to send.
            self._servers_generation = generation
            for each in self._clients:
                each.servers = None
            self._loop.call_soon(self._learn_servers)
        return True

    def any_matched(self) -> bool:
        """Return whether a client is matched with a server."""
        return any(self.is_matched(client) for client in self)

    def send_resends(self) -> None:
        """Send the requests again that waited for a server."""
        for client in self:
            if client.awaits_resend and self.is_matched(client):
                client.send_resends()

    def find_lost_requests(self) -> bool:
        """Return whether a request has lost all its servers, even if there are new ones.

        New servers free the places of the abandoned requests that they have not had.
        """
        if self.servers_gone():
            return True
        if self._lost_generation == self._watch.generation:
            return False
        self._lost_generation = self._watch.generation
        servers = self._node.find_servers(self._service)
        for client in self:
            client.free_predecessors(servers)
        return any(client.has_lost(servers) for client in self)

    def servers_gone(self) -> bool:
        """Return whether no fitting server is left; other servers of the name do not count."""
        if not self._node.count_servers(self._service):
            return True
        if any(self._is_ready(client) for client in self):
            return False
        return not self._node.find_servers(self._service)

    def fail_lost(self, error: Callable[[], Exception]) -> None:
        """End the calls whose servers are all gone, unless they may go to the next server."""
        servers: Servers = frozenset()
        if self.servers_gone():
            self._watch.advance()
        else:
            servers = self._node.find_servers(self._service)
            self._servers_generation = self._watch.generation
        for client in self:
            # At once: requests are sent again here, and others may replace these servers soon.
            client.servers = servers or None
            client.fail_lost(servers, error)

    def grow(self, callers: int) -> None:
        """Create clients while there is less capacity than ``callers``, matched or not.

        Raises:
            Exception: there is no client, and none can be created.
        """
        try:
            while len(self._clients) < self._limits.clients and self.capacity < callers:
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
            self.counts,
            self._owner,
        )
        self._clients.append(client)
        logger.debug("%s: created client %d", self._service.key.srv_name, len(self._clients))
        self.share_queue()
        self.counts.created += 1
        self._growth_failed = False
        self._watch.poll_soon()
        if self._evict_timer is None:
            self._evict_at(self._loop.time() + self._limits.idle)

    def share_queue(self) -> None:
        """Set the window of every client to its share of the server's queue.

        Call it after every change of the graph.
        """
        servers = self._node.count_servers(self._service)
        if servers != self.servers:
            logger.debug("%s: the graph shows %d servers", self._service.key.srv_name, servers)
        self.servers = servers
        clients = self._node.count_clients(self._service)
        self.share = self._limits.share(clients)
        for client in self._clients:
            client.resize(self._limits.window(clients))

    def request_place(self) -> None:
        """Let the clients give up the place of an abandoned request, because a caller waits."""
        for client in self._clients:
            if client.abandoned:
                client.start_timer()

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
            self._owner.on_capacity()

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call in flight with an error."""
        for client in self._clients:
            client.fail(error)

    def close(self) -> None:
        """Destroy the clients; `fail` their calls first. Idempotent."""
        if self._evict_timer is not None:
            self._evict_timer.cancel()
        for client in self._clients:
            client.close()
        self._clients.clear()

    def _learn_servers(self) -> None:
        with self._watch.reports_shutdown():
            servers = self._node.find_servers(self._service)
            for client in self:
                client.learn_servers(servers)

    def _is_ready(self, client: Client) -> bool:
        try:
            return client.ready()
        except PortDestroyed:
            self.drop(client)
            return False

    def _warn_of_several_servers(self) -> None:
        # The count is cheap and never too low, so only a new maximum needs the expensive query.
        counted = self._node.count_servers(self._service)
        if counted <= self._servers_counted:
            return
        self._servers_counted = counted
        if (servers := len(self._node.find_servers(self._service))) > 1:
            logger.warning(
                "%s: %d servers answer this name. Each runs every request, and all responses "
                "but the first are dropped: stop all but one",
                self._service.key.srv_name,
                servers,
            )

    def _evict_at(self, when: float) -> None:
        self._evict_timer = self._loop.call_at(when, self._evict) if when < math.inf else None

    def _evict(self) -> None:
        """Destroy the clients that have been idle for `Limits.idle` seconds."""
        now, idle = self._loop.time(), self._limits.idle
        self._evict_timer = None
        for client in self:
            if client.is_idle and client.idle_since + idle <= now and not self._owner.has_callers():
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
