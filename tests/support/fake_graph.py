"""The graph in memory with faults of all its servers at once, and servers that answer at once.

`rosasync.testing.Graph` has faults of single servers, which run in a session. Tests of clients need
less between them and the wire: a server that answers within `send`, or does not.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from rosasync import Session
from rosasync._ros.types import service_type
from rosasync.testing._faults import set_in_block
from rosasync.testing._hooks import GraphSession, Hooks
from rosasync.testing._memory.graph import MemoryGraph, new_identity, new_process
from rosasync.testing._memory.services import MemoryClient, MemoryServer

__all__ = ["FakeGraph", "FakeServer"]

logger = logging.getLogger("rosasync")


class FakeServer(MemoryServer):
    """A server of another process, which answers in the turn in which a request is sent.

    Attributes:
        depth: the maximum number of requests in its queue while requests are held. Further ones are
            silently lost, as in the middleware.
        received: the requests handled, in order.
        lost: the number of requests lost.
    """

    def __init__(
        self,
        graph: FakeGraph,
        srv_type: Any,
        srv_name: str,
        handler: Callable[[Any], Any],
        depth: int = 10,
    ) -> None:
        super().__init__(graph, srv_type, srv_name, new_identity(new_process()))
        self.graph = graph
        self.handler = handler
        self.depth = depth
        self.received: list[Any] = []
        self.lost = 0
        self._queue: deque[tuple[MemoryClient, int, Any]] = deque()

    def close(self) -> None:
        """Leave the graph and drop every queued request; idempotent."""
        self._queue.clear()
        super().close()

    def receive(self, client: MemoryClient, number: int, request: Any) -> None:
        """Queue a request, or lose it if the queue is full; handle it at once unless held."""
        if self.graph.holding and len(self._queue) >= self.depth:
            self.lost += 1
            return
        self._queue.append((client, number, request))
        if not self.graph.holding:
            self.handle_queued()

    def handle_queued(self) -> None:
        """Handle the queued requests and send their responses.

        If a handler raises, its request stays unanswered.
        """
        while self._queue:
            client, number, request = self._queue.popleft()
            self.received.append(request)
            try:
                response = self.handler(request)
            except Exception:
                logger.exception("%s: the handler of request #%d failed", self.srv_name, number)
                continue
            self.graph.carry_response(client, number, response)


class FakeGraph(MemoryGraph):
    """A graph in memory whose messages can be delayed, held and lost."""

    def __init__(self, *, graph_events: bool = True) -> None:
        super().__init__()
        self.graph_events = graph_events
        self.delay = 0.0
        self.holding = False
        self.dropping_requests = False
        self.dropping_responses = False

    def session(self, **options: Any) -> Session:
        """Create a session in this graph; the options are those of `rosasync.Session`."""
        return GraphSession(Hooks(), self, "fake", **options)

    def serve(
        self, srv_type: Any, srv_name: str, handler: Callable[[Any], Any], *, depth: int = 10
    ) -> FakeServer:
        """Add a server to the graph; ``handler(request)`` returns the response, at once."""
        server = FakeServer(self, service_type(srv_type), srv_name, handler, depth)
        server.enter()
        return server

    def delay_responses(self, seconds: float) -> AbstractContextManager[None]:
        """Delay responses by a number of seconds, in this block."""
        return set_in_block(self, "delay", seconds)

    def drop_requests(self) -> AbstractContextManager[None]:
        """Lose every request that is sent in this block."""
        return set_in_block(self, "dropping_requests", True)

    def drop_responses(self) -> AbstractContextManager[None]:
        """Lose every response that is sent in this block."""
        return set_in_block(self, "dropping_responses", True)

    @contextmanager
    def hold_requests(self) -> Iterator[None]:
        """Queue the requests to fake servers, up to their depth, and handle them at the end."""
        try:
            with set_in_block(self, "holding", True):
                yield
        finally:
            for server in tuple(self.servers):
                if isinstance(server, FakeServer):
                    server.handle_queued()

    def carry_request(
        self, server: MemoryServer, client: MemoryClient, number: int, request: Any
    ) -> None:
        """Pass a request to a server, unless requests are lost."""
        if not self.dropping_requests:
            super().carry_request(server, client, number, request)

    def carry_response(self, client: MemoryClient, number: int, response: Any) -> None:
        """Pass a response to a client after the delay, unless responses are lost."""
        if not self.dropping_responses:
            loop = asyncio.get_running_loop()
            loop.call_later(self.delay, client.deliver, number, response)
