"""The ROS graph: events when it changes, and queries for the servers of a service."""

from __future__ import annotations

import contextlib
import difflib
import os
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.waitable import NumberOfEntities, Waitable

from rosasync._core.ports import Servers, Service
from rosasync._core.text import count
from rosasync._ros.endpoints import (
    Endpoint,
    gid_of,
    identified_servers,
    incompatibility,
    response_writers,
    servers_of,
    serves,
)
from rosasync._ros.failures import uses_node
from rosasync._ros.host import ended
from rosasync._ros.names import SEND_GOAL, default_qos
from rosasync._ros.rcl import Rcl
from rosasync._ros.silence import explain_silence

if TYPE_CHECKING:
    from rosasync._core.ports import GraphPort

__all__ = ["GraphQueries", "GraphWaitable", "describe_similar"]

SNAPSHOT_TIME = 0.25
"""Seconds for which a snapshot of the services is used if the node reports no graph events."""

# Sessions in several threads add and remove entries while others read. So it is used by single
# operations only, which are atomic; an iteration would fail when another thread changes it.
_waitables: WeakValueDictionary[int, GraphWaitable] = WeakValueDictionary()


class GraphWaitable(Waitable):  # type: ignore[misc]
    """Waits on the node's graph guard condition and reports every change.

    The guard condition is the context's: the first wait set that sees it triggered resets it. So
    the waitable that is woken informs all others of the same context as well.
    """

    def __init__(self, node: Node, rcl: Rcl, on_change: Callable[[], None]) -> None:
        # The waitable keeps this group alive; the group has only a weak reference to it.
        super().__init__(ReentrantCallbackGroup())
        self.on_change = on_change
        self.context = node.context
        self._node = node
        self._rcl = rcl
        self._entered = False
        self._index: int | None = None
        _waitables[id(self)] = self
        node.add_waitable(self)

    def close(self) -> None:
        """Leave the node; idempotent."""
        _waitables.pop(id(self), None)
        if self in self._node.waitables:
            self._node.remove_waitable(self)

    def __enter__(self) -> None:
        self._entered = False
        self._node.handle.__enter__()
        self._entered = True

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._entered = False
        self._node.handle.__exit__(exc_type, exc, traceback)

    def get_num_entities(self) -> NumberOfEntities:
        """Return the number of entities: one guard condition."""
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add the guard condition, unless the node has been destroyed."""
        self._index = None
        if self._entered:
            self._index = self._rcl.add_graph_guard(self._node.handle, wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        """Return whether the graph has changed."""
        return self._index is not None and wait_set.is_ready("guard_condition", self._index)

    def take_data(self) -> None:
        """Take nothing: the wait has reset the guard condition."""

    async def execute(self, taken_data: None) -> None:
        """Inform every waitable of the context."""
        for reference in _waitables.valuerefs():
            waitable = reference()
            if waitable is not None and waitable.context is self.context:
                waitable.on_change()


class GraphQueries:
    """Queries a node's graph: a `rosasync._core.ports.GraphPort`.

    Used on the loop's thread, except `changed`.

    Args:
        node: the node to query.
        events: whether `changed` is called after every change.
    """

    def __init__(self, node: Node, events: bool) -> None:
        self._node = node
        self._events = events
        self._generation = 0
        # The snapshot: all of one generation. The last two are queried when they are first needed.
        self._served: dict[str, set[str]] = {}
        self._servers: dict[str, list[Endpoint]] = {}
        self._others: dict[str, set[str]] | None = None
        self._served_generation = -1
        self._served_until = 0.0
        # The servers that were found to have ended. That stays so.
        self._ended: set[bytes] = set()

    def changed(self) -> None:
        """Discard the snapshot of the services. From any thread."""
        self._generation += 1

    def count_servers(self, service: Service) -> int:
        """Count the servers of the name; see `rosasync._core.ports.GraphPort.count_servers`."""
        with uses_node(self._node):
            return self._count_servers(service.key.srv_name)

    def count_clients(self, service: Service) -> int:
        """Count the clients of the name; see `rosasync._core.ports.GraphPort.count_clients`."""
        with uses_node(self._node), self._node.handle:
            return int(self._node.handle.get_count_clients(service.key.srv_name))

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers that fit; see `rosasync._core.ports.GraphPort.find_servers`."""
        name, srv_type, _ = service.key
        with uses_node(self._node):
            if found := identified_servers(self._node, name):
                qos = service.qos or default_qos()
                return frozenset(s.gid for s in found if serves(s, service, qos))
            servers = self._count_servers(name)
            if servers and srv_type in self._services().get(name, ()):
                return frozenset(range(servers))
        return frozenset()

    def name_servers(self, service: Service) -> tuple[str, ...]:
        """Name the nodes of the servers; see `rosasync._core.ports.GraphPort.name_servers`."""
        srv_name, srv_type, _ = service.key
        with uses_node(self._node):
            servers = self._servers_of(srv_name)
        return tuple(sorted({s.node for s in servers if s.node and s.srv_type == srv_type}))

    def find_ended(self, servers: Servers) -> Servers:
        """Return those of these servers whose process has certainly ended."""
        with uses_node(self._node):
            gids = (gid for gid in servers if isinstance(gid, bytes))
            found = ended(self._node, gids, self._ended)
        self._ended |= found
        return found

    def find_publishers(self, topic_name: str) -> frozenset[Hashable]:
        """Identify the publishers of a topic, in all processes."""
        with uses_node(self._node):
            # The count takes a microsecond, and the list some hundred.
            if not self._node.count_publishers(topic_name):
                return frozenset()
            return frozenset(map(gid_of, self._node.get_publishers_info_by_topic(topic_name)))

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead of this service, as a clause."""
        srv_name, srv_type, _ = service.key
        with uses_node(self._node):
            if self._count_servers(srv_name):
                return self.explain_mismatch(service) or self._explain_unmatched(service)
            services = self._others_services()
            if not services and len(self._node.get_node_names()) <= 1:
                return f"no server has this name, and no other node is visible in {self._place()}"
        if similar := describe_similar(services, srv_name, srv_type):
            return f"no server has this name; there are {similar}"
        meant = len(_services_meant(services, srv_name))
        kind = "action" if srv_name.endswith(SEND_GOAL) else "service"
        return (
            f"no server has this name or a similar one, among {count(meant, kind)} of "
            "other nodes: start the server, or compare its name and namespace"
        )

    def explain_mismatch(self, service: Service) -> str | None:
        """Describe the servers of the name as a clause, if all of them have another type."""
        srv_name, srv_type, _ = service.key
        with uses_node(self._node):
            servers = self._servers_of(srv_name) if self._count_servers(srv_name) else []
        # A server whose type is not known yet may be the right one.
        if not servers or any(server.srv_type in (srv_type, "") for server in servers):
            return None
        kinds = sorted({server.srv_type for server in servers})
        served = [f"{k}{_by([s for s in servers if s.srv_type == k])}" for k in kinds]
        return f"this name is served as {' and as '.join(served)}"

    def explain_silence(self, service: Service) -> str | None:
        """Describe why no data arrives from a visible server, as a clause, if that is known."""
        srv_name = service.key.srv_name
        with uses_node(self._node):
            if any(server.node for server in self._servers_of(srv_name)):
                return None
            return explain_silence(self._node, response_writers(self._node, srv_name))

    def _explain_unmatched(self, service: Service) -> str:
        srv_name, srv_type, _ = service.key
        servers = [s for s in self._servers_of(srv_name) if s.srv_type == srv_type]
        where = _by(servers)
        if problem := next(filter(None, (_qos_problem(service, s.qos) for s in servers)), None):
            return (
                f"this name and type are served{where}, but with a QoS that does not fit the "
                f"client's ({problem}): call with qos= and the server's QoS"
            )
        return (
            f"this name and type are served{where}, but not matched with the client yet: compare "
            "the QoS, and wait longer if the server or this process has just started"
        )

    def _place(self) -> str:
        """Return where this node looks for others, and what to compare."""
        return (
            f"domain {self._node.context.get_domain_id()} with discovery range "
            f"{_discovery_range()} and {rclpy.get_rmw_implementation_identifier()}: start the "
            "server, or compare its ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE and "
            "RMW_IMPLEMENTATION"
        )

    def _services(self) -> dict[str, set[str]]:
        """Return the types of every service that has a server, as they were a moment ago.

        A snapshot takes one query for each service, and many callers may need it at the same time.
        """
        now = monotonic()
        fresh = self._events or now < self._served_until
        if self._served_generation != self._generation or not fresh:
            # Read before the queries, so that a change during them discards the snapshot.
            generation = self._generation
            self._servers, self._others = {}, None
            self._served = self._query_services()
            self._served_generation = generation
            self._served_until = now + SNAPSHOT_TIME
        return self._served

    def _query_services(self) -> dict[str, set[str]]:
        """Query the types of every service that has a server.

        The graph lists a name with the types of its servers and of its clients, including this
        session's. If they differ, the servers are asked.
        """
        services: dict[str, set[str]] = {}
        for srv_name, types in self._node.get_service_names_and_types():
            if self._count_servers(srv_name):
                known = len(types) > 1 and {s.srv_type for s in servers_of(self._node, srv_name)}
                services[srv_name] = known or set(types)
        return services

    def _servers_of(self, srv_name: str) -> list[Endpoint]:
        """Return the servers of a resolved name, as they were a moment ago."""
        self._services()
        if srv_name not in self._servers:
            self._servers[srv_name] = servers_of(self._node, srv_name)
        return self._servers[srv_name]

    def _others_services(self) -> dict[str, set[str]]:
        """Return the services that have a server which is not this node's own.

        The node's own are counted, because the graph shows nodes of the same name as one.
        """
        services = self._services()
        if self._others is None:
            own = Counter(_names_of(self._node.services))
            self._others = {n: t for n, t in services.items() if self._count_servers(n) > own[n]}
        return self._others

    def _count_servers(self, srv_name: str) -> int:
        """Return how many servers of this resolved name the graph shows, of any type."""
        with self._node.handle:
            return int(self._node.handle.get_count_services(srv_name))


def describe_similar(
    services: Mapping[str, Iterable[str]], srv_name: str, srv_type: str = ""
) -> str:
    """List the services that may be meant by a name that has no server; empty if there are none.

    Args:
        services: the types of the services in the graph, by name.
        srv_name: the name.
        srv_type: the type that is meant, if it is known: services of this type are listed too.
    """
    services = _services_meant(services, srv_name)
    similar = difflib.get_close_matches(srv_name, services, n=3, cutoff=0.7)
    same_type = sorted(name for name, types in services.items() if srv_type in types)
    names = dict.fromkeys([*similar, *same_type[:3]])
    return ", ".join(f"{name} ({', '.join(sorted(services[name]))})" for name in names)


def _services_meant(
    services: Mapping[str, Iterable[str]], srv_name: str
) -> Mapping[str, Iterable[str]]:
    """Return the services that a name without a server may mean: those of actions, or the others.

    An action is one of its services here; the others of it are not what is meant.
    """
    if srv_name.endswith(SEND_GOAL):
        return {name: types for name, types in services.items() if name.endswith(SEND_GOAL)}
    if "/_" not in srv_name:
        return {name: types for name, types in services.items() if "/_" not in name}
    return services


def _names_of(services: Iterable[Any]) -> list[str]:
    """Return the resolved names of a node's services, except those that were just destroyed."""
    names = []
    for service in tuple(services):
        with contextlib.suppress(InvalidHandle):
            names.append(service.service_name)
    return names


def _qos_problem(service: Service, theirs: QoSProfile | None) -> str | None:
    """Return why a server's QoS does not fit the client's, None if it does or is not known."""
    if theirs is None:
        return None
    ours = service.qos or default_qos()
    problem = incompatibility(ours, theirs) or incompatibility(theirs, ours)
    return problem and problem.removeprefix("ERROR: ").strip("; ")


def _by(servers: Iterable[Endpoint]) -> str:
    """Return `` by node /a``, `` by nodes /a and /b``, or nothing while no name is known."""
    names = sorted({server.node for server in servers if server.node})
    return f" by node{'s' * (len(names) > 1)} {' and '.join(names)}" if names else ""


def _discovery_range() -> str:
    """Return how far the environment lets this process discover others."""
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        return "LOCALHOST (ROS_LOCALHOST_ONLY=1)"
    return (os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET").upper()


if TYPE_CHECKING:

    def _fits(queries: GraphQueries) -> GraphPort:
        return queries
