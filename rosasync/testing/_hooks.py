"""Sessions of a `Graph`: their nodes, in memory and on real ROS, report to the graph."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from rosasync._core.opening import RosOpener
from rosasync.session import Session
from rosasync.testing._memory.graph import MemoryNode, MemoryQueries

if TYPE_CHECKING:
    from rosasync._core.gateway import LoopGateway
    from rosasync._core.ports import (
        ClientPort,
        Deliver,
        DeliverRequest,
        NodePort,
        Service,
        ServicePort,
    )
    from rosasync.options import SessionOptions
    from rosasync.testing._faults import OpenService
    from rosasync.testing._memory.graph import MemoryGraph

__all__ = ["GraphSession", "HookedMemoryNode", "Hooks", "OpenClient"]

OpenClient: TypeAlias = "Callable[[Service, Deliver], ClientPort]"
"""Opens a client's port."""


@dataclass
class Hooks:
    """What a node calls for its clients and services.

    Attributes:
        wrap_client: opens a client with the function it is given, and returns what to use instead.
        wrap_service: the same for a service.
        on_missing: called with a service that was called and has no server.
    """

    wrap_client: Callable[[OpenClient, Service, Deliver], ClientPort] | None = None
    wrap_service: Callable[[OpenService, Service, DeliverRequest], ServicePort] | None = None
    on_missing: Callable[[Service], None] | None = None

    def open_client(self, opener: OpenClient, service: Service, deliver: Deliver) -> ClientPort:
        """Open a client."""
        if self.wrap_client is None:
            return opener(service, deliver)
        return self.wrap_client(opener, service, deliver)

    def open_service(
        self, opener: OpenService, service: Service, deliver: DeliverRequest
    ) -> ServicePort:
        """Open a service."""
        if self.wrap_service is None:
            return opener(service, deliver)
        return self.wrap_service(opener, service, deliver)

    def report_missing(self, service: Service) -> None:
        """Report a service that was called and has no server."""
        if self.on_missing is not None:
            self.on_missing(service)


class GraphSession(Session):
    """A session whose node has hooks.

    Args:
        hooks: what its node calls.
        memory: the graph in memory; None for real ROS.
        node: the node's name, or on real ROS an rclpy node.
        options: those of `rosasync.Session`.
    """

    def __init__(self, hooks: Hooks, memory: MemoryGraph | None, node: Any, **options: Any) -> None:
        super().__init__(node, **options)
        self._opening.opener = _HookedOpener(hooks, memory)


class _HookedOpener(RosOpener):
    """Opens nodes that have hooks, in memory and on real ROS."""

    def __init__(self, hooks: Hooks, memory: MemoryGraph | None) -> None:
        self._hooks = hooks
        self._memory = memory

    async def load(self) -> None:
        """Import what the nodes need: a graph in memory needs no rclpy."""
        if self._memory is None:
            await super().load()

    def open(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> NodePort:
        """Open a node."""
        if self._memory is not None:
            name = str(options.node)
            return HookedMemoryNode(self._memory, self._hooks, name, on_graph, on_shutdown)
        # Only now, because a graph in memory needs no rclpy.
        module = importlib.import_module("rosasync.testing._ros_node")
        node: NodePort = module.HookedRosNode(options, gateway, on_graph, on_shutdown, self._hooks)
        return node


class HookedMemoryNode(MemoryNode):
    """A node in memory, with hooks."""

    def __init__(
        self,
        graph: MemoryGraph,
        hooks: Hooks,
        name: str,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> None:
        super().__init__(graph, on_graph, on_shutdown, name)
        self.queries = _HookedQueries(graph, hooks)
        self._hooks = hooks

    def open_client(self, service: Service, deliver: Deliver) -> Any:
        """Create a client that passes its responses to ``deliver``."""
        return self._hooks.open_client(super().open_client, service, deliver)

    def open_service(self, service: Service, deliver: DeliverRequest) -> Any:
        """Create a service that passes its requests to ``deliver``."""
        return self._hooks.open_service(super().open_service, service, deliver)


class _HookedQueries(MemoryQueries):
    """Queries that report a service which was called and has no server."""

    def __init__(self, graph: MemoryGraph, hooks: Hooks) -> None:
        super().__init__(graph)
        self._hooks = hooks

    def explain_missing(self, service: Service) -> str:
        """List the services in the graph, and report that this one is missing."""
        self._hooks.report_missing(service)
        return super().explain_missing(service)
