"""The servers of one service: what the graph shows in each of its generations."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Protocol

from rosasync._core.text import count

if TYPE_CHECKING:
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.ports import GraphPort, Servers, Service

__all__ = ["GONE_DELAY", "Matching", "MatchingOwner"]

logger = logging.getLogger("rosasync")

GONE_DELAY = 0.05
"""Seconds to wait for the next response that the last server sent just before it vanished."""


LEASE = 20
"""Seconds for which Fast DDS shows a process that has ended without its clean-up."""


class MatchingOwner(Protocol):
    """What a matching needs to know of the service's clients, and reports to them."""

    def on_servers(self, servers: Servers, ended: Servers) -> None:
        """React to the servers of a new generation, before anything is sent in it.

        ``ended`` are those of them whose process has crashed, if others have come.
        """

    def lose_servers(self, servers: Servers) -> None:
        """End the requests that no server has, or let them go on; ``servers`` are those left."""

    def has_lost(self, servers: Servers) -> bool:
        """Return whether there is a request that none of these servers has."""

    def any_ready(self) -> bool:
        """Return whether the middleware shows a client as matched."""

    def count_answers(self) -> int:
        """Return how many calls were answered so far."""


class Matching:
    """The servers that fit one service: by name, type and QoS. Confined to the loop's thread.

    The graph is queried once in each of its generations, and only if a request is to be sent or is
    outstanding: a query takes 0.2 ms. A new generation begins with a change of the graph, without
    graph events with each poll, and when the requests of lost servers end.

    Attributes:
        servers: the servers, as last queried.
        count: the servers of the name, whatever their type, as last counted.
    """

    def __init__(
        self, service: Service, queries: GraphPort, watch: GraphWatch, owner: MatchingOwner
    ) -> None:
        self.servers: Servers = frozenset()
        self.count = 0
        self._service = service
        self._queries = queries
        self._watch = watch
        self._owner = owner
        self._loop = asyncio.get_running_loop()
        # The generation in which the servers were last queried.
        self._generation = -1
        # The most servers so far, so that each further server is reported once.
        self._most = 1
        # Started when a request has lost all its servers, and again after each response that comes
        # in the meantime. Stopped by the end of the session.
        self._timer: asyncio.TimerHandle | None = None

    def count_servers(self) -> None:
        """Count the servers of the name. Call it after every change of the graph."""
        servers = self._queries.count_servers(self._service)
        if servers != self.count:
            name = self._service.key.srv_name
            logger.debug("%s: the graph shows %s", name, count(servers, "server"))
        self.count = servers

    def learn(self) -> None:
        """Query the servers, unless that was done in this generation, and pass them on."""
        if self._generation != self._watch.generation:
            self._learn()

    def provided(self) -> bool:
        """Return whether the graph shows a server that fits."""
        return bool(self._queries.find_servers(self._service))

    def all_gone(self) -> bool:
        """Return whether no fitting server is left; other servers of the name do not count."""
        # The two cheap queries first.
        if not self._queries.count_servers(self._service):
            return True
        return not self._owner.any_ready() and not self.provided()

    def warn_of_several(self) -> None:
        """Warn if there are more servers than ever, without those that have crashed."""
        if len(self.servers) <= self._most:
            return
        servers = len(self.servers - self._queries.find_ended(self.servers))
        if servers > self._most:
            self._most = servers
            names = self._queries.name_servers(self._service)
            logger.warning(
                "%s: %d servers answer this name%s. Each runs every request, and all responses "
                "but the first are dropped: stop all but one. After a crash, the dead one is shown "
                "for up to %d s more; then there is nothing to do",
                self._service.key.srv_name,
                servers,
                f", of {' and '.join(names)}" if names else "",
                LEASE,
            )

    def check_outstanding(self) -> None:
        """Look for requests that have lost all their servers, while some are outstanding."""
        self.learn()
        if self._timer is None and (self.all_gone() or self._owner.has_lost(self.servers)):
            self._end_later()

    def close(self) -> None:
        """Stop the timer; idempotent."""
        if self._timer is not None:
            self._timer.cancel()

    def _learn(self) -> None:
        self._generation = self._watch.generation
        before, self.servers = self.servers, self._queries.find_servers(self._service)
        ended: Servers = frozenset()
        # That is expensive to know, and of use only if a successor is there.
        if before and self.servers - before:
            ended = self._queries.find_ended(before & self.servers)
        self._owner.on_servers(self.servers, ended)

    def _end_later(self) -> None:
        answers = self._owner.count_answers()
        self._timer = self._loop.call_later(GONE_DELAY, self._end_lost, answers)

    def _end_lost(self, answers: int) -> None:
        self._timer = None
        with self._watch.reports_shutdown():
            gone = self.all_gone()
            # The executor's thread takes responses one by one: more may be on their way.
            if gone and self._owner.count_answers() > answers:
                self._end_later()
                return
            if gone:
                # No match of this generation counts any more.
                self._watch.advance()
            # Before the calls go on: they may be sent again at once, to the servers of now.
            self._learn()
            self._owner.lose_servers(frozenset() if gone else self.servers)
