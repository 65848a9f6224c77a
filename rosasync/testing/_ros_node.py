"""The node of a `GraphSession` on real ROS."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rosasync._ros.graph import GraphQueries
from rosasync._ros.node import RosNode

if TYPE_CHECKING:
    from rosasync._core.gateway import LoopGateway
    from rosasync._core.ports import ClientPort, Deliver, DeliverRequest, Service, ServicePort
    from rosasync.options import SessionOptions
    from rosasync.testing._hooks import Hooks

__all__ = ["HookedRosNode"]


class HookedRosNode(RosNode):
    """A node on real ROS, with hooks."""

    def __init__(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
        hooks: Hooks,
    ) -> None:
        # First, because the opening makes the queries.
        self._hooks = hooks
        super().__init__(options, gateway, on_graph, on_shutdown)

    def open_client(self, service: Service, deliver: Deliver) -> ClientPort:
        """Create a client that passes its responses to ``deliver``."""
        return self._hooks.open_client(super().open_client, service, deliver)

    def open_service(self, service: Service, deliver: DeliverRequest) -> ServicePort:
        """Create a service that passes its requests to ``deliver``."""
        return self._hooks.open_service(super().open_service, service, deliver)

    def _make_queries(self, events: bool) -> GraphQueries:
        return _HookedQueries(self.node, events, self._hooks)


class _HookedQueries(GraphQueries):
    """Queries that report a service which was called and has no server."""

    def __init__(self, node: Any, events: bool, hooks: Hooks) -> None:
        super().__init__(node, events)
        self._hooks = hooks

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead, and report that the service is missing."""
        self._hooks.report_missing(service)
        return super().explain_missing(service)
