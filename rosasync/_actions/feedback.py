"""FeedbackSender: publishes the feedback of a server's goals, also for clients that are new."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Hashable
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rosasync._core.ports import PortDestroyed
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import PublisherPort
    from rosasync._server.service_call import ServiceCall

__all__ = ["FeedbackSender"]

HOLD_TIME = 1.0
"""Maximum number of seconds from a goal's acceptance for which its feedback is held back."""
SETTLE_TIME = 0.3
"""Seconds from the match of a subscription after which it surely gets messages at once. Before, it
may have to learn from the next heartbeat with which message the topic begins for it."""
MOST_HELD = 100
"""Maximum number of messages of a goal that are held back."""
BURST = 5
"""Messages sent at a time: half the depth of a stock client's queue, which silently drops more."""
PERIOD = 0.005
"""Seconds between two bursts, and between two looks at a client that is not matched."""
MOST_CLIENTS = 1000
"""Maximum number of clients that are remembered."""


@dataclass(eq=False, slots=True)
class _Goal:
    """A goal of a client that is not known to get messages at once.

    Attributes:
        request: the request that was answered with the acceptance.
        until: the loop time until which its feedback may be held back.
        messages: the feedback that is held back.
        matched_at: the loop time since which its client is matched, or not waited for. None until
            some feedback may be sent.
        then: sends its result, once it has ended.
    """

    request: ServiceCall[Any, Any]
    until: float
    messages: deque[Any] = field(default_factory=deque)
    matched_at: float | None = None
    then: Callable[[], None] | None = None


class FeedbackSender:
    """Publishes feedback, so that it reaches the client of its goal, and before the result.

    The topic keeps nothing for late subscriptions, and a new client may be able to send a goal
    before its subscription is matched: then feedback is held back. And what is published right
    after the match may arrive some heartbeats later: then the result is held back until it has
    arrived. Nothing is held back for a client that was reached before.

    Confined to the loop's thread.

    Args:
        publish: publishes a message.
        find_publisher: returns the publisher of the topic.
        graph_events: whether `on_graph` is called for each change of the graph.
    """

    def __init__(
        self,
        publish: Callable[[Any], None],
        find_publisher: Callable[[], PublisherPort],
        *,
        graph_events: bool,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._publish = publish
        self._find_publisher = find_publisher
        self._graph_events = graph_events
        # The clients that get messages at once. Only until the graph changes: a client of rosasync
        # makes a new subscription if its last goal was some time ago.
        self._reached: dict[Hashable, None] = {}
        # Those that were not matched in time. Some have no subscription at all.
        self._unreachable: dict[Hashable, None] = {}
        self._goals: dict[bytes, _Goal] = {}
        # Runs while messages are held back, or a result.
        self._timer: asyncio.TimerHandle | None = None

    def accept(self, goal_id: bytes, request: ServiceCall[Any, Any]) -> None:
        """Prepare for the feedback of a goal, before its handler begins.

        Args:
            goal_id: the bytes of its UUID.
            request: the request that was answered with the acceptance.
        """
        client = request.client
        if client is None or client in self._reached or client in self._unreachable:
            return
        self._goals[goal_id] = _Goal(request, self._loop.time() + HOLD_TIME)

    def send(self, goal_id: bytes, message: Any) -> None:
        """Publish feedback of a goal, or hold it back; it may be changed afterwards."""
        goal = self._goals.get(goal_id) if self._goals else None
        if goal is None:
            self._publish(message)
            return
        if goal.messages or not self._may_send(goal):
            goal.messages.append(deepcopy(message))
            self._poll_soon()
            return
        self._publish(message)
        if self._is_settled(goal):
            del self._goals[goal_id]

    def end(self, goal_id: bytes, then: Callable[[], None]) -> None:
        """Call a function that sends the result of a goal, after its feedback has arrived."""
        goal = self._goals.get(goal_id) if self._goals else None
        if goal is None:
            then()
            return
        goal.then = then
        self._advance(goal_id, goal)

    async def wait(self) -> None:
        """Wait until nothing is held back, `HOLD_TIME` and `SETTLE_TIME` at most."""
        while self._timer is not None:  # noqa: ASYNC110
            await asyncio.sleep(PERIOD)

    def on_graph(self) -> None:
        """Forget who was reached, because a subscription may have been replaced."""
        self._reached.clear()

    def close(self) -> None:
        """Drop what is held back; idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._goals.clear()

    def _advance(self, goal_id: bytes, goal: _Goal) -> None:
        """Send what may be sent for a goal, and come back for the rest."""
        if goal.messages and self._may_send(goal):
            for _ in range(min(BURST, len(goal.messages))):
                self._publish(goal.messages.popleft())
        if not goal.messages:
            if goal.then is None:
                return
            if goal.matched_at is None or self._is_settled(goal):
                self._goals.pop(goal_id, None)
                goal.then()
                return
        self._poll_soon()

    def _may_send(self, goal: _Goal) -> bool:
        """Return whether the client of a goal is matched, or not waited for any longer."""
        if goal.matched_at is not None:
            return True
        now, client = self._loop.time(), goal.request.client
        # Stock clients drop feedback that precedes the acceptance.
        if client in self._reached or (goal.request.sent and self._reaches(client)):
            # One that has had all this time to be matched is settled, too.
            goal.matched_at = min(now, goal.until - SETTLE_TIME)
        elif now >= goal.until or len(goal.messages) >= MOST_HELD:
            goal.matched_at = now - SETTLE_TIME
            _remember(self._unreachable, client)
        return goal.matched_at is not None

    def _is_settled(self, goal: _Goal) -> bool:
        """Return whether the client of a goal has got what was sent, and will get more at once."""
        assert goal.matched_at is not None
        if self._loop.time() < goal.matched_at + SETTLE_TIME and not self._is_acknowledged():
            return False
        if self._graph_events:
            _remember(self._reached, goal.request.client)
        return True

    def _reaches(self, client: Hashable) -> bool:
        with suppress(ContextShutdown, PortDestroyed):
            return self._find_publisher().reaches(client)
        return True

    def _is_acknowledged(self) -> bool:
        with suppress(ContextShutdown, PortDestroyed):
            return self._find_publisher().acknowledged()
        return True

    def _poll_soon(self) -> None:
        if self._timer is None:
            self._timer = self._loop.call_later(PERIOD, self._poll)

    def _poll(self) -> None:
        self._timer = None
        for goal_id, goal in tuple(self._goals.items()):
            if goal.messages or goal.then is not None:
                # The session notices the shutdown of the context by itself.
                with suppress(ContextShutdown):
                    self._advance(goal_id, goal)


def _remember(clients: dict[Hashable, None], client: Hashable) -> None:
    """Add a client, and forget the oldest if there are too many."""
    clients[client] = None
    if len(clients) > MOST_CLIENTS:
        del clients[next(iter(clients))]
