"""Services in memory: clients, servers, and what carries their requests and responses."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Hashable
from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._core.ports import Undeliverable
from rosasync._ros.messages import make_message

if TYPE_CHECKING:
    from rosasync._core.ports import Deliver, DeliverRequest
    from rosasync.statistics import ServiceKey

__all__ = ["MemoryClient", "MemoryServer", "MemoryService", "ServiceGraph"]


class ServiceGraph(Protocol):
    """What clients and servers need of their graph."""

    servers: list[MemoryServer]
    clients: list[MemoryClient]

    def find(self, srv_type: str, srv_name: str) -> list[MemoryServer]:
        """Return the servers of a service."""
        ...

    def changed(self) -> None:
        """Report a change of the graph."""
        ...

    def changed_soon(self) -> None:
        """Report a change of the graph in the loop's next turn."""
        ...

    def carry_request(
        self, server: MemoryServer, client: MemoryClient, number: int, request: Any
    ) -> None:
        """Pass a request to a server."""
        ...

    def carry_response(self, client: MemoryClient, number: int, response: Any) -> None:
        """Pass a response to a client, but not in this turn of the loop."""
        ...


class MemoryClient:
    """A client in memory: a `rosasync._core.ports.ClientPort`.

    Attributes:
        sent: the numbers of the requests sent, in order.
        out: the numbers of the outstanding requests.
        most: the maximum number of requests outstanding at once so far.
        identity: what servers tell it by; its beginning names the process.
    """

    def __init__(
        self, graph: ServiceGraph, key: ServiceKey, deliver: Deliver, identity: bytes
    ) -> None:
        self.srv_name, self.srv_type, _ = key
        self.identity = identity
        self.closed = False
        self.sent: list[int] = []
        self.out: set[int] = set()
        self.most = 0
        self._graph = graph
        self._deliver = deliver
        self._numbers = itertools.count(1)
        graph.clients.append(self)
        graph.changed_soon()

    def send(self, request: Any) -> int:
        """Send a request to every server of the name."""
        number = next(self._numbers)
        self.sent.append(number)
        self.out.add(number)
        self.most = max(self.most, len(self.out))
        for server in self._graph.find(self.srv_type, self.srv_name):
            self._graph.carry_request(server, self, number, request)
        return number

    def deliver(self, number: int, response: Any) -> None:
        """Deliver a response at once, unless the client is closed."""
        self.out.discard(number)
        if not self.closed:
            self._deliver(number, response)

    def forget(self, sequence_number: int) -> None:
        """Stop expecting a response to this request."""
        self.out.discard(sequence_number)

    def ready(self) -> bool:
        """Return whether there is a server."""
        return bool(self._graph.find(self.srv_type, self.srv_name))

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if not self.closed:
            self.closed = True
            self._graph.clients.remove(self)
            self._graph.changed_soon()


class MemoryServer:
    """A server in memory, as its clients see it.

    Attributes:
        identity: what the graph tells it by; its beginning names the process.
    """

    def __init__(self, graph: ServiceGraph, srv_type: Any, srv_name: str, identity: bytes) -> None:
        self.srv_type = srv_type
        self.srv_name = srv_name
        self.identity = identity
        self._graph = graph

    def enter(self) -> None:
        """Enter the graph."""
        self._graph.servers.append(self)
        self._graph.changed()

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if self in self._graph.servers:
            self._graph.servers.remove(self)
            self._graph.changed()

    def receive(self, client: MemoryClient, number: int, request: Any) -> None:
        """Take a request."""
        raise NotImplementedError


@dataclass(frozen=True)
class Header:
    """The header of a request in memory: a `rosasync._core.ports.RequestHeader`, and its own id."""

    client: MemoryClient
    sequence_number: int
    source_timestamp: int
    received_timestamp: int

    @property
    def request_id(self) -> Header:
        """The identity of the request."""
        return self


class MemoryService(MemoryServer):
    """A service that a session serves in memory: a `rosasync._core.ports.ServicePort`."""

    handle = None
    qos = None
    destroy_delay = 0.0
    repair_time = 0.0
    destroyed = False

    def __init__(
        self,
        graph: ServiceGraph,
        srv_type: Any,
        srv_name: str,
        deliver: DeliverRequest,
        identity: bytes,
    ) -> None:
        super().__init__(graph, srv_type, srv_name, identity)
        self._deliver = deliver
        self._stopped = False
        self._loop = asyncio.get_running_loop()

    def client_of(self, header: Any) -> Hashable:
        """Identify the client that sent a request."""
        return header.client.identity  # type: ignore[no-any-return]

    def clients(self) -> frozenset[Hashable]:
        """Identify the clients of this name."""
        return frozenset(
            client.identity for client in self._graph.clients if client.srv_name == self.srv_name
        )

    def has_clients(self) -> bool:
        """Return whether there is a client of this name."""
        return bool(self.clients())

    def send(self, header: Any, response: Any) -> None:
        """Send a copy of a response. From any thread.

        Raises:
            Undeliverable: its client is closed.
            TypeError, ValueError: a field has a value that cannot be sent.
        """
        response = make_message(self.srv_type.Response, response)
        client: MemoryClient = header.client
        if client.closed:
            raise Undeliverable("the client is gone")
        self._loop.call_soon_threadsafe(
            self._graph.carry_response, client, header.sequence_number, deepcopy(response)
        )

    def delivered(self) -> bool:
        """Return True: a response sent is not lost with its service."""
        return True

    def stop(self) -> None:
        """Stop delivering requests; idempotent."""
        self._stopped = True

    def receive(self, client: MemoryClient, number: int, request: Any) -> None:
        """Deliver a copy of a request to the session, in the next turn of its loop."""
        header = Header(client, number, time.time_ns(), time.time_ns())
        self._loop.call_soon(self._arrived, deepcopy(request), header)

    def _arrived(self, request: Any, header: Header) -> None:
        if not self._stopped:
            self._deliver(request, header)
