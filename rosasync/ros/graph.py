"""The ROS graph: events when it changes, and queries for the servers of a service."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Callable, Hashable
from time import monotonic
from types import TracebackType
from typing import Any
from weakref import WeakValueDictionary

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable

from rosasync.ports import Service
from rosasync.ros.endpoints import gid_of, response_writers, serves
from rosasync.ros.failures import uses_node
from rosasync.ros.names import default_qos
from rosasync.ros.rcl import Rcl

__all__ = ["GraphQueries", "GraphWaitable"]

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
    """Queries a node's graph for services. Used on the loop's thread, except `changed`.

    Args:
        node: the node to query.
        events: whether `changed` is called after every change.
    """

    def __init__(self, node: Node, events: bool) -> None:
        self._node = node
        self._events = events
        self._generation = 0
        self._served: dict[str, set[str]] = {}
        self._served_generation = -1
        self._served_until = 0.0

    def changed(self) -> None:
        """Discard the snapshot of the services. From any thread."""
        self._generation += 1

    def count_servers(self, service: Service) -> int:
        """Count the servers of the name; see `rosasync.ports.NodePort.count_servers`."""
        with uses_node(self._node):
            return self._count_servers(service.key.srv_name)

    def count_clients(self, service: Service) -> int:
        """Count the clients of the name; see `rosasync.ports.NodePort.count_clients`."""
        with uses_node(self._node), self._node.handle:
            return int(self._node.handle.get_count_clients(service.key.srv_name))

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers that fit; see `rosasync.ports.NodePort.find_servers`."""
        name, srv_type, _ = service.key
        with uses_node(self._node):
            if writers := response_writers(self._node, name):
                qos = service.qos or default_qos()
                return frozenset(gid_of(w) for w in writers if serves(w, service, qos))
            # Another middleware than Fast DDS may name the topics otherwise.
            servers = self._count_servers(name)
            if servers and srv_type in self._services().get(name, ()):
                return frozenset(range(servers))
        return frozenset()

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead of this service, as a clause."""
        srv_name, srv_type, _ = service.key
        with uses_node(self._node):
            services = self._services()
            if types := services.get(srv_name):
                return self._explain_mismatch(srv_name, srv_type, types)
            if services.keys() <= self._own_services():
                return (
                    "no server has this name, and no other node's services are visible: compare "
                    "ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE with the server's"
                )
        same_type = sorted(name for name, types in services.items() if srv_type in types)
        similar = difflib.get_close_matches(srv_name, services, n=3, cutoff=0.7)
        if names := list(dict.fromkeys([*similar, *same_type[:3]])):
            listed = ", ".join(f"{name} ({', '.join(sorted(services[name]))})" for name in names)
            return f"no server has this name; there are {listed}"
        return f"no server has this name or a similar one, among {len(services)} services"

    def _explain_mismatch(self, srv_name: str, srv_type: str, types: set[str]) -> str:
        servers = self._count_servers(srv_name)
        if srv_type in types:
            return (
                f"{servers} server(s) of this name and type are in the graph but not matched "
                "with the client: compare the QoS"
            )
        return f"this name is served as {', '.join(sorted(types))} ({servers} server(s))"

    def _services(self) -> dict[str, set[str]]:
        """Return the types of every service that has a server, as they were a moment ago.

        A snapshot takes one query for each service, and many callers may need it at the same time.
        """
        now = monotonic()
        fresh = self._events or now < self._served_until
        if self._served_generation != self._generation or not fresh:
            # Read before the queries, so that a change during them discards the snapshot.
            generation = self._generation
            self._served = self._query_services()
            self._served_generation = generation
            self._served_until = now + SNAPSHOT_TIME
        return self._served

    def _query_services(self) -> dict[str, set[str]]:
        """Query the types of every service that has a server.

        The graph lists a name with the types of its servers and of its clients, including this
        session's. If they differ, each node is asked for the types that it serves. That answer may
        be some milliseconds old.
        """
        services: dict[str, set[str]] = {}
        for srv_name, types in self._node.get_service_names_and_types():
            if self._count_servers(srv_name):
                known = self._query_nodes(srv_name) if len(types) > 1 else None
                services[srv_name] = known or set(types)
        return services

    def _query_nodes(self, srv_name: str) -> set[str]:
        types: set[str] = set()
        for node in self._node.get_node_names_and_namespaces():
            types.update(self._services_of(*node).get(srv_name, ()))
        return types

    def _own_services(self) -> set[str]:
        return set(self._services_of(self._node.get_name(), self._node.get_namespace()))

    def _services_of(self, name: str, namespace: str) -> dict[str, list[str]]:
        # The node may have left the graph since it was listed.
        with contextlib.suppress(rclpy_implementation.NodeNameNonExistentError):
            return dict(self._node.get_service_names_and_types_by_node(name, namespace))
        return {}

    def _count_servers(self, srv_name: str) -> int:
        """Return how many servers of this resolved name the graph shows, of any type."""
        with self._node.handle:
            return int(self._node.handle.get_count_services(srv_name))
