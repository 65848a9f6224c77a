"""A ROS graph in memory, with faults on demand: tests without a middleware.

::

    async def test_enables_the_arm():
        graph = FakeGraph()
        graph.serve(SetBool, "/arm/enable", lambda request: SetBool.Response(success=True))
        async with graph.session() as session:
            with graph.delay_responses(0.1):
                assert (await session.call(SetBool, "/arm/enable", {"data": True})).success
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

from rosasync._actions.status_list import decode_statuses
from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import (
    Action,
    Deliver,
    DeliverMessage,
    DeliverRequest,
    Service,
    TopicQos,
    Undeliverable,
)
from rosasync._ros.action_types import action_type
from rosasync._ros.checks import checker
from rosasync._ros.messages import make_message
from rosasync._ros.types import service_type, type_name
from rosasync.errors import InvalidServiceName
from rosasync.session import Session
from rosasync.statistics import ServiceKey
from rosasync.testing.faults import set_in_block

__all__ = [
    "FakeClient",
    "FakeGraph",
    "FakeNode",
    "FakePublisher",
    "FakeServer",
    "FakeService",
    "FakeSubscription",
]

logger = logging.getLogger("rosasync")

NAME = re.compile(r"/?[a-z_]\w*(/[a-z_]\w*)*", re.ASCII | re.IGNORECASE)
"""A name that ROS allows."""


_numbers = itertools.count(1)


def _new_process() -> bytes:
    """Return what the identities of a process begin with, as long as in the middleware."""
    return next(_numbers).to_bytes(12, "big")


def _new_identity(process: bytes) -> bytes:
    """Return the identity of a client or server of a process."""
    return process + next(_numbers).to_bytes(4, "big")


@dataclass(eq=False)
class FakeServer:
    """A server in a `FakeGraph`.

    Attributes:
        depth: the maximum number of requests in its queue while requests are held. Further ones are
            silently lost, as in the middleware.
        received: the requests handled, in order.
        lost: the number of requests lost.
        identity: what the graph tells it by; its beginning names the process.
    """

    graph: FakeGraph
    srv_type: Any
    srv_name: str
    handler: Callable[[Any], Any]
    depth: int = 10
    received: list[Any] = field(default_factory=list)
    lost: int = 0
    identity: bytes = field(default_factory=lambda: _new_identity(_new_process()))
    _queue: deque[tuple[FakeClient, int, Any]] = field(default_factory=deque)

    def close(self) -> None:
        """Leave the graph and drop every queued request; idempotent."""
        self._queue.clear()
        if self in self.graph.servers:
            self.graph.servers.remove(self)
            self.graph.changed()

    def receive(self, client: FakeClient, number: int, request: Any) -> None:
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
            if not self.graph.dropping_responses:
                client.later(self.graph.delay, number, response)


@dataclass(frozen=True)
class FakeHeader:
    """The header of a request in memory: a `rosasync._core.ports.RequestHeader`, and its own id."""

    client: FakeClient
    sequence_number: int
    source_timestamp: int
    received_timestamp: int

    @property
    def request_id(self) -> FakeHeader:
        """The identity of the request."""
        return self


class FakeService(FakeServer):
    """A service that a session serves in a `FakeGraph`: a `rosasync._core.ports.ServicePort`.

    Attributes:
        sent: copies of the responses sent, in order.
    """

    handle = None
    qos = None
    destroy_delay = 0.0
    destroyed = False

    def __init__(
        self, graph: FakeGraph, srv_type: Any, srv_name: str, deliver: DeliverRequest
    ) -> None:
        super().__init__(graph, srv_type, srv_name, lambda request: None, depth=1000)
        self.sent: list[Any] = []
        self._response_type = srv_type.Response
        self._deliver = deliver
        self._stopped = False
        self._loop = asyncio.get_running_loop()

    def client_of(self, header: Any) -> Hashable:
        """Identify the client that sent a request."""
        return header.client.identity  # type: ignore[no-any-return]

    def clients(self) -> frozenset[Hashable]:
        """Identify the clients of this name."""
        return frozenset(
            client.identity
            for node in self.graph.nodes
            for client in node.clients
            if client.srv_name == self.srv_name
        )

    def send(self, header: Any, response: Any) -> None:
        """Send a copy of a response. From any thread.

        Raises:
            Undeliverable: its client is closed.
            TypeError, ValueError: a field has a value that cannot be sent.
        """
        response = make_message(self._response_type, response)
        if header.client.closed:
            raise Undeliverable("the client is gone")
        copy = deepcopy(response)
        self.sent.append(copy)
        if not self.graph.dropping_responses:
            self._loop.call_soon_threadsafe(
                header.client.later, self.graph.delay, header.sequence_number, copy
            )

    def delivered(self) -> bool:
        """Return True: a response sent is not lost with its service."""
        return True

    def has_clients(self) -> bool:
        """Return whether there is a client of this name."""
        return any(
            client.srv_name == self.srv_name for node in self.graph.nodes for client in node.clients
        )

    def stop(self) -> None:
        """Stop delivering requests; idempotent."""
        self._stopped = True

    def receive(self, client: FakeClient, number: int, request: Any) -> None:
        """Queue a copy of a request, or lose it if the queue is full."""
        super().receive(client, number, deepcopy(request))

    def handle_queued(self) -> None:
        """Deliver the queued requests to the session, in the next turn of its loop."""
        while self._queue:
            client, number, request = self._queue.popleft()
            self.received.append(request)
            header = FakeHeader(client, number, time.time_ns(), time.time_ns())
            self._loop.call_soon(self._arrived, request, header)

    def _arrived(self, request: Any, header: FakeHeader) -> None:
        if not self._stopped:
            self._deliver(request, header)


class FakeGraph:
    """A ROS graph in memory: its servers, its nodes, and faults between them.

    Confined to one loop's thread.
    """

    def __init__(self, *, graph_events: bool = True) -> None:
        self.graph_events = graph_events
        self.servers: list[FakeServer] = []
        self.nodes: list[FakeNode] = []
        self.publishers: list[FakePublisher] = []
        self.subscriptions: list[FakeSubscription] = []
        self.delay = 0.0
        self.holding = False
        self.dropping_requests = False
        self.dropping_responses = False

    def serve(
        self, srv_type: Any, srv_name: str, handler: Callable[[Any], Any], *, depth: int = 10
    ) -> FakeServer:
        """Add a server to the graph; ``handler(request)`` returns the response, at once.

        For the kinds of handlers that `rosasync.Session.serve` takes, see `Graph.serve`.
        """
        server = FakeServer(self, service_type(srv_type), srv_name, handler, depth)
        self.servers.append(server)
        self.changed()
        return server

    def session(self, **options: Any) -> Session:
        """Create a session in this graph; the options are those of `rosasync.Session`."""
        return FakeSession(self, **options)

    def changed(self) -> None:
        """Report a change of the graph to every node."""
        if self.graph_events:
            for node in tuple(self.nodes):
                node.on_graph()

    def changed_soon(self) -> None:
        """Report a change of the graph in the loop's next turn."""
        asyncio.get_running_loop().call_soon(self.changed)

    def delay_responses(self, seconds: float) -> AbstractContextManager[None]:
        """Delay responses by a number of seconds, in this block."""
        return set_in_block(self, "delay", seconds)

    def drop_requests(self) -> AbstractContextManager[None]:
        """Lose every request that is sent in this block."""
        return set_in_block(self, "dropping_requests", True)

    def drop_responses(self) -> AbstractContextManager[None]:
        """Lose the response to every request that is handled in this block."""
        return set_in_block(self, "dropping_responses", True)

    @contextmanager
    def hold_requests(self) -> Iterator[None]:
        """Queue requests in this block, up to each server's depth, and handle them at its end."""
        try:
            with set_in_block(self, "holding", True):
                yield
        finally:
            for server in tuple(self.servers):
                server.handle_queued()

    def find(self, srv_type: str, srv_name: str) -> list[FakeServer]:
        """Return the servers of a service, by the names of its type and the service."""
        return [
            server
            for server in self.servers
            if server.srv_name == srv_name and type_name(server.srv_type) == srv_type
        ]


class FakeSession(Session):
    """A session in a `FakeGraph`."""

    def __init__(self, graph: FakeGraph, **options: Any) -> None:
        super().__init__("fake", **options)
        self._graph = graph

    async def _load(self) -> None:
        """Import nothing: a graph in memory needs no rclpy."""

    def _open_node(
        self, gateway: LoopGateway, on_graph: Callable[[], None], on_shutdown: Callable[[], None]
    ) -> FakeNode:
        return FakeNode(self._graph, on_graph, on_shutdown)


class FakeNode:
    """A node of a `FakeGraph`: a `rosasync._core.ports.NodePort`."""

    name = "fake"
    bridge = "fake"
    executor_thread: int | None = None

    def __init__(
        self,
        graph: FakeGraph,
        on_graph: Callable[[], None] = lambda: None,
        on_shutdown: Callable[[], None] = lambda: None,
    ) -> None:
        self.graph = graph
        self.node = self
        self.process = _new_process()
        self._loop = asyncio.get_running_loop()
        self._epoch = time.time_ns() - int(self._loop.time() * 1e9)
        self.up = True
        self.clients: list[FakeClient] = []
        self.on_graph = on_graph
        self.on_shutdown = on_shutdown
        graph.nodes.append(self)

    def shutdown(self) -> None:
        """Shut the context down."""
        self.up = False
        self.on_shutdown()

    @property
    def graph_events(self) -> bool:
        """Whether the node reports changes of the graph."""
        return self.graph.graph_events

    def ok(self) -> bool:
        """Return whether the context is up."""
        return self.up

    def now(self) -> int:
        """Return the time in ns, which a virtual clock moves forward."""
        return self._epoch + int(self._loop.time() * 1e9)

    def describe(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Check and resolve a service."""
        srv_class = service_type(srv_type)
        key = ServiceKey(self._resolve(srv_name), type_name(srv_class), qos)
        return Service(srv_class, srv_name, qos, key, checker(srv_class.Request))

    def describe_action(self, wanted: Any, action_name: str) -> Action:
        """Check and resolve an action."""
        action_class = action_type(wanted)
        name = self._resolve(action_name, "action")
        implementation = action_class.Impl
        return Action(
            action_class,
            name,
            type_name(action_class),
            self.describe(implementation.SendGoalService, f"{name}/_action/send_goal", None),
            self.describe(implementation.CancelGoalService, f"{name}/_action/cancel_goal", None),
            self.describe(implementation.GetResultService, f"{name}/_action/get_result", None),
            f"{name}/_action/feedback",
            f"{name}/_action/status",
        )

    def make_message(self, message_type: Any, value: Any) -> Any:
        """Return a message of a type, from a message, a mapping or None."""
        return make_message(message_type, value)

    def deserialize(self, message_type: Any, data: bytes) -> Any:
        """Return a copy of the message that was published."""
        if isinstance(data, _Serialized) and isinstance(data.message, message_type):
            return deepcopy(data.message)
        raise ValueError(f"not a message of {type_name(message_type)}")

    def _resolve(self, given: str, kind: str = "service") -> str:
        """Return the name with a leading slash, that of a private name after the node's."""
        if not isinstance(given, str):
            raise TypeError(f"the name of a {kind} must be a str, not {type(given).__name__}")
        name = f"{self.name}/{given[2:]}" if given.startswith("~/") else given
        if NAME.fullmatch(name) is None:
            raise InvalidServiceName(f"{given!r} is not a valid {kind} name")
        return name if name.startswith("/") else f"/{name}"

    def open_client(self, service: Service, deliver: Deliver) -> FakeClient:
        """Create a client that passes its responses to ``deliver``."""
        client = FakeClient(self, service.key, deliver)
        self.clients.append(client)
        self.graph.changed_soon()
        return client

    def open_service(self, service: Service, deliver: DeliverRequest) -> FakeService:
        """Create a service that passes its requests to ``deliver``."""
        opened = FakeService(self.graph, service.srv_type, service.key.srv_name, deliver)
        opened.identity = _new_identity(self.process)
        self.graph.servers.append(opened)
        self.graph.changed()
        return opened

    def open_publisher(self, msg_type: Any, topic_name: str, qos: TopicQos) -> FakePublisher:
        """Create a publisher."""
        return FakePublisher(self, msg_type, self._resolve(topic_name, "topic"), qos)

    def open_subscription(
        self,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        *,
        raw: bool = False,
    ) -> FakeSubscription:
        """Create a subscription that passes its messages to ``deliver``."""
        return FakeSubscription(
            self, msg_type, self._resolve(topic_name, "topic"), qos, deliver, raw
        )

    def count_servers(self, service: Service) -> int:
        """Return how many servers have this name."""
        return sum(server.srv_name == service.key.srv_name for server in self.graph.servers)

    def count_clients(self, service: Service) -> int:
        """Return how many clients have this name, of all nodes."""
        return sum(
            client.srv_name == service.key.srv_name
            for node in self.graph.nodes
            for client in node.clients
        )

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers of this name and type."""
        return frozenset(
            server.identity
            for server in self.graph.find(service.key.srv_type, service.key.srv_name)
        )

    def name_servers(self, service: Service) -> tuple[str, ...]:
        """Return a name for each server: in memory, servers need no node."""
        servers = self.graph.find(service.key.srv_type, service.key.srv_name)
        return tuple(f"/server_{number}" for number, _ in enumerate(servers, start=1))

    def find_publishers(self, topic_name: str) -> frozenset[Hashable]:
        """Identify the publishers of a topic."""
        return frozenset(
            publisher.identity
            for publisher in self.graph.publishers
            if publisher.topic_name == topic_name
        )

    def explain_missing(self, service: Service) -> str:
        """List the services in the graph, with their types."""
        if mismatch := self.explain_mismatch(service):
            return mismatch
        services = {f"{each.srv_name} ({type_name(each.srv_type)})" for each in self.graph.servers}
        return f"the graph has {', '.join(sorted(services)) or 'no service'}"

    def explain_mismatch(self, service: Service) -> str | None:
        """Describe the servers of the name as a clause, if all of them have another type."""
        name, wanted, _ = service.key
        types = {type_name(s.srv_type) for s in self.graph.servers if s.srv_name == name}
        if not types or wanted in types:
            return None
        return f"this name is served as {' and as '.join(sorted(types))}"

    def explain_silence(self, service: Service) -> str | None:
        """Return None: nothing gets lost in memory."""
        return None

    def stop(self) -> None:
        """Do nothing: there is no thread."""

    def join(self) -> bool:
        """Return True: there is no thread."""
        return True

    async def stopped(self) -> None:
        """Return at once: there is no thread."""

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if self in self.graph.nodes:
            self.graph.nodes.remove(self)


class FakeClient:
    """A client of a `FakeNode`: a `rosasync._core.ports.ClientPort`.

    Attributes:
        sent: the numbers of the requests sent, in order.
        out: the numbers of the outstanding requests.
        most: the maximum number of requests outstanding at once so far.
        identity: what servers tell it by; its beginning names the process.
    """

    def __init__(self, node: FakeNode, key: ServiceKey, deliver: Deliver) -> None:
        self.node = node
        self.srv_name, self.srv_type, _ = key
        self.identity = _new_identity(node.process)
        self.closed = False
        self.sent: list[int] = []
        self.out: set[int] = set()
        self.most = 0
        self._deliver = deliver
        self._numbers = itertools.count(1)

    def send(self, request: Any) -> int:
        """Send a request to every server of the name."""
        number = next(self._numbers)
        self.sent.append(number)
        self.out.add(number)
        self.most = max(self.most, len(self.out))
        if not self.node.graph.dropping_requests:
            for server in self.node.graph.find(self.srv_type, self.srv_name):
                server.receive(self, number, request)
        return number

    def later(self, delay: float, number: int, response: Any) -> None:
        """Deliver a response after ``delay`` seconds, but not in this turn of the loop."""
        loop = asyncio.get_running_loop()
        loop.call_later(delay, self.deliver, number, response)

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
        return bool(self.node.graph.find(self.srv_type, self.srv_name))

    def close(self) -> None:
        """Leave the node; idempotent."""
        if not self.closed:
            self.closed = True
            self.node.clients.remove(self)
            self.node.graph.changed_soon()


class FakePublisher:
    """A publisher of a `FakeNode`: a `rosasync._core.ports.PublisherPort`.

    Attributes:
        published: copies of the messages published, in order.
    """

    def __init__(self, node: FakeNode, msg_type: Any, topic_name: str, qos: TopicQos) -> None:
        self.node = node
        self.msg_type = msg_type
        self.topic_name = topic_name
        self.identity = _new_identity(node.process)
        self.closed = False
        self.published: list[Any] = []
        self._kept: deque[Any] = deque(maxlen=qos.depth if qos.latched else 0)
        node.graph.publishers.append(self)
        for subscription in self._matched():
            subscription.catch_up(self)

    @property
    def kept(self) -> tuple[Any, ...]:
        """The messages that a new latched subscription gets."""
        return tuple(self._kept)

    def publish(self, message: Any) -> None:
        """Send a copy of a message to every subscription of the topic."""
        if isinstance(message, bytes):
            # The only serialized message that rosasync publishes.
            message = make_message(self.msg_type, decode_statuses(message))
        copy = deepcopy(message)
        self.published.append(copy)
        self._kept.append(copy)
        for subscription in self._matched():
            subscription.receive(copy)

    def subscriptions(self) -> int:
        """Return how many subscriptions the topic has."""
        return len(self._matched())

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if not self.closed:
            self.closed = True
            self.node.graph.publishers.remove(self)

    def _matched(self) -> list[FakeSubscription]:
        return [each for each in self.node.graph.subscriptions if each.matches(self)]


class FakeSubscription:
    """A subscription of a `FakeNode`: a `rosasync._core.ports.SubscriptionPort`."""

    def __init__(
        self,
        node: FakeNode,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        raw: bool,
    ) -> None:
        self.node = node
        self.msg_type = msg_type
        self.topic_name = topic_name
        self.closed = False
        self._qos = qos
        self._deliver = deliver
        self._raw = raw
        self._queue: deque[Any] = deque(maxlen=qos.depth)
        self._loop = asyncio.get_running_loop()
        node.graph.subscriptions.append(self)
        for publisher in node.graph.publishers:
            self.catch_up(publisher)

    def matches(self, publisher: FakePublisher) -> bool:
        """Return whether a publisher is of this topic and type."""
        return (publisher.topic_name, publisher.msg_type) == (self.topic_name, self.msg_type)

    def catch_up(self, publisher: FakePublisher) -> None:
        """Receive what a publisher has kept, if this subscription is latched."""
        if self._qos.latched and self.matches(publisher):
            for message in publisher.kept:
                self.receive(message)

    def receive(self, message: Any) -> None:
        """Queue a message and deliver it in the next turn of the loop; the oldest may be lost."""
        if not self._queue:
            self._loop.call_soon(self.drain)
        self._queue.append(message)

    def publishers(self) -> int:
        """Return how many publishers the topic has."""
        return sum(self.matches(publisher) for publisher in self.node.graph.publishers)

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if not self.closed:
            self.closed = True
            self._queue.clear()
            self.node.graph.subscriptions.remove(self)

    def drain(self) -> None:
        """Deliver the queued messages."""
        messages = tuple(self._queue)
        self._queue.clear()
        for message in messages:
            if not self.closed:
                self._deliver(_Serialized.of(message) if self._raw else deepcopy(message))


class _Serialized(bytes):
    """What stands for a serialized message: its head, as far as rosasync reads it, and itself."""

    message: Any

    @classmethod
    def of(cls, message: Any) -> _Serialized:
        """Serialize a message, with the UUID of its goal where the middleware has it."""
        goal_id = getattr(message, "goal_id", None)
        serialized = cls(b"\0\1\0\0" + (b"" if goal_id is None else bytes(goal_id.uuid)))
        serialized.message = message
        return serialized
