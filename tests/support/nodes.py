"""Nodes and their ports without a session."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import Any

import rclpy
from rclpy.signals import SignalHandlerOptions

from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import (
    ClientPort,
    Deliver,
    DeliverRequest,
    GraphPort,
    NodePort,
    Service,
    ServicePort,
)
from rosasync._ros.node import RosNode
from rosasync.options import Limits, SessionOptions
from tests.support.echo import ECHO, answer_to
from tests.support.serving import echo_of

__all__ = ["Opened", "Reports", "borrowed_node", "open_node", "reports"]


class Opened:
    """An open node, with what its clients and services have delivered.

    Attributes:
        ros: the node.
        responses: sequence number and text of each response.
        requests: each request with its header.
        changes: how many changes of the graph were reported.
        shutdowns: how often the end of the context was reported.
    """

    ros: RosNode

    def __init__(self) -> None:
        self.responses: list[tuple[int, str]] = []
        self.requests: list[tuple[Any, Any]] = []
        self.changes = 0
        self.shutdowns = 0

    @property
    def port(self) -> NodePort:
        """The node, typed as the port that the core uses."""
        return self.ros

    @property
    def queries(self) -> GraphPort:
        """What the node's graph shows."""
        return self.ros.queries

    def service(self, name: str = "/echo", srv_type: Any = ECHO, qos: Any = None) -> Service:
        return self.ros.describe(srv_type, name, qos)

    def client(
        self,
        name: str = "/echo",
        srv_type: Any = ECHO,
        qos: Any = None,
        deliver: Deliver | None = None,
    ) -> ClientPort:
        service = self.service(name, srv_type, qos)
        return self.ros.open_client(service, deliver or self._respond)

    def serve(
        self,
        name: str = "/echo",
        srv_type: Any = ECHO,
        qos: Any = None,
        deliver: DeliverRequest | None = None,
    ) -> ServicePort:
        service = self.service(name, srv_type, qos)
        return self.ros.open_service(service, deliver or self._request)

    def answer(self, port: ServicePort, number: int = 0) -> None:
        """Send the response to a request."""
        request, header = self.requests[number]
        port.send(header, echo_of(request))

    def changed(self) -> None:
        self.changes += 1

    def shut_down(self) -> None:
        self.shutdowns += 1

    def _respond(self, sequence_number: int, response: Any) -> None:
        self.responses.append((sequence_number, answer_to(response)))

    def _request(self, request: Any, header: Any) -> None:
        self.requests.append((request, header))


@asynccontextmanager
async def open_node(bridge: str, node: Any = "test_node", **options: Any) -> AsyncIterator[Opened]:
    """Open a node as a session does, and close it."""
    opened = Opened()
    gateway = LoopGateway()
    values = {
        "context": None,
        "executor": None,
        "limits": Limits(),
        "timeout": None,
        "busy_poll": 0.0,
        "introspection": "off",
    }
    checked = SessionOptions(node=node, bridge=bridge, **{**values, **options})  # type: ignore[arg-type]
    opened.ros = RosNode(checked, gateway, opened.changed, opened.shut_down)
    try:
        yield opened
    finally:
        opened.ros.stop()
        await opened.ros.wait_stopped()
        assert opened.ros.join()
        gateway.close()
        opened.ros.close()


@contextmanager
def borrowed_node(name: str = "lender") -> Iterator[Any]:
    """A node, and a context, that no session owns."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(name, context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        context.try_shutdown()


class Reports(list[dict[str, Any]]):
    """The reports to the loop's exception handler."""

    @property
    def errors(self) -> list[str]:
        return [str(details["exception"]) for details in self]


@contextmanager
def reports() -> Iterator[Reports]:
    """Collect the reports to the loop's exception handler in this block."""
    loop = asyncio.get_running_loop()
    collected = Reports()
    before = loop.get_exception_handler()
    loop.set_exception_handler(lambda _, details: collected.append(details))
    try:
        yield collected
    finally:
        loop.set_exception_handler(before)
