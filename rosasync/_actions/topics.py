"""ActionTopics: the feedback and the statuses of an action's goals, as they arrive."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Hashable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, TypeAlias

from rosasync._actions.status import GoalStatus, read_statuses, uuid_bytes, uuid_of
from rosasync._core.ports import TopicQos
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal
    from rosasync._core.ports import Action, NodePort, SubscriptionPort

__all__ = ["ActionTopics"]

FindGoal: TypeAlias = "Callable[[bytes], ActiveGoal | None]"

logger = logging.getLogger("rosasync")

STATUS_PAUSE = 0.02
"""Seconds between two readings of the status topic: only the newest message counts."""

FEEDBACK_QOS = TopicQos(depth=1000)
STATUS_QOS = TopicQos(depth=1, latched=True)


class ActionTopics:
    """One subscription to each topic of an action, however many goals are out.

    Both carry the messages for every client's goals, so they deliver bytes, and only what is for a
    goal of this client is read. Confined to the loop's thread.

    Args:
        action: the action.
        node: creates the subscriptions.
        find: returns the goal that is out under the bytes of a UUID, or None.
        on_status: called with a goal and a status of it that comes after the last one known.
    """

    def __init__(
        self,
        action: Action,
        node: NodePort,
        find: FindGoal,
        on_status: Callable[[ActiveGoal, GoalStatus], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._action = action
        self._types = action.action_type.Impl
        self._node = node
        self._find = find
        self._report_status = on_status
        self._feedback: SubscriptionPort | None = None
        self._statuses: SubscriptionPort | None = None
        # Whether the subscription to statuses has got a message, and who published the topic then.
        self._has_status = False
        self._heard: frozenset[Hashable] = frozenset()
        # Whether it is going to get one, because one of them is still there.
        self._expects_status = False
        # The newest message of the status topic that was not read, and the timer that reads it.
        self._unread_status: bytes | None = None
        self._timer: asyncio.TimerHandle | None = None

    def open(self) -> None:
        """Subscribe, unless it has; raises as `NodePort.open_subscription`."""
        if self._feedback is None:
            self._feedback = self._node.open_subscription(
                self._types.FeedbackMessage,
                self._action.feedback_topic,
                FEEDBACK_QOS,
                self._on_feedback,
                raw=True,
            )
        if self._statuses is None:
            self._statuses = self._node.open_subscription(
                self._types.GoalStatusMessage,
                self._action.status_topic,
                STATUS_QOS,
                self._on_status,
                raw=True,
            )
            self._has_status = False
            self._expects_status = not self._heard.isdisjoint(self._find_publishers())

    def ready(self) -> bool:
        """Return whether the feedback of a goal would arrive, as far as known.

        The server has to be matched with the subscription, too, which the client cannot see. But it
        learns of the subscriptions in their order, and the status topic keeps a message for a late
        one. So the first status shows that the server is matched with the one to feedback. A server
        that has had no goal yet sends none.

        Raises:
            PortDestroyed, ContextShutdown: as `SubscriptionPort.publishers`.
        """
        if self._feedback is None or self._statuses is None or not self._feedback.publishers():
            return False
        if self._expects_status and not self._has_status:
            self._statuses.drain()
            return self._has_status
        return True

    def drain_feedback(self) -> None:
        """Deliver the feedback that has arrived already."""
        if self._feedback is not None:
            self._feedback.drain()

    def read_feedback(self, serialized: bytes) -> Any:
        """Return the feedback in a message of the topic.

        Raises:
            ValueError: it cannot be read, which was logged.
        """
        try:
            return self._node.deserialize_feedback(self._action.action_type, serialized)
        except ValueError as error:
            logger.error("%s: a feedback message is dropped: %s", self._action.name, error)
            raise

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._unread_status = None
        for port in (self._feedback, self._statuses):
            if port is not None:
                port.close()
        self._feedback = self._statuses = None

    def _on_feedback(self, serialized: bytes) -> None:
        goal = self._find(uuid_bytes(serialized))
        if goal is not None:
            goal.put_feedback(serialized)

    def _find_publishers(self) -> frozenset[Hashable]:
        return self._node.queries.find_publishers(self._action.status_topic)

    def _on_status(self, serialized: bytes) -> None:
        """Read a status message, at once or after a pause, in which a newer one may replace it."""
        if not self._has_status:
            self._has_status = True
            with suppress(ContextShutdown):
                self._heard = self._find_publishers()
        self._unread_status = serialized
        if self._timer is None:
            self._read_status()
            self._timer = self._loop.call_later(STATUS_PAUSE, self._end_pause)

    def _end_pause(self) -> None:
        self._timer = None
        if self._unread_status is not None:
            self._on_status(self._unread_status)

    def _read_status(self) -> None:
        serialized, self._unread_status = self._unread_status, None
        assert serialized is not None
        try:
            statuses = self._decode_statuses(serialized)
        except ValueError as error:
            logger.error("%s: a status message is dropped: %s", self._action.name, error)
            return
        for key, status in statuses:
            goal = self._find(key)
            if goal is not None and goal.status < status <= GoalStatus.ABORTED:
                self._report_status(goal, GoalStatus(status))

    def _decode_statuses(self, serialized: bytes) -> Iterable[tuple[bytes, int]]:
        statuses = read_statuses(serialized)
        if statuses is not None:
            return statuses
        message = self._node.deserialize(self._types.GoalStatusMessage, serialized)
        return [(uuid_of(each.goal_info.goal_id), each.status) for each in message.status_list]
