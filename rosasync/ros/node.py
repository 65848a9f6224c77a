"""One node for a session: made or borrowed, with its executor thread, its bridge and its graph."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
import logging
from collections.abc import Callable, Hashable
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.expand_topic_name import expand_topic_name
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_services_default, qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_full_topic_name import validate_full_topic_name

from rosasync.errors import InvalidServiceName, UsageError
from rosasync.gateway import LoopGateway
from rosasync.options import SessionOptions
from rosasync.ports import ClientPort, Deliver, DeliverRequest, Service, ServicePort
from rosasync.ros import rcl
from rosasync.ros.direct_bridge import DirectBridge
from rosasync.ros.executor_bridge import ExecutorBridge
from rosasync.ros.executor_thread import ExecutorThread
from rosasync.ros.graph import GraphWaitable
from rosasync.ros.messages import request_message, service_type, type_name
from rosasync.statistics import ServiceKey

__all__ = ["RosNode"]

logger = logging.getLogger("rosasync")

DEPTH = 1000
"""History of the default QoS: ten, rclpy's, is where requests and responses get lost."""

DIRECT_TRIED = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""The middlewares on which ``bridge="auto"`` takes the direct bridge."""

JOIN = 5.0
"""Seconds for the executor thread to finish the callback under way."""


class RosNode:
    """What a session has of ROS. Made, used and closed on the loop's thread.

    Args:
        options: the session's.
        gateway: the way into the loop.
        on_graph: called on the loop's thread after a change of the graph.
        on_shutdown: called on the loop's thread when the context goes down.
    """

    def __init__(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> None:
        node, executor = options.node, options.executor
        if not isinstance(node, str | Node):
            kind = type(node).__name__
            raise TypeError(f"node must be a name or an rclpy.node.Node, not {kind}")
        self._loop = asyncio.get_running_loop()
        self._gateway = gateway
        self._on_graph = on_graph
        self._on_shutdown = on_shutdown
        self._introspection = options.introspection
        self._graph_pending = False
        self._thread: ExecutorThread | None = None
        self._thread_ended = asyncio.Event()
        self._own_context: Context | None = None
        self._own_executor: Executor | None = None
        self._added = False
        self._owned = isinstance(node, str)
        self._waitable: GraphWaitable | None = None
        self._direct_rcl = rcl.load()
        self._bridge: DirectBridge | ExecutorBridge | None = None
        try:
            self.node = self._make_node(node, options.context) if isinstance(node, str) else node
            if executor is not None:
                self._added = executor.add_node(self.node)
            foreign = self.node.executor
            self._bridge = self._make_bridge(options.bridge, foreign, options.busy_poll)
            if self._direct_rcl is not None and not _takes_callbacks(foreign):
                self._waitable = GraphWaitable(self.node, self._direct_rcl, self._post_graph)
            self.node.context.on_shutdown(self._post_shutdown)
            if foreign is None:
                self._spin()
        except BaseException:
            self.stop()
            self.close()
            raise

    @property
    def bridge(self) -> str:
        """The bridge taken: ``"direct"`` or ``"executor"``."""
        assert self._bridge is not None
        return self._bridge.name

    @property
    def graph_events(self) -> bool:
        """Whether changes of the graph are told."""
        return self._waitable is not None

    @property
    def name(self) -> str:
        """The node's name."""
        return str(self.node.get_name())

    @property
    def executor_thread(self) -> int | None:
        """Identifier of the executor thread, where this node has one."""
        return None if self._thread is None else self._thread.ident

    def ok(self) -> bool:
        """Tell whether node and context are still up."""
        return bool(self.node.context.ok()) and bool(self.node.handle.pointer)

    def describe(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Check and resolve a service."""
        if qos is not None and not isinstance(qos, QoSProfile):
            raise TypeError(f"qos must be an rclpy QoSProfile, not {type(qos).__name__}")
        srv_class = service_type(srv_type)
        qos_key = None if qos is None else str(qos)
        key = ServiceKey(self._resolve(srv_name), type_name(srv_class), qos_key)
        return Service(srv_class, srv_name, qos, key)

    def make_request(self, srv_type: Any, request: Any) -> Any:
        """Return a message of the request type."""
        return request_message(srv_type, request)

    def _resolve(self, srv_name: str) -> str:
        """Return the expanded and remapped name."""
        if not isinstance(srv_name, str):
            raise TypeError(f"a service name is a str, not {type(srv_name).__name__}")
        try:
            name = expand_topic_name(srv_name, self.node.get_name(), self.node.get_namespace())
            validate_full_topic_name(name, is_service=True)
            return str(self.node.resolve_service_name(srv_name))
        except (
            InvalidServiceNameException,
            InvalidTopicNameException,
            ValueError,
        ) as error:
            reason = str(error).strip().replace("\n", " ")
            raise InvalidServiceName(f"{srv_name!r} is no service name: {reason}") from None

    def open_client(self, service: Service, deliver: Deliver) -> ClientPort:
        """Make a client whose responses go to ``deliver``."""
        assert self._bridge is not None
        try:
            return self._bridge.open_client(
                service.srv_type, service.srv_name, service.qos or default_qos(), deliver
            )
        except rclpy_implementation.RCLError as error:
            if "incompatible type" in str(error):
                raise UsageError(
                    f"{service.key.srv_name}: this process already has a client or server of this "
                    f"name with another type than {service.key.srv_type}, and the middleware "
                    "allows only one"
                ) from error
            raise

    def open_service(self, service: Service, deliver: DeliverRequest) -> ServicePort:
        """Make a service whose requests go to ``deliver``."""
        assert self._bridge is not None
        return self._bridge.open_service(
            service.srv_type, service.srv_name, service.qos or default_qos(), deliver
        )

    def count_servers(self, service: Service) -> int:
        """Return how many servers have the name, whatever their type."""
        return self._servers(service.key.srv_name)

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers that fit."""
        name, srv_type, _ = service.key
        if servers := self._servers(name):
            return (
                frozenset(range(servers))
                if srv_type in self._served().get(name, ())
                else frozenset()
            )
        return frozenset()

    def _servers(self, srv_name: str) -> int:
        """Return how many servers of this resolved name the graph shows, whatever their type."""
        with self.node.handle:
            return int(self.node.handle.get_count_services(srv_name))

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead of this service, as a clause."""
        srv_name, srv_type, _ = service.key
        services = self._served()
        servers = self._servers(srv_name)
        if types := services.get(srv_name):
            if srv_type in types:
                return (
                    f"{servers} server(s) of this name and type are in the graph but not matched "
                    f"with the client: compare the QoS"
                )
            return f"this name is served as {', '.join(types)} ({servers} server(s))"
        same_type = sorted(name for name, types in services.items() if srv_type in types)
        similar = difflib.get_close_matches(srv_name, services, n=3, cutoff=0.7)
        if names := list(dict.fromkeys([*similar, *same_type[:3]])):
            listed = ", ".join(f"{name} ({', '.join(services[name])})" for name in names)
            return f"no server has this name; there are {listed}"
        return f"no server has this name, nor one like it, among {len(services)} services seen"

    def stop(self) -> None:
        """Ask the executor thread to end. From any thread; idempotent."""
        if self._thread is not None:
            self._thread.stop()

    def join(self) -> bool:
        """Wait for the executor thread to end, and tell whether it did; blocks."""
        return self._thread is None or self._thread.join(JOIN)

    async def stopped(self) -> None:
        """Wait, after `stop`, until `join` has nothing to wait for, and `close` destroys safely."""
        if self._thread is not None:
            await self._thread_ended.wait()
        if self._bridge is not None:
            await asyncio.sleep(self._bridge.destroy_delay)

    def close(self) -> None:
        """Give back what was borrowed and destroy what is owned; after `stop` and `join`."""
        if self._waitable is not None:
            self._waitable.close()
        if self._bridge is not None:
            self._bridge.close()
        if self._added:
            self.node.executor = None
        if self._own_executor is not None:
            self._own_executor.shutdown()
        if self._owned and hasattr(self, "node"):
            self.node.destroy_node()
        if self._own_context is not None:
            self._own_context.try_shutdown()

    def _served(self) -> dict[str, set[str]]:
        """Return the types of every service that has a server.

        The graph lists a name with the types of those who serve it and of those who ask for it,
        this session too. Where they differ, the nodes tell who serves what; that news may be some
        milliseconds younger.
        """
        services: dict[str, set[str]] = {}
        for srv_name, types in self.node.get_service_names_and_types():
            if self._servers(srv_name):
                known = self._served_by_nodes(srv_name) if len(types) > 1 else None
                services[srv_name] = known or set(types)
        return services

    def _served_by_nodes(self, srv_name: str) -> set[str]:
        types: set[str] = set()
        for node in self.node.get_node_names_and_namespaces():
            # A node may leave the graph meanwhile.
            with contextlib.suppress(rclpy_implementation.NodeNameNonExistentError):
                served = dict(self.node.get_service_names_and_types_by_node(*node))
                types.update(served.get(srv_name, ()))
        return types

    def _make_node(self, name: str, context: Context | None) -> Node:
        if context is None:
            context = self._own_context = Context()
            rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        elif not context.ok():
            raise UsageError("the context is not initialised, or was shut down: rclpy.init() it")
        return Node(name, context=context)

    def _make_bridge(
        self, bridge: str, executor: Executor | None, busy_poll: float
    ) -> DirectBridge | ExecutorBridge:
        tried = rclpy.get_rmw_implementation_identifier() in DIRECT_TRIED
        takes = _takes_callbacks(executor)
        if bridge == "direct" and (self._direct_rcl is None or takes):
            reason = "an EventsExecutor takes the responses" if takes else "librcl is out of reach"
            raise UsageError(f"bridge='direct' does not work here: {reason}")
        executor_only = self._direct_rcl is None or takes or (bridge == "auto" and not tried)
        if bridge == "executor" or executor_only:
            if busy_poll:
                raise UsageError("busy_poll needs the direct bridge, which is not in use here")
            return ExecutorBridge(self.node, self._gateway, self._introspect)
        assert self._direct_rcl is not None
        return DirectBridge(self.node, self._direct_rcl, self._loop, self._introspect, busy_poll)

    def _introspect(self, entity: Any) -> None:
        """Have a client or service publish its calls, where that is wanted."""
        if self._introspection != "off":
            state = getattr(ServiceIntrospectionState, self._introspection.upper())
            entity.configure_introspection(self.node.get_clock(), qos_profile_system_default, state)

    def _spin(self) -> None:
        self._own_executor = SingleThreadedExecutor(context=self.node.context)
        self._added = self._own_executor.add_node(self.node)
        self._thread = ExecutorThread(
            self._own_executor,
            f"rosasync executor of {self.node.get_name()}",
            self._post_error,
            self._post_shutdown,
            self._post_end,
        )

    # From the executor's thread, or whichever one shuts the context down.

    def _post_graph(self) -> None:
        if not self._graph_pending:
            self._graph_pending = True
            self._gateway.post_if_open(self._tell_graph)

    def _tell_graph(self) -> None:
        self._graph_pending = False
        self._on_graph()

    def _post_shutdown(self) -> None:
        self._gateway.post_if_open(self._on_shutdown)

    def _post_end(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._thread_ended.set)

    def _post_error(self, error: Exception) -> None:
        context = {"message": "a callback of the node raised", "exception": error}
        if self._gateway.closed:
            logger.error("a callback of the node raised", exc_info=error)
        else:
            self._gateway.post_if_open(self._loop.call_exception_handler, context)


def default_qos() -> QoSProfile:
    """Return the service default with a history of 1,000."""
    qos = QoSProfile(depth=DEPTH)
    for name in ("history", "reliability", "durability"):
        setattr(qos, name, getattr(qos_profile_services_default, name))
    return qos


def _takes_callbacks(executor: Executor | None) -> bool:
    """Tell whether this executor sets the middleware's callbacks itself (EventsExecutor)."""
    return executor is not None and type(executor).__module__.startswith("rclpy.experimental")
