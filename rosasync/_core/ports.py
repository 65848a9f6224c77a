"""Protocols for what the core needs from rclpy; `rosasync._ros` implements them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, Protocol

from rosasync.statistics import ServiceKey

__all__ = [
    "Action",
    "ClientPort",
    "Deliver",
    "DeliverMessage",
    "DeliverRequest",
    "GraphPort",
    "NodePort",
    "PortDestroyed",
    "PublisherPort",
    "RequestHeader",
    "RequestId",
    "Servers",
    "Service",
    "ServicePort",
    "SubscriptionPort",
    "TopicQos",
    "Undeliverable",
    "Unmatched",
]

Deliver = Callable[[int, Any], None]
"""Called on the loop's thread with a sequence number and the response to it."""

DeliverMessage = Callable[[Any], None]
"""Called on the loop's thread with a message of a topic: bytes if the subscription is raw."""


Servers = frozenset[Hashable]
"""The identities of servers."""


class PortDestroyed(Exception):
    """The rclpy entity was destroyed by something other than rosasync."""


class Undeliverable(Exception):
    """The middleware cannot deliver this response."""


class Unmatched(Undeliverable):
    """The client has not been discovered completely yet: send the response again later."""


@dataclass(frozen=True, slots=True)
class Service:
    """A service type, name and QoS, checked and resolved.

    Attributes:
        srv_type: the service class.
        srv_name: the name as given. rclpy resolves it again, and must not remap it twice.
        qos: the ``QoSProfile``, or None for the default.
        key: the key of the service in the pool.
        fits: whether a value is a request that can be sent as it is.
        in_flight: the most requests that a client has outstanding, if it is not the session's.
        after_topics: whether a response must not overtake messages of topics that arrived before.
    """

    srv_type: Any
    srv_name: str
    qos: Any
    key: ServiceKey
    fits: Callable[[Any], bool] = field(compare=False, repr=False)
    in_flight: int = 0
    after_topics: bool = False


@dataclass(frozen=True, slots=True)
class Action:
    """An action type and name, checked and resolved.

    Attributes:
        action_type: the action class.
        name: the resolved name.
        type_name: the name of the type, ``"test_msgs/action/Fibonacci"``.
        send_goal: the service that accepts goals.
        cancel_goal: the service that cancels them.
        get_result: the service that answers when a goal has ended.
        feedback_topic: the name of the feedback topic, for `NodePort.open_subscription`.
        status_topic: the name of the status topic.
    """

    action_type: Any
    name: str
    type_name: str
    send_goal: Service
    cancel_goal: Service
    get_result: Service
    feedback_topic: str
    status_topic: str


@dataclass(frozen=True, slots=True)
class TopicQos:
    """The QoS of a topic. Topics are reliable here.

    Attributes:
        depth: how many messages are kept for a slow reader; the oldest are dropped.
        latched: whether a new subscription gets the messages that are kept (transient local).
    """

    depth: int = 10
    latched: bool = False


class RequestId(Protocol):
    """The identity of a request. rclpy exposes its number, but not its client."""

    @property
    def sequence_number(self) -> int:
        """The number that the client gave the request."""


class RequestHeader(Protocol):
    """The header of a request. Keep the object: it is needed to send the response."""

    @property
    def request_id(self) -> RequestId:
        """The identity of the request."""

    @property
    def source_timestamp(self) -> int:
        """When the request was sent, in ns; 0 or less if unknown."""

    @property
    def received_timestamp(self) -> int:
        """When the request was received, in ns; 0 or less if unknown."""


DeliverRequest = Callable[[Any, RequestHeader], None]
"""Called on the loop's thread with a request and its header."""


class ServicePort(Protocol):
    """One rcl service.

    Every method returns at once. Call them on the loop's thread, unless they say otherwise.
    """

    @property
    def handle(self) -> Any:
        """The ``rclpy.service.Service``."""

    @property
    def qos(self) -> Any:
        """The ``QoSProfile`` in use."""

    @property
    def destroy_delay(self) -> float:
        """Seconds to wait between `stop` and `close`, unless the server has to end at once."""

    @property
    def repair_time(self) -> float:
        """Seconds after which the middleware sends a lost response again."""

    @property
    def destroyed(self) -> bool:
        """Whether something other than rosasync has destroyed the service."""

    @property
    def identity(self) -> Hashable:
        """What `GraphPort.find_servers` shows for this service; None if it is unknown."""

    def client_of(self, header: RequestHeader) -> Hashable:
        """Return the identity of the client that sent a request; None if it is unknown."""

    def clients(self) -> frozenset[Hashable]:
        """Identify the clients that the graph shows; empty if the middleware does not.

        Raises:
            ContextShutdown: the node is down.
        """

    def send(self, header: RequestHeader, response: Any) -> None:
        """Convert and send a response. From any thread, but not during or after `close`.

        Raises:
            Undeliverable: the client cannot get the response.
            Unmatched: the client cannot get it yet.
            PortDestroyed: the service was destroyed.
            TypeError, ValueError: a field has a value that cannot be sent; the message names its
                path.
            RosasyncError: the middleware refuses the response.
        """

    def has_clients(self) -> bool:
        """Return whether the graph shows a client. From any thread, but not during `close`."""

    def delivered(self) -> bool:
        """Return whether every client is known to have received every response.

        False also if the middleware cannot tell.

        Raises:
            PortDestroyed: the service was destroyed.
            ContextShutdown: the node is down.
        """

    def stop(self) -> None:
        """Stop delivering requests; idempotent. Responses may still be sent."""

    def close(self) -> None:
        """Destroy the service; idempotent."""


class ClientPort(Protocol):
    """One rcl client. Call its methods on the loop's thread; every one returns at once."""

    @property
    def identity(self) -> Hashable:
        """What `ServicePort.client_of` shows for its requests; None if it is unknown."""

    def send(self, request: Any) -> int:
        """Send a request and return its sequence number, which grows with every send.

        Raises:
            PortDestroyed: the client was destroyed.
        """

    def forget(self, sequence_number: int) -> None:
        """Stop expecting a response to this request."""

    def ready(self) -> bool:
        """Return whether a server is matched, so that it would receive a request sent now.

        Raises:
            PortDestroyed: the client was destroyed.
        """

    def close(self) -> None:
        """Destroy the client; idempotent."""


class PublisherPort(Protocol):
    """One rcl publisher. Call its methods on the loop's thread; every one returns at once."""

    def publish(self, message: Any) -> None:
        """Publish a message, or the bytes of a serialized one.

        It is converted at once, so it may be changed afterwards.

        Raises:
            PortDestroyed: the publisher was destroyed.
            ContextShutdown: the node is down.
        """

    def subscriptions(self) -> int:
        """Return how many subscriptions are matched; raises as `publish`."""

    def reaches(self, client: Hashable) -> bool:
        """Return whether a client's process has a subscription, and it is matched.

        Args:
            client: the identity of a client of some service; see `ServicePort.client_of`.

        Raises:
            PortDestroyed, ContextShutdown: as `publish`.
        """

    def acknowledged(self) -> bool:
        """Return whether every matched subscription is known to have received every message.

        True also if the middleware cannot tell. Raises as `publish`.
        """

    def close(self) -> None:
        """Destroy the publisher; idempotent."""


class SubscriptionPort(Protocol):
    """One rcl subscription. Call its methods on the loop's thread; every one returns at once."""

    def publishers(self) -> int:
        """Return how many publishers are matched.

        Raises:
            PortDestroyed: the subscription was destroyed.
            ContextShutdown: the node is down.
        """

    def drain(self) -> None:
        """Deliver what has arrived already, if the loop takes it itself."""

    def close(self) -> None:
        """Stop delivering, and destroy the subscription; idempotent."""


class GraphPort(Protocol):
    """What a node's graph shows. Call the methods on the loop's thread; every one returns at once.

    What another process has just changed may be missing.
    """

    def count_servers(self, service: Service) -> int:
        """Return how many servers have the service's name, whatever their type and QoS. Cheap.

        Raises:
            ContextShutdown: the node is down.
        """

    def count_clients(self, service: Service) -> int:
        """Return how many clients have the service's name, in all processes. Cheap.

        Raises:
            ContextShutdown: the node is down.
        """

    def find_servers(self, service: Service) -> Servers:
        """Identify the servers that fit: by name, type and QoS.

        If the middleware does not identify servers, the set has a placeholder for each server of
        the name.

        Raises:
            ContextShutdown: the node is down.
        """

    def find_ended(self, servers: Servers) -> Servers:
        """Return those of these servers whose process has certainly ended without its clean-up.

        The graph still shows them until their lease runs out.

        Raises:
            ContextShutdown: the node is down.
        """

    def name_servers(self, service: Service) -> tuple[str, ...]:
        """Return the full names of the nodes that serve this name and type, as far as known.

        Raises:
            ContextShutdown: the node is down.
        """

    def find_publishers(self, topic_name: str) -> frozenset[Hashable]:
        """Identify the publishers of a topic, in all processes. Cheap if there are none.

        Raises:
            ContextShutdown: the node is down.
        """

    def explain_missing(self, service: Service) -> str:
        """Describe what the graph shows instead of this service, as a clause."""

    def explain_mismatch(self, service: Service) -> str | None:
        """Describe the servers of the name as a clause, if all of them have another type.

        Raises:
            ContextShutdown: the node is down.
        """

    def explain_silence(self, service: Service) -> str | None:
        """Describe why no data arrives from a visible server, as a clause, if that is known.

        Raises:
            ContextShutdown: the node is down.
        """


class NodePort(Protocol):
    """One node, with its executor thread and its bridge.

    Call the methods on the loop's thread, unless they say otherwise. All but `join` return at once.
    """

    @property
    def name(self) -> str:
        """The node's name."""

    @property
    def node(self) -> Any:
        """The ``rclpy.node.Node``."""

    @property
    def bridge(self) -> str:
        """The bridge in use: ``"direct"`` or ``"executor"``."""

    @property
    def executor_thread(self) -> int | None:
        """The identifier of the executor thread, if the session started it."""

    @property
    def queries(self) -> GraphPort:
        """What the node's graph shows."""

    @property
    def graph_events(self) -> bool:
        """Whether the node reports changes of the graph. If not, the pool polls."""

    def ok(self) -> bool:
        """Return whether the node and its context are up."""

    def now(self) -> int:
        """Return the time of the node's clock, in ns.

        Raises:
            ContextShutdown: the node is down.
        """

    def describe(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Check and resolve a service. From any thread.

        Raises:
            TypeError, ValueError: the type does not exist, or the QoS is not a ``QoSProfile``.
            InvalidServiceName: ROS does not allow the name.
            ContextShutdown: the node is down.
        """

    def open_client(self, service: Service, deliver: Deliver) -> ClientPort:
        """Create a client that passes its responses to ``deliver``.

        Raises:
            ContextShutdown: the node is down.
            RosasyncError: the middleware refuses the client.
            OSError: the process is out of file descriptors.
        """

    def open_service(self, service: Service, deliver: DeliverRequest) -> ServicePort:
        """Create a service that passes its requests to ``deliver``; raises as `open_client`."""

    def describe_action(self, action_type: Any, action_name: str) -> Action:
        """Check and resolve an action. From any thread.

        Raises:
            TypeError, ValueError: the type does not exist.
            InvalidServiceName: ROS does not allow the name.
            ContextShutdown: the node is down.
        """

    def make_message(self, message_type: Any, value: Any) -> Any:
        """Return a message to send, from a message, a mapping or None. From any thread.

        A message is copied if one of its values has to be converted.

        Raises:
            TypeError, ValueError: it does not fit; the message names the path of the field.
        """

    def deserialize(self, message_type: Any, data: bytes) -> Any:
        """Return the message in the bytes that a raw subscription delivers.

        Raises:
            ValueError: it cannot be read.
        """

    def deserialize_feedback(self, action_type: Any, data: bytes) -> Any:
        """Return the feedback in the bytes of an action's ``FeedbackMessage``.

        Raises:
            ValueError: it cannot be read.
        """

    def open_publisher(self, msg_type: Any, topic_name: str, qos: TopicQos) -> PublisherPort:
        """Create a publisher; raises as `open_client`."""

    def open_subscription(
        self,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        *,
        raw: bool = False,
    ) -> SubscriptionPort:
        """Create a subscription that passes its messages to ``deliver``.

        If ``raw``, it passes bytes, and those of messages that come in quick succession may be
        passed together, a few milliseconds late.

        Raises:
            Exception: as `open_client`.
        """

    def stop(self) -> None:
        """Ask the executor thread to end. From any thread; idempotent; takes no lock."""

    def join(self) -> bool:
        """Wait for the executor thread to end and return whether it did; blocks."""

    async def wait_stopped(self) -> None:
        """Wait, after `stop`, until `join` returns at once and `close` is safe."""

    def close(self) -> None:
        """Return what was borrowed and destroy what is owned; call `stop` and `join` first."""
