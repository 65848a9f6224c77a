"""ServerGoals: what an action server tells its clients of its goals: status and results."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rosasync._actions.goal_table import CancelSelection, GoalEvent, GoalRecord, GoalTable
from rosasync._actions.status import GoalStatus
from rosasync._actions.status_list import StatusList
from rosasync._server.resending import RESEND_TIME
from rosasync._status.wire import Outcome
from rosasync.errors import ContextShutdown, SessionClosed

if TYPE_CHECKING:
    from rosasync._actions.feedback import FeedbackSender
    from rosasync._server.service_call import ServiceCall

__all__ = ["ServerGoals"]

logger = logging.getLogger("rosasync")

FEW = 100
"""Goals up to which the status is published in the next turn of the loop. A message lists every
goal that has not expired, so it costs more and more: with more goals, it waits for further changes.
"""
DELAY = 20e-6
"""Seconds by which each goal that is listed then delays the message."""
MAX_DELAY = 0.05
"""Maximum number of seconds of this delay."""
ASKING_TIME = 4.0
"""Seconds after an acceptance was sent in which its client may be about to ask for the result. The
middleware of a stock client repairs a lost request after 3 s."""
ASKING_INTERVAL = 0.05
"""Seconds between two queries whether any client is left that could ask."""


class ServerGoals:
    """The goals of a server, their status on the topic, and their results for those who ask.

    Confined to the loop's thread.

    Args:
        name: the action's name, for the log.
        table: the goals.
        publish_status: publishes the serialized status message.
        feedback: publishes the feedback, which comes before the results.
        response_type: the class of the responses of ``get_result``.
    """

    def __init__(
        self,
        name: str,
        table: GoalTable,
        publish_status: Callable[[bytes], None],
        feedback: FeedbackSender,
        response_type: type[Any],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._name = name
        self._table = table
        self._publish_status = publish_status
        self._feedback = feedback
        self._response_type = response_type
        self._statuses = StatusList()
        # Set while `_publish` is scheduled. One message serves all changes until then: it lists
        # every goal, and its subscribers keep the last message only.
        self._publishing: asyncio.Handle | None = None
        # A goal is in `_askers` until its result is sent, and from its end until it expires in
        # `_responses`.
        self._askers: dict[bytes, list[ServiceCall[Any, Any]]] = {}
        self._responses: dict[bytes, Any] = {}
        # The goals whose result no client has asked for yet, and when they were accepted.
        self._unasked: dict[bytes, float] = {}
        self._asked = asyncio.Event()
        # Runs when the first of the goals that have ended expires.
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False

    @property
    def kept(self) -> int:
        """The number of results that are kept."""
        return len(self._responses)

    @property
    def asking(self) -> int:
        """The number of requests for results that wait for the end of their goal."""
        return sum(map(len, self._askers.values()))

    @property
    def closed(self) -> bool:
        """Whether the server has ended."""
        return self._closed

    def knows(self, goal_id: bytes) -> bool:
        """Return whether a goal was accepted and has not expired."""
        return self._table.get(goal_id) is not None

    def select(self, goal_id: bytes, stamp: int) -> CancelSelection:
        """Return the goals that a cancel request asks for; see `GoalTable.select`."""
        return self._table.select(goal_id, stamp)

    def accept(self, goal_id: bytes, stamp: int) -> GoalRecord:
        """Add a goal that was accepted at this time, in ns of the node's clock."""
        record = self._table.accept(goal_id, stamp)
        self._askers[goal_id] = []
        self._unasked[goal_id] = self._loop.time()
        self._show(record)
        return record

    def apply(self, record: GoalRecord, event: GoalEvent) -> bool:
        """Change the status of a goal that has not ended; False if its status does not allow it."""
        if not self._table.apply(record, event, self._loop.time()):
            return False
        self._show(record)
        return True

    def end(self, record: GoalRecord, event: GoalEvent, result: Any) -> bool:
        """End a goal, and send its result to those who wait for it.

        Args:
            record: the goal.
            event: how it ends.
            result: its result, which must not be changed afterwards.

        Returns:
            False if it has ended already.
        """
        if not self.apply(record, event):
            return False
        response = self._response_type()
        response.status = int(record.status)
        response.result = result
        self._responses[record.id] = response
        self._feedback.end(record.id, functools.partial(self._answer, record.id, response))
        self._arm()
        return True

    def on_get_result(self, call: ServiceCall[Any, Any]) -> None:
        """Handle a request for a result: answer it when the goal has ended.

        The handler of the service ``get_result``.
        """
        goal_id = call.request.goal_id.uuid.tobytes()
        if self._unasked.pop(goal_id, None) is not None:
            self._asked.set()
        if goal_id in self._askers:
            self._askers[goal_id].append(call)
        elif goal_id in self._responses:
            self._respond(call, self._responses[goal_id])
        else:
            logger.info(
                "%s: the result of goal %s was asked for, which is unknown or has expired",
                self._name,
                goal_id.hex(),
            )
            # The result of a fresh response is an empty one.
            call.response.status = int(GoalStatus.UNKNOWN)
            self._respond(call, call.response)

    async def until_asked(self, age: float, count_clients: Callable[[], int]) -> None:
        """Wait for the requests for results that may be on their way.

        A client learns that its goal is accepted, and asks then. If the server ended in between, it
        would wait for ever.

        Args:
            age: seconds since the last acceptance was sent. It may have been sent long after the
                goal was accepted: the middleware may not have discovered its client.
            count_clients: counts the clients that are left; raises ContextShutdown.
        """
        until = self._loop.time() + ASKING_TIME - age
        # The acceptances of the others were sent, or given up, long ago.
        since = self._loop.time() - age - RESEND_TIME
        recent = {goal_id for goal_id, accepted in self._unasked.items() if accepted > since}
        with contextlib.suppress(ContextShutdown):
            while not recent.isdisjoint(self._unasked) and count_clients():
                left = until - self._loop.time()
                if left <= 0:
                    return
                self._asked.clear()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._asked.wait(), min(left, ASKING_INTERVAL))

    def flush(self) -> None:
        """Publish the status at once, if it has changed since it was published."""
        if self._publishing is not None:
            self._publishing.cancel()
            self._publish()

    def close(self) -> None:
        """Stop publishing, and let nothing expire any more; idempotent."""
        self._closed = True
        for handle in (self._timer, self._publishing):
            if handle is not None:
                handle.cancel()

    def _show(self, record: GoalRecord) -> None:
        self._statuses.set(record.id, record.stamp, record.status)
        if self._publishing is not None or self._closed:
            return
        listed = len(self._statuses)
        if listed < FEW:
            self._publishing = self._loop.call_soon(self._publish)
        else:
            delay = min(listed * DELAY, MAX_DELAY)
            self._publishing = self._loop.call_later(delay, self._publish)

    def _publish(self) -> None:
        self._publishing = None
        self._publish_status(self._statuses.encode())

    def _answer(self, goal_id: bytes, response: Any) -> None:
        for call in self._askers.pop(goal_id):
            self._respond(call, response)

    def _respond(self, call: ServiceCall[Any, Any], response: Any) -> None:
        # One that cannot be answered must not keep the others from it.
        try:
            call.respond(response)
        except (SessionClosed, ContextShutdown):
            return
        except Exception:
            logger.exception("%s: a result cannot be sent", self._name)
            call.give_up("given up: its result cannot be sent", Outcome.FAILED, failed=True)

    def _arm(self) -> None:
        if self._timer is None and not self._closed and (due := self._table.expiry()) is not None:
            self._timer = self._loop.call_at(due, self._expire, due)

    def _expire(self, due: float) -> None:
        self._timer = None
        # The loop runs timers up to one clock resolution early.
        for record in self._table.expire(max(due, self._loop.time())):
            del self._responses[record.id]
            self._unasked.pop(record.id, None)
            self._statuses.remove(record.id)
        self._arm()
