"""A ROS graph in memory and its nodes."""

from __future__ import annotations

import asyncio
import itertools
import re
import time
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

from rosasync._core.ports import Action, Service
from rosasync._ros.checks import checker
from rosasync._ros.messages import make_message
from rosasync._ros.types import action_type, service_type, type_name
from rosasync.errors import InvalidServiceName
from rosasync.statistics import ServiceKey
from rosasync.testing._memory.services import MemoryClient, MemoryServer, MemoryService
from rosasync.testing._memory.topics import (
    MemoryPublisher,
    MemorySubscription,
    Topics,
    deserialize,
)

if TYPE_CHECKING:
    from rosasync._core.ports import Deliver, DeliverMessage, DeliverRequest, TopicQos
    from rosasync.testing._memory.services import ServiceGraph

__all__ = ["MemoryGraph", "MemoryNode", "MemoryQueries", "new_identity", "new_process"]

NAME = re.compile(r"/?[a-z_]\w*(/[a-z_]\w*)*", re.ASCII | re.IGNORECASE)
"""A name that ROS allows."""
SEND_GOAL = re.compile("/_action/send_goal$")
"""The service that stands for its action in a list."""
PLAIN = re.compile("^(?!.*/_action/)")
"""A service that is no part of an action."""


_numbers = itertools.count(1)


def new_process() -> bytes:
    """Return what the identities of a process begin with, as long as in the middleware."""
    return next(_numbers).to_bytes(12, "big")


def new_identity(process: bytes) -> bytes:
    """Return the identity of a client or server of a process."""
    return process + next(_numbers).to_bytes(4, "big")


class MemoryGraph:
    """A ROS graph in memory, in which nothing gets lost. Confined to one loop's thread.

    Attributes:
        graph_events: whether its nodes learn of its changes.
    """

    graph_events = True

    def __init__(self) -> None:
        self.servers: list[MemoryServer] = []
        self.clients: list[MemoryClient] = []
        self.nodes: list[MemoryNode] = []
        self.topics = Topics()

    def changed(self) -> None:
        """Report a change of the graph to every node."""
        if self.graph_events:
            for node in tuple(self.nodes):
                node.on_graph()

    def changed_soon(self) -> None:
        """Report a change of the graph in the loop's next turn."""
        asyncio.get_running_loop().call_soon(self.changed)

    def find(self, srv_type: str, srv_name: str) -> list[MemoryServer]:
        """Return the servers of a service, by the names of its type and the service."""
        return [
            server
            for server in self.servers
            if server.srv_name == srv_name and type_name(server.srv_type) == srv_type
        ]

    def carry_request(
        self, server: MemoryServer, client: MemoryClient, number: int, request: Any
    ) -> None:
        """Pass a request to a server."""
        server.receive(client, number, request)

    def carry_response(self, client: MemoryClient, number: int, response: Any) -> None:
        """Pass a response to a client, but not in this turn of the loop."""
        asyncio.get_running_loop().call_soon(client.deliver, number, response)


class MemoryQueries:
    """What a `MemoryGraph` shows: a `rosasync._core.ports.GraphPort`."""

    def __init__(self, graph: MemoryGraph) -> None:
        self._graph = graph

    def count_servers(self, service: Service) -> int:
        """Return how many servers have this name."""
        return sum(server.srv_name == service.key.srv_name for server in self._graph.servers)

    def count_clients(self, service: Service) -> int:
        """Return how many clients have this name, of all nodes."""
        return sum(client.srv_name == service.key.srv_name for client in self._graph.clients)

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers of this name and type."""
        return frozenset(
            server.identity
            for server in self._graph.find(service.key.srv_type, service.key.srv_name)
        )

    def find_ended(self, servers: frozenset[Hashable]) -> frozenset[Hashable]:
        """Return none of these servers: in memory, one that ends leaves the graph."""
        return frozenset()

    def name_servers(self, service: Service) -> tuple[str, ...]:
        """Return a name for each server: in memory, servers need no node."""
        servers = self._graph.find(service.key.srv_type, service.key.srv_name)
        return tuple(f"/server_{number}" for number, _ in enumerate(servers, start=1))

    def find_publishers(self, topic_name: str) -> frozenset[Hashable]:
        """Identify the publishers of a topic."""
        return frozenset(
            publisher.identity
            for publisher in self._graph.topics.publishers
            if publisher.topic_name == topic_name
        )

    def explain_missing(self, service: Service) -> str:
        """List the services in the graph, or the actions, with their types."""
        if mismatch := self.explain_mismatch(service):
            return mismatch
        action = "/_action/" in service.key.srv_name
        names = [
            f"{each.srv_name} ({type_name(each.srv_type)})"
            for each in self._graph.servers
            if (SEND_GOAL if action else PLAIN).search(each.srv_name)
        ]
        nothing = "no action" if action else "no service"
        return f"the graph has {', '.join(sorted(set(names))) or nothing}"

    def explain_mismatch(self, service: Service) -> str | None:
        """Describe the servers of the name as a clause, if all of them have another type."""
        name, wanted, _ = service.key
        types = {type_name(s.srv_type) for s in self._graph.servers if s.srv_name == name}
        if not types or wanted in types:
            return None
        return f"this name is served as {' and as '.join(sorted(types))}"

    def explain_silence(self, service: Service) -> str | None:
        """Return None: nothing gets lost in memory."""
        return None


class MemoryNode:
    """A node of a `MemoryGraph`: a `rosasync._core.ports.NodePort`."""

    bridge = "memory"
    executor_thread: int | None = None

    def __init__(
        self,
        graph: MemoryGraph,
        on_graph: Callable[[], None] = lambda: None,
        on_shutdown: Callable[[], None] = lambda: None,
        name: str = "memory",
    ) -> None:
        self.graph = graph
        self.queries = MemoryQueries(graph)
        self.name = name
        self.node = self
        self.process = new_process()
        self._loop = asyncio.get_running_loop()
        self._epoch = time.time_ns() - int(self._loop.time() * 1e9)
        self.up = True
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

    @property
    def clients(self) -> list[MemoryClient]:
        """The clients of this node, in the order of their creation."""
        return [each for each in self.graph.clients if each.identity.startswith(self.process)]

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
        return deserialize(message_type, data)

    def deserialize_feedback(self, action_type: Any, data: bytes) -> Any:
        """Return a copy of the feedback in a message that was published."""
        return deserialize(action_type.Impl.FeedbackMessage, data).feedback

    def _resolve(self, given: str, kind: str = "service") -> str:
        """Return the name with a leading slash, that of a private name after the node's."""
        if not isinstance(given, str):
            raise TypeError(f"the name of the {kind} must be a str, not {type(given).__name__}")
        name = f"{self.name}/{given[2:]}" if given.startswith("~/") else given
        if NAME.fullmatch(name) is None:
            raise InvalidServiceName(f"{given!r} is not a valid {kind} name")
        return name if name.startswith("/") else f"/{name}"

    def open_client(self, service: Service, deliver: Deliver) -> MemoryClient:
        """Create a client that passes its responses to ``deliver``."""
        return MemoryClient(self.graph, service.key, deliver, new_identity(self.process))

    def open_service(self, service: Service, deliver: DeliverRequest) -> MemoryService:
        """Create a service that passes its requests to ``deliver``."""
        opened = MemoryService(
            self.graph,
            service.srv_type,
            service.key.srv_name,
            deliver,
            new_identity(self.process),
        )
        opened.enter()
        return opened

    def open_publisher(self, msg_type: Any, topic_name: str, qos: TopicQos) -> MemoryPublisher:
        """Create a publisher."""
        name = self._resolve(topic_name, "topic")
        self.graph.changed_soon()
        return MemoryPublisher(self.graph.topics, msg_type, name, qos, new_identity(self.process))

    def open_subscription(
        self,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        *,
        raw: bool = False,
    ) -> MemorySubscription:
        """Create a subscription that passes its messages to ``deliver``."""
        name = self._resolve(topic_name, "topic")
        self.graph.changed_soon()
        return MemorySubscription(self.graph.topics, msg_type, name, qos, deliver, raw)

    def stop(self) -> None:
        """Do nothing: there is no thread."""

    def join(self) -> bool:
        """Return True: there is no thread."""
        return True

    async def wait_stopped(self) -> None:
        """Return at once: there is no thread."""

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if self in self.graph.nodes:
            self.graph.nodes.remove(self)


if TYPE_CHECKING:

    def _fits(graph: MemoryGraph) -> ServiceGraph:
        return graph
