"""Publishers, and the subscriptions of both bridges."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from functools import partial
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.qos import (
    QoSDurabilityPolicy,
    QoSHistoryPolicy,
    QoSProfile,
    QoSReliabilityPolicy,
)

from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import DeliverMessage, TopicQos
from rosasync._ros.endpoints import GUID_PREFIX, compatible, prefixes
from rosasync._ros.failures import RclpyError, check_up, explain, is_destroyed, uses_node
from rosasync._ros.rcl import Rcl
from rosasync._ros.signals import Signal, Signals
from rosasync.errors import RosasyncError

__all__ = [
    "NO_PUBLISHER_EVENTS",
    "NO_SUBSCRIPTION_EVENTS",
    "DirectSubscription",
    "ExecutorSubscription",
    "Publisher",
    "qos_profile",
    "take_messages",
]

logger = logging.getLogger("rosasync")

BATCH = 200
"""Maximum number of messages taken at a time, so that a flood does not hold up the loop."""

NO_PUBLISHER_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
NO_SUBSCRIPTION_EVENTS = SubscriptionEventCallbacks(use_default_callbacks=False)
"""rclpy's default is a waitable for each event. An executor that is just waiting for it raises
InvalidHandle in ``spin`` when the publisher or subscription is destroyed."""


def qos_profile(qos: TopicQos) -> QoSProfile:
    """Return rclpy's form of a QoS."""
    return QoSProfile(
        depth=qos.depth,
        history=QoSHistoryPolicy.KEEP_LAST,
        reliability=QoSReliabilityPolicy.RELIABLE,
        durability=(
            QoSDurabilityPolicy.TRANSIENT_LOCAL if qos.latched else QoSDurabilityPolicy.VOLATILE
        ),
    )


class Publisher:
    """An rclpy publisher; see `rosasync._core.ports.PublisherPort`."""

    def __init__(self, node: Node, publisher: Any, on_close: Callable[[Publisher], object]) -> None:
        self._node = node
        self._publisher = publisher
        self._topic_name = publisher.topic_name
        self._on_close = on_close
        self._closed = False

    def publish(self, message: Any) -> None:
        """Publish a message."""
        try:
            self._publisher.publish(message)
        except RclpyError as error:
            raise explain(self._node, self._publisher.handle, error) from error

    def subscriptions(self) -> int:
        """Return how many subscriptions are matched."""
        try:
            return int(self._publisher.get_subscription_count())
        except RclpyError as error:
            raise explain(self._node, self._publisher.handle, error) from error

    def reaches(self, client: Hashable) -> bool:
        """Return whether a client's process has a subscription, and it is matched.

        rclpy only counts those that are matched, so all that the graph shows have to be.
        """
        # First, so that none counts that is discovered during the query.
        matched = self.subscriptions()
        qos = self._publisher.qos_profile
        with uses_node(self._node):
            readers = self._node.get_subscriptions_info_by_topic(self._topic_name)
            shown = [reader for reader in readers if compatible(qos, reader.qos_profile)]
        process = client[:GUID_PREFIX] if isinstance(client, bytes) else None
        return process in prefixes(shown) and matched >= len(shown)

    def acknowledged(self) -> bool:
        """Return whether every matched subscription is known to have received every message."""
        try:
            return bool(self._publisher.wait_for_all_acked(Duration()))
        except RclpyError as error:
            if is_destroyed(self._publisher.handle):
                raise explain(self._node, self._publisher.handle, error) from error
            return True

    def close(self) -> None:
        """Destroy the publisher; idempotent."""
        if not self._closed:
            self._closed = True
            self._on_close(self)
            self._node.destroy_publisher(self._publisher)


class _Subscription:
    """What the subscriptions of both bridges share."""

    def __init__(self, node: Node, deliver: DeliverMessage) -> None:
        self._node = node
        self._deliver = deliver
        self._closed = False
        self._subscription: Any = None

    def drain(self) -> None:
        """Do nothing: the executor takes the messages."""

    def publishers(self) -> int:
        """Return how many publishers are matched."""
        try:
            return int(self._subscription.get_publisher_count())
        except RclpyError as error:
            raise explain(self._node, self._subscription.handle, error) from error

    def _take_next(self) -> tuple[Any, Any] | None:
        """Take a message, with its info; None if there is none, or one that cannot be read."""
        subscription = self._subscription
        try:
            taken: tuple[Any, Any] | None = subscription.handle.take_message(
                subscription.msg_type, subscription.raw
            )
        except InvalidHandle:
            return None
        except RclpyError as error:
            logger.error(
                "a message on %s could not be read and is dropped: compare the versions of the "
                "type's package on both sides (%s)",
                subscription.topic,
                error,
            )
            return None
        return taken


class DirectSubscription(_Subscription):
    """An rcl subscription that the loop's thread takes from."""

    def __init__(
        self,
        node: Node,
        subscription: Any,
        rcl: Rcl,
        signals: Signals[DirectSubscription],
        deliver: DeliverMessage,
        retire: Callable[[Callable[[], object]], None],
    ) -> None:
        super().__init__(node, deliver)
        self._subscription = subscription
        self._rcl = rcl
        self._signals = signals
        self._retire = retire
        self._signal = signals.join(self)
        if not rcl.signal_messages(subscription.handle, self._signal.fd):
            signals.leave(self, self._signal)
            check_up(node)
            raise RosasyncError(
                "the middleware does not support new-message callbacks: use bridge='executor'"
            )

    def take(self) -> None:
        """Take and deliver messages until the queue is empty.

        The number of signals is no measure: Fast DDS signals messages once that a lost one held up.
        """
        for _ in range(BATCH):
            taken = None if self._closed else self._take_next()
            if taken is None:
                return
            try:
                self._deliver(taken[0])
            except Exception as error:
                self._signals.loop.call_exception_handler(
                    {"message": f"{self._deliver!r} failed", "exception": error}
                )
        self._signals.loop.call_soon(self.take)

    def drain(self) -> None:
        """Take and deliver messages at once."""
        self.take()

    def close(self) -> None:
        """Stop delivering, and have the subscription destroyed; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._rcl.signal_messages(self._subscription.handle, None)
        self._signals.leave(self, self._signal)
        self._retire(partial(self._node.destroy_subscription, self._subscription))


def take_messages(signal: Signal[DirectSubscription], signalled: int) -> None:
    """Take from the subscriptions that share a signal."""
    for subscription in tuple(signal.members):
        subscription.take()


class ExecutorSubscription(_Subscription):
    """An rclpy subscription that the executor takes from."""

    def __init__(
        self,
        node: Node,
        gateway: LoopGateway,
        deliver: DeliverMessage,
        on_close: Callable[[ExecutorSubscription], object],
    ) -> None:
        super().__init__(node, deliver)
        self._gateway = gateway
        self._on_close = on_close

    def begin(self, subscription: Any) -> None:
        """Set the rclpy subscription, whose callback is `take`."""
        self._subscription = subscription

    def take(self, message: Any) -> None:
        """Pass this message and those queued behind it to the loop. On the executor's thread.

        So that the queue does not overflow: the executor waits again before each message.
        """
        self._gateway.post_if_open(self._arrived, message)
        # Not set yet if the executor is quicker than `begin`.
        if self._subscription is None or is_destroyed(self._subscription.handle):
            return
        for _ in range(BATCH):
            taken = self._take_next()
            if taken is None:
                return
            self._gateway.post_if_open(self._arrived, taken[0])

    def close(self) -> None:
        """Destroy the subscription; idempotent."""
        if not self._closed:
            self._closed = True
            self._on_close(self)
            self._node.destroy_subscription(self._subscription)

    def _arrived(self, message: Any) -> None:
        if not self._closed:
            self._deliver(message)
