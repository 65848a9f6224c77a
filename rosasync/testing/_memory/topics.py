"""Topics in memory: publishers and subscriptions."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Hashable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rosasync._actions.status_list import decode_statuses
from rosasync._ros.messages import make_message
from rosasync._ros.types import type_name

if TYPE_CHECKING:
    from rosasync._core.ports import DeliverMessage, TopicQos

__all__ = ["MemoryPublisher", "MemorySubscription", "Topics", "deserialize"]


@dataclass
class Topics:
    """The publishers and subscriptions of a graph."""

    publishers: list[MemoryPublisher] = field(default_factory=list)
    subscriptions: list[MemorySubscription] = field(default_factory=list)


class MemoryPublisher:
    """A publisher in memory: a `rosasync._core.ports.PublisherPort`.

    Attributes:
        identity: what the graph tells it by; its beginning names the process.
    """

    def __init__(
        self, topics: Topics, msg_type: Any, topic_name: str, qos: TopicQos, identity: bytes
    ) -> None:
        self.msg_type = msg_type
        self.topic_name = topic_name
        self.identity = identity
        self.closed = False
        self._topics = topics
        self._kept: deque[Any] = deque(maxlen=qos.depth if qos.latched else 0)
        topics.publishers.append(self)
        for subscription in self._matched():
            subscription.catch_up(self)

    @property
    def kept(self) -> tuple[Any, ...]:
        """The messages that a new latched subscription gets."""
        return tuple(self._kept)

    def publish(self, message: Any) -> None:
        """Send a copy of a message to every subscription of the topic."""
        if isinstance(message, bytes):
            # The only serialized message that rosasync publishes.
            message = make_message(self.msg_type, decode_statuses(message))
        copy = deepcopy(message)
        self._kept.append(copy)
        for subscription in self._matched():
            subscription.receive(copy)

    def subscriptions(self) -> int:
        """Return how many subscriptions the topic has."""
        return len(self._matched())

    def reaches(self, client: Hashable) -> bool:
        """Return True: in memory, a subscription is matched as soon as it exists."""
        return True

    def acknowledged(self) -> bool:
        """Return True: in memory, messages arrive in the order in which they were published."""
        return True

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if not self.closed:
            self.closed = True
            self._topics.publishers.remove(self)

    def _matched(self) -> list[MemorySubscription]:
        return [each for each in self._topics.subscriptions if each.matches(self)]


class MemorySubscription:
    """A subscription in memory: a `rosasync._core.ports.SubscriptionPort`."""

    def __init__(
        self,
        topics: Topics,
        msg_type: Any,
        topic_name: str,
        qos: TopicQos,
        deliver: DeliverMessage,
        raw: bool,
    ) -> None:
        self.msg_type = msg_type
        self.topic_name = topic_name
        self.closed = False
        self._topics = topics
        self._qos = qos
        self._deliver = deliver
        self._raw = raw
        self._queue: deque[Any] = deque(maxlen=qos.depth)
        self._loop = asyncio.get_running_loop()
        topics.subscriptions.append(self)
        for publisher in topics.publishers:
            self.catch_up(publisher)

    def matches(self, publisher: MemoryPublisher) -> bool:
        """Return whether a publisher is of this topic and type."""
        return (publisher.topic_name, publisher.msg_type) == (self.topic_name, self.msg_type)

    def catch_up(self, publisher: MemoryPublisher) -> None:
        """Receive what a publisher has kept, if this subscription is latched."""
        if self._qos.latched and self.matches(publisher):
            for message in publisher.kept:
                self.receive(message)

    def receive(self, message: Any) -> None:
        """Queue a message and deliver it in the next turn of the loop; the oldest may be lost."""
        if not self._queue:
            self._loop.call_soon(self.drain)
        self._queue.append(message)

    def publishers(self) -> int:
        """Return how many publishers the topic has."""
        return sum(self.matches(publisher) for publisher in self._topics.publishers)

    def close(self) -> None:
        """Leave the graph; idempotent."""
        if not self.closed:
            self.closed = True
            self._queue.clear()
            self._topics.subscriptions.remove(self)

    def drain(self) -> None:
        """Deliver the queued messages."""
        messages = tuple(self._queue)
        self._queue.clear()
        for message in messages:
            if not self.closed:
                self._deliver(_Serialized.of(message) if self._raw else deepcopy(message))


class _Serialized(bytes):
    """What stands for a serialized message: its head, as far as rosasync reads it, and itself."""

    message: Any

    @classmethod
    def of(cls, message: Any) -> _Serialized:
        """Serialize a message, with the UUID of its goal where the middleware has it."""
        goal_id = getattr(message, "goal_id", None)
        serialized = cls(b"\0\1\0\0" + (b"" if goal_id is None else bytes(goal_id.uuid)))
        serialized.message = message
        return serialized


def deserialize(message_type: Any, data: bytes) -> Any:
    """Return a copy of the message that a raw subscription got.

    Raises:
        ValueError: it is not of this type.
    """
    if isinstance(data, _Serialized) and isinstance(data.message, message_type):
        return deepcopy(data.message)
    raise ValueError(f"not a message of {type_name(message_type)}")
