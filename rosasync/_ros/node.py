"""RosNode: a node, created or borrowed, with its executor thread, its bridge and its graph."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle, InvalidNodeNameException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_system_default
from rclpy.serialization import deserialize_message
from rclpy.service_introspection import ServiceIntrospectionState
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_node_name import validate_node_name

from rosasync._core.fork import check_fork, forked, note_use, refuse
from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import (
    Action,
    ClientPort,
    Deliver,
    DeliverMessage,
    DeliverRequest,
    PublisherPort,
    Servers,
    Service,
    ServicePort,
    SubscriptionPort,
    TopicQos,
)
from rosasync._ros import configuration, discovery, fastdds, names, profile, rcl
from rosasync._ros.direct_bridge import DirectBridge
from rosasync._ros.domain import check_domain, environment_domain
from rosasync._ros.endpoints import gid_of, response_readers, response_writers
from rosasync._ros.executor_bridge import ExecutorBridge
from rosasync._ros.executor_thread import ExecutorThread, ThreadUser, executor_thread_of
from rosasync._ros.failures import (
    RclpyError,
    cannot_create,
    check_up,
    is_up,
    refusal,
    topic_refusal,
    uses_node,
)
from rosasync._ros.graph import GraphQueries, GraphWaitable
from rosasync._ros.host import ended
from rosasync._ros.identities import Identities
from rosasync._ros.messages import make_message
from rosasync._ros.shared_memory import check_ports
from rosasync._ros.topics import Publisher, qos_profile
from rosasync._ros.types import type_name
from rosasync.errors import ContextShutdown, UsageError
from rosasync.options import SessionOptions

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort

__all__ = ["RosNode"]

logger = logging.getLogger("rosasync")

DIRECT_TRIED = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""The middlewares for which ``bridge="auto"`` chooses the direct bridge."""

JOIN_TIMEOUT = 5.0
"""Seconds to wait for the executor thread to finish its current callback."""

LEAVE_TIMEOUT = 0.2
"""Maximum number of seconds to wait for a user's executor to begin its next turn."""

CALLBACK_RAISED = "a callback of the node raised an exception; the session goes on"

Bridge = DirectBridge | ExecutorBridge


class RosNode:
    """The part of a session that uses rclpy: a `rosasync._core.ports.NodePort`.

    Created, used and closed on the loop's thread.

    Args:
        options: the session's.
        gateway: the way into the loop.
        on_graph: called on the loop's thread after a change of the graph.
        on_shutdown: called on the loop's thread when the context is shut down.

    Raises:
        TypeError, ValueError: the node is neither a node nor a valid name.
        UsageError: the context is down, or the bridge cannot be used here.
        ContextShutdown: the node that was passed in is down.
        RosasyncError: the node or the context cannot be created.
    """

    def __init__(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._gateway = gateway
        self._on_graph = on_graph
        self._on_shutdown = on_shutdown
        self._introspection = options.introspection
        self._in_flight = options.limits.in_flight
        self._graph_pending = False
        self._left = asyncio.Event()
        self._user = ThreadUser(self._post_error, self._post_shutdown, self._post_left)
        self._thread: ExecutorThread | None = None
        self._own_context: Context | None = None
        self._own_node: Node | None = None
        self._user_executor: Executor | None = None
        self._waitable: GraphWaitable | None = None
        self._bridge: Bridge | None = None
        self._publishers: dict[Publisher, None] = {}
        check_fork()
        try:
            self._open(options)
        except BaseException:
            self.stop()
            self.join()
            self.close()
            raise

    @property
    def node(self) -> Node:
        """The ``rclpy.node.Node``."""
        return self._node

    @property
    def name(self) -> str:
        """The node's name, also after its destruction."""
        return self._name

    @property
    def bridge(self) -> str:
        """The bridge in use: ``"direct"`` or ``"executor"``."""
        return self._opened.name

    @property
    def graph_events(self) -> bool:
        """Whether the node reports changes of the graph."""
        return self._waitable is not None

    @property
    def executor_thread(self) -> int | None:
        """The identifier of the executor thread, if a session started it."""
        return None if self._thread is None else self._thread.ident

    def ok(self) -> bool:
        """Return whether the node and its context are up."""
        return is_up(self._node)

    def now(self) -> int:
        """Return the time of the node's clock, in ns."""
        try:
            return int(self._node.get_clock().now().nanoseconds)
        except RclpyError as error:
            raise ContextShutdown() from error

    def describe(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Check and resolve a service."""
        return names.describe(self._node, srv_type, srv_name, qos)

    def open_client(self, service: Service, deliver: Deliver) -> ClientPort:
        """Create a client that passes its responses to ``deliver``."""
        try:
            created = self._identities.before(response_readers, service.key.srv_name)
            client = self._opened.open_client(
                service.srv_type,
                service.srv_name,
                _qos_of(service, self._client_depth(service)),
                deliver,
            )
            client.identity = self._identities.confirm(
                client.handle, service.key.srv_name, created()
            )
        except RclpyError as error:
            raise refusal(self._node, service, "client", error) from error
        return client

    def open_service(self, service: Service, deliver: DeliverRequest) -> ServicePort:
        """Create a service that passes its requests to ``deliver``."""
        try:
            created = self._identities.before(response_writers, service.key.srv_name)
            opened = self._opened.open_service(
                service.srv_type,
                service.srv_name,
                _qos_of(service, names.DEPTH),
                deliver,
            )
            opened.identity = created()
        except RclpyError as error:
            raise refusal(self._node, service, "service", error) from error
        return opened

    def describe_action(self, action_type: Any, action_name: str) -> Action:
        """Check and resolve an action."""
        return names.describe_action(self._node, action_type, action_name)

    def make_message(self, message_type: Any, value: Any) -> Any:
        """Return a message to send, from a message, a mapping or None."""
        return make_message(message_type, value)

    def deserialize(self, message_type: Any, data: bytes) -> Any:
        """Return the message in the bytes that a raw subscription delivers."""
        try:
            return deserialize_message(data, message_type)
        except RuntimeError as error:
            raise ValueError(
                f"a message of {type_name(message_type)} cannot be read: {error}"
            ) from error

    def open_publisher(self, msg_type: Any, topic_name: str, qos: TopicQos) -> PublisherPort:
        """Create a publisher."""
        try:
            publisher = self._node.create_publisher(msg_type, topic_name, qos_profile(qos))
        except RclpyError as error:
            raise topic_refusal(self._node, topic_name, error) from error
        opened = Publisher(self._node, publisher, self._publishers.pop)
        self._publishers[opened] = None
        return opened

    def open_subscription(
        self,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        *,
        raw: bool = False,
    ) -> SubscriptionPort:
        """Create a subscription that passes its messages to ``deliver``."""
        try:
            return self._opened.open_subscription(
                msg_type, topic_name, qos_profile(qos), deliver, raw
            )
        except RclpyError as error:
            raise topic_refusal(self._node, topic_name, error) from error

    def count_servers(self, service: Service) -> int:
        """Return how many servers have the name, whatever their type."""
        return self._graph.count_servers(service)

    def count_clients(self, service: Service) -> int:
        """Return how many clients have the name, in all processes."""
        return self._graph.count_clients(service)

    def find_servers(self, service: Service) -> frozenset[Hashable]:
        """Identify the servers that fit: by name, type and QoS."""
        return self._graph.find_servers(service)

    def find_ended(self, servers: Servers) -> Servers:
        """Return those of these servers whose process has certainly ended."""
        with uses_node(self._node):
            return ended(self._node, (gid for gid in servers if isinstance(gid, bytes)))

    def find_publishers(self, topic_name: str) -> frozenset[Hashable]:
        """Identify the publishers of a topic, in all processes."""
        with uses_node(self._node):
            # The count takes a microsecond, and the list some hundred.
            if not self._node.count_publishers(topic_name):
                return frozenset()
            return frozenset(map(gid_of, self._node.get_publishers_info_by_topic(topic_name)))

    def name_servers(self, service: Service) -> tuple[str, ...]:
        """Return the full names of the nodes that serve this name and type, as far as known."""
        return self._graph.name_servers(service)

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead of this service, as a clause."""
        return self._graph.explain_missing(service)

    def explain_mismatch(self, service: Service) -> str | None:
        """Describe the servers of the name as a clause, if all of them have another type."""
        return self._graph.explain_mismatch(service)

    def explain_silence(self, service: Service) -> str | None:
        """Describe why no data arrives from a visible server, as a clause, if that is known."""
        return self._graph.explain_silence(service)

    def stop(self) -> None:
        """Ask the executor thread to end. From any thread; idempotent; takes no lock.

        It ends with the last session that uses it.
        """
        if self._thread is not None:
            self._thread.leave(self._user)

    def join(self) -> bool:
        """Wait for the executor thread to end and return whether it did; blocks."""
        return self._thread is None or self._thread.join(self._user, JOIN_TIMEOUT)

    async def stopped(self) -> None:
        """Wait, after `stop`, until `join` returns at once and `close` is safe."""
        if self._thread is not None:
            await self._left.wait()
        if self._user_executor is not None and self._own_node is not None:
            await _leave(self._user_executor, self._own_node)
        await asyncio.sleep(self._opened.destroy_delay)

    def close(self) -> None:
        """Return what was borrowed and destroy what is owned; call `stop` and `join` first."""
        if self._waitable is not None:
            self._waitable.close()
        if self._bridge is not None:
            self._bridge.close()
        for publisher in tuple(self._publishers):
            publisher.close()
        if self._thread is not None:
            self._thread.close()
        # Drop the reference: a MultiThreadedExecutor ends its threads when it is collected.
        executor, self._user_executor = self._user_executor, None
        if executor is not None and self._node.executor is executor:
            self._node.executor = None
        if self._own_node is not None:
            self._own_node.destroy_node()
        if self._own_context is not None:
            self._own_context.try_shutdown()

    # Opening.

    def _open(self, options: SessionOptions) -> None:
        self._node = self._make_node(options)
        note_use()
        check_up(self._node)
        self._name = str(self._node.get_name())
        self._identities = Identities(self._node)
        executor = options.executor
        librcl = rcl.load()
        if _takes_callbacks(executor or self._node.executor):
            librcl = None
        self._bridge = self._make_bridge(options, librcl)
        self._graph = GraphQueries(self._node, events=librcl is not None)
        if librcl is not None:
            self._waitable = GraphWaitable(self._node, librcl, self._post_graph)
        self._node.context.on_shutdown(self._post_shutdown)
        # Last: a failure before this destroys the node, which no executor may spin then.
        if executor is not None and executor.add_node(self._node):
            self._user_executor = executor
        self._thread = executor_thread_of(self._node, self._user)

    def _make_node(self, options: SessionOptions) -> Node:
        node = options.node
        if isinstance(node, Node):
            return node
        if not isinstance(node, str):
            kind = type(node).__name__
            raise TypeError(f"node must be a name or an rclpy.node.Node, not {kind}")
        context = options.context
        if context is not None and not context.ok():
            raise UsageError(
                "the context is not initialised, or was shut down: call "
                "rclpy.init(context=context) first, or leave it out"
            )
        try:
            # Here, and not only in `Node`, whose failure prints warnings about what it had made.
            validate_node_name(node)
            self._own_node = self._make_own(node, context)
        except InvalidNodeNameException as error:
            reason = names.reason_of_name(error)
            raise ValueError(f"{node!r} is not a valid node name: {reason}") from None
        except UsageError:
            raise
        except (RuntimeError, UnicodeError) as error:
            # RCLError, or what C++ throws if the process is out of file descriptors; the second for
            # arguments of the command line.
            raise cannot_create(node, error) from error
        return self._own_node

    def _make_own(self, name: str, given: Context | None) -> Node:
        """Make a node, and a context for it unless one is given."""
        context = given
        if context is None:
            environment_domain()
            context = self._own_context = Context()
            rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        if not fastdds.is_present():
            return Node(name, context=context)
        domain = context.get_domain_id()
        check_domain(domain)
        if forked() and discovery.own_ports(domain):
            # Inherited from a stock node of the parent.
            raise refuse()
        if given is not None:
            if not discovery.own_ports(domain):
                check_ports(domain)
            return Node(name, context=context)
        check_ports(domain)
        configuration.configure(domain)
        # The first node of a context makes its participant.
        with _introduced(domain):
            return Node(name, context=context)

    def _make_bridge(self, options: SessionOptions, librcl: rcl.Rcl | None) -> Bridge:
        tried = rclpy.get_rmw_implementation_identifier() in DIRECT_TRIED
        if options.bridge == "direct" and librcl is None:
            raise UsageError(
                "bridge='direct' does not work here: either an EventsExecutor spins the node and "
                "takes the responses, or this platform does not support it; use bridge='auto'"
            )
        if (
            librcl is None
            or options.bridge == "executor"
            or (options.bridge == "auto" and not tried)
        ):
            if options.busy_poll:
                raise UsageError(
                    "busy_poll needs the direct bridge, which is not in use here: leave it out, "
                    "or see `rosasync doctor` for the reason"
                )
            return ExecutorBridge(self._node, self._gateway, self._introspect)
        return DirectBridge(self._node, librcl, self._loop, self._introspect, options.busy_poll)

    def _client_depth(self, service: Service) -> int:
        if configuration.heartbeats():
            return names.DEPTH
        return max(names.DEPTH_WITHOUT_HEARTBEATS, self._in_flight, service.in_flight)

    def _introspect(self, entity: Any) -> None:
        """Make a client or service publish its calls, as ``introspection`` says."""
        if self._introspection != "off":
            state = getattr(ServiceIntrospectionState, self._introspection.upper())
            clock = self._node.get_clock()
            entity.configure_introspection(clock, qos_profile_system_default, state)

    @property
    def _opened(self) -> Bridge:
        assert self._bridge is not None
        return self._bridge

    # Called on the executor's thread, or on the one that shuts the context down.

    def _post_graph(self) -> None:
        self._graph.changed()
        if not self._graph_pending:
            self._graph_pending = True
            self._gateway.post_if_open(self._report_graph)

    def _report_graph(self) -> None:
        self._graph_pending = False
        self._on_graph()

    def _post_shutdown(self) -> None:
        self._gateway.post_if_open(self._report_shutdown)

    def _report_shutdown(self) -> None:
        self._opened.refuse()
        self._on_shutdown()

    def _post_left(self) -> None:
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._left.set)

    def _post_error(self, error: Exception) -> None:
        context = {"message": CALLBACK_RAISED, "exception": error}
        if self._gateway.closed:
            logger.error(CALLBACK_RAISED, exc_info=error)
        else:
            self._gateway.post_if_open(self._loop.call_exception_handler, context)


async def _leave(executor: Executor, node: Node) -> None:
    """Remove the session's node from a user's executor, so that it can be destroyed safely.

    If entities are destroyed while an executor adds them to its wait set, its ``spin`` raises
    `InvalidHandle` (rclpy issue 1355). So wait until the executor has begun another turn, but only
    for `LEAVE_TIMEOUT`, because nothing may be spinning it.
    """
    loop = asyncio.get_running_loop()
    turn = asyncio.Event()

    def report() -> None:
        # The executor may run this after the loop was closed.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(turn.set)

    executor.remove_node(node)
    # AttributeError: an executor of Jazzy that was shut down has no guard condition to trigger.
    with contextlib.suppress(AttributeError, InvalidHandle, RuntimeError, TimeoutError):
        # Two tasks: the turn that runs the first may have listed its nodes before the removal.
        executor.create_task(executor.create_task, report)
        async with asyncio.timeout(LEAVE_TIMEOUT):
            await turn.wait()


def _introduced(domain: int) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext() if profile.switched_off() else discovery.introduced(domain)


def _qos_of(service: Service, depth: int) -> QoSProfile:
    return service.qos or names.default_qos(depth)


def _takes_callbacks(executor: Executor | None) -> bool:
    """Return whether this executor sets the middleware's callbacks itself, like EventsExecutor."""
    return any(kind.__name__ == "EventsExecutor" for kind in type(executor).__mro__)


if TYPE_CHECKING:

    def _fits(node: RosNode) -> NodePort:
        return node
