"""RosNode: a node, created or borrowed, with its executor thread, its bridge and its graph."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from rosasync._core.aio import LoopEnd
from rosasync._core.fork import check_fork, note_use
from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import (
    Action,
    ClientPort,
    Deliver,
    DeliverMessage,
    DeliverRequest,
    PublisherPort,
    Service,
    ServicePort,
    SubscriptionPort,
    TopicQos,
)
from rosasync._ros import configuration, names
from rosasync._ros.bridges import Bridge, load_rcl, open_bridge
from rosasync._ros.endpoints import response_readers, response_writers
from rosasync._ros.executor_thread import ExecutorThread, ThreadUser, executor_thread_of
from rosasync._ros.failures import RclpyError, check_up, is_up, refusal, topic_refusal
from rosasync._ros.graph import GraphQueries, GraphWaitable
from rosasync._ros.held_node import HeldNode
from rosasync._ros.identities import Identities
from rosasync._ros.messages import make_message
from rosasync._ros.node_events import NodeEvents
from rosasync._ros.topics import NO_PUBLISHER_EVENTS, Publisher, qos_profile
from rosasync._ros.types import type_name
from rosasync.errors import ContextShutdown
from rosasync.options import SessionOptions

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort

__all__ = ["RosNode"]

JOIN_TIMEOUT = 5.0
"""Seconds to wait for the executor thread to finish its current callback."""

HEADER = 4
"""Bytes at the beginning of a serialized message that say how the rest is encoded."""
UUID = 16
"""Bytes of a goal's UUID, with which its feedback messages begin. What follows can be read without
it, because no field is aligned to more than eight bytes."""


class RosNode:
    """The part of a session that uses rclpy: a `rosasync._core.ports.NodePort`.

    Created, used and closed on the loop's thread.

    Args:
        options: the session's.
        gateway: the way into the loop.
        on_graph: called on the loop's thread after a change of the graph.
        on_shutdown: called on the loop's thread when the context is shut down.

    Attributes:
        queries: what the node's graph shows.

    Raises:
        TypeError, ValueError: the node is neither a node nor a valid name.
        UsageError: the context is down, or the bridge cannot be used here.
        ContextShutdown: the node that was passed in is down.
        RosasyncError: the node or the context cannot be created.
    """

    queries: GraphQueries

    def __init__(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> None:
        check_fork()
        self._in_flight = options.limits.in_flight
        self._on_shutdown = on_shutdown
        self._events = NodeEvents(gateway, on_graph, self._shut_down)
        self._user = ThreadUser(
            self._events.post_error, self._events.post_shutdown, self._events.post_left
        )
        self._thread: ExecutorThread | None = None
        self._loop_end: LoopEnd | None = None
        self._waitable: GraphWaitable | None = None
        self._bridge: Bridge | None = None
        self._publishers: dict[Publisher, None] = {}
        self._held = HeldNode(options)
        self._node = self._held.node
        try:
            self._open(options, gateway)
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

    # Names, types and messages.

    def describe(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Check and resolve a service."""
        return names.describe(self._node, srv_type, srv_name, qos)

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

    def deserialize_feedback(self, action_type: Any, data: bytes) -> Any:
        """Return the feedback in the bytes of an action's ``FeedbackMessage``."""
        # Without the UUID, whose conversion takes longer than that of most feedback.
        return self.deserialize(action_type.Feedback, data[:HEADER] + data[HEADER + UUID :])

    # Clients, services and topics.

    def open_client(self, service: Service, deliver: Deliver) -> ClientPort:
        """Create a client that passes its responses to ``deliver``."""
        try:
            created = self._identities.before(response_readers, service.key.srv_name)
            client = self._opened.open_client(
                service.srv_type,
                service.srv_name,
                _qos_of(service, _client_depth(service, self._in_flight)),
                deliver,
                service.after_topics,
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
            opened.repair_time = configuration.repair_time()
        except RclpyError as error:
            raise refusal(self._node, service, "service", error) from error
        return opened

    def open_publisher(self, msg_type: Any, topic_name: str, qos: TopicQos) -> PublisherPort:
        """Create a publisher."""
        try:
            publisher = self._node.create_publisher(
                msg_type, topic_name, qos_profile(qos), event_callbacks=NO_PUBLISHER_EVENTS
            )
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

    # The end.

    def stop(self) -> None:
        """Ask the executor thread to end. From any thread; idempotent; takes no lock.

        It ends with the last session that uses it.
        """
        if self._thread is not None:
            self._thread.leave(self._user)

    def join(self) -> bool:
        """Wait for the executor thread to end and return whether it did; blocks."""
        return self._thread is None or self._thread.join(self._user, JOIN_TIMEOUT)

    async def wait_stopped(self) -> None:
        """Wait, after `stop`, until `join` returns at once and `close` is safe."""
        if self._thread is not None:
            await self._events.left.wait()
        await self._held.leave_executor()
        await asyncio.sleep(self._opened.destroy_delay)

    def close(self) -> None:
        """Return what was borrowed and destroy what is owned; call `stop` and `join` first."""
        if self._loop_end is not None:
            self._loop_end.close()
        if self._waitable is not None:
            self._waitable.close()
        if self._bridge is not None:
            self._bridge.close()
        for publisher in tuple(self._publishers):
            publisher.close()
        if self._thread is not None:
            self._thread.close()
        # Last, because what was destroyed before this belongs to the node.
        self._held.close()

    # The opening.

    def _open(self, options: SessionOptions, gateway: LoopGateway) -> None:
        node = self._node
        note_use(self)
        check_up(node)
        self._name = str(node.get_name())
        self._identities = Identities(node)
        librcl = load_rcl(options.executor or node.executor)
        self._bridge = open_bridge(options, node, gateway, librcl)
        self.queries = self._make_queries(librcl is not None)
        if librcl is not None:
            self._waitable = GraphWaitable(node, librcl, self._graph_changed)
        node.context.on_shutdown(self._events.post_shutdown)
        # Last: a failure before this destroys the node, which no executor may spin then.
        if options.executor is not None:
            self._held.add_to(options.executor)
        self._thread = executor_thread_of(node, self._user)
        # A session whose loop is closed is of no use, and its thread would keep it from being
        # collected: the node's callbacks may refer to it.
        self._loop_end = LoopEnd(self.stop)

    def _make_queries(self, events: bool) -> GraphQueries:
        """Make `queries`. The node of `rosasync.testing` overrides this."""
        return GraphQueries(self._node, events)

    @property
    def _opened(self) -> Bridge:
        assert self._bridge is not None
        return self._bridge

    def _graph_changed(self) -> None:
        """Report a change of the graph. Runs on the executor's thread."""
        # In this order: who is told of the change must not be answered from before it.
        self.queries.changed()
        self._events.post_graph()

    def _shut_down(self) -> None:
        # In this order: calls that end because of it may send others at once.
        self._opened.refuse()
        self._on_shutdown()


def _qos_of(service: Service, depth: int) -> QoSProfile:
    return service.qos or names.default_qos(depth)


def _client_depth(service: Service, in_flight: int) -> int:
    """Return the depth of a client; see `rosasync._ros.names` for the reasons."""
    if configuration.heartbeats():
        return names.DEPTH
    return max(names.DEPTH_WITHOUT_HEARTBEATS, in_flight, service.in_flight)


if TYPE_CHECKING:

    def _fits(node: RosNode) -> NodePort:
        return node
