"""An action server in memory that does only what its test says, in any order."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from action_msgs.msg import GoalStatus as Status
from test_msgs.action import Fibonacci

from rosasync import GoalStatus
from rosasync._core.ports import TopicQos, Undeliverable
from rosasync.testing._memory.graph import MemoryNode
from tests.support.fake_graph import FakeGraph

__all__ = ["ScriptedAction"]

Impl = Fibonacci.Impl
Key = bytes

RUNNING = (GoalStatus.ACCEPTED, GoalStatus.EXECUTING, GoalStatus.CANCELING)


class ScriptedAction:
    """A server of ``Fibonacci`` that holds every request until it is told what to answer.

    Attributes:
        statuses: the goals that it has accepted.
        orders: what they ask for.
        prompt: whether it answers everything at once: it accepts each goal, agrees to each
            cancellation, and ends a goal that is being cancelled.
    """

    def __init__(self, graph: FakeGraph, name: str = "/fibonacci") -> None:
        self.statuses: dict[Key, GoalStatus] = {}
        self.orders: dict[Key, int] = {}
        self.prompt = False
        self.sends: list[tuple[Any, Any]] = []
        self.cancels: list[tuple[Any, Any]] = []
        self.asks: list[tuple[Any, Any]] = []
        self._node = MemoryNode(graph)
        self._action = self._node.describe_action(Fibonacci, name)
        self._feedback_numbers = itertools.count()
        self._loop = asyncio.get_running_loop()
        self._open()

    def _open(self) -> None:
        node, action = self._node, self._action
        self._send = node.open_service(action.send_goal, lambda *pair: self._hold(self.sends, pair))
        self._cancel = node.open_service(
            action.cancel_goal, lambda *pair: self._hold(self.cancels, pair)
        )
        self._result = node.open_service(
            action.get_result, lambda *pair: self._hold(self.asks, pair)
        )
        self._feedback = node.open_publisher(
            Impl.FeedbackMessage, action.feedback_topic, TopicQos()
        )
        self._status = node.open_publisher(
            Impl.GoalStatusMessage, action.status_topic, TopicQos(1, latched=True)
        )

    @property
    def running(self) -> list[Key]:
        """The goals that have not ended."""
        return [key for key, status in self.statuses.items() if status in RUNNING]

    def vanish(self) -> None:
        """Leave the graph, with every goal and request."""
        self.cut()
        self.cancels.clear()
        self.asks.clear()
        self.statuses.clear()

    def cut(self) -> None:
        """Leave the graph as if the network were cut: its goals run on, those sent are lost."""
        for service in (self._send, self._cancel, self._result):
            service.stop()
            service.close()
        for publisher in (self._feedback, self._status):
            publisher.close()
        self.sends.clear()

    def lose_topics(self) -> None:
        """Publish nothing any more."""
        self._feedback.close()
        self._status.close()

    def come_back(self, topics: bool = True) -> None:
        """Be there again, with the goals it still has. For the graph it is another server."""
        self._open()
        if not topics:
            self.lose_topics()

    def close(self) -> None:
        self.vanish()
        self._node.close()

    # What a test makes it do: each takes the number of the request or goal, modulo how many.

    def answer_send(self, number: int, accept: bool = True) -> None:
        for request, header in _pick(self.sends, number):
            key = bytes(request.goal_id.uuid)
            if accept:
                self.statuses[key] = GoalStatus.EXECUTING
                self.orders[key] = request.goal.order
            _reply(self._send, header, Impl.SendGoalService.Response(accepted=accept))
            if accept:
                self.publish_status()

    def answer_cancel(self, number: int, agree: bool = True) -> None:
        for request, header in _pick(self.cancels, number):
            key = bytes(request.goal_info.goal_id.uuid)
            response = Impl.CancelGoalService.Response()
            status = self.statuses.get(key)
            if status is None:
                response.return_code = response.ERROR_UNKNOWN_GOAL_ID
            elif status not in RUNNING or status is GoalStatus.CANCELING:
                response.return_code = response.ERROR_GOAL_TERMINATED
            elif agree:
                self.statuses[key] = GoalStatus.CANCELING
                response.goals_canceling = [request.goal_info]
            else:
                response.return_code = response.ERROR_REJECTED
            _reply(self._cancel, header, response)
            if self.prompt and self.statuses.get(key) is GoalStatus.CANCELING:
                self._end(key, GoalStatus.CANCELED)

    def answer_ask(self, number: int) -> None:
        """Send a result, if its goal has ended or is not known."""
        for request, header in _pick(self.asks, number):
            status = self.statuses.get(key := bytes(request.goal_id.uuid), GoalStatus.UNKNOWN)
            if status in RUNNING:
                self.asks.append((request, header))
                return
            response = Impl.GetResultService.Response(status=int(status))
            if status:
                response.result.sequence = [self.orders[key]]
            _reply(self._result, header, response)

    def lose_ask(self, number: int) -> None:
        """Lose a request for a result, as a full queue does."""
        list(_pick(self.asks, number))

    def end_goal(self, number: int, status: GoalStatus) -> None:
        for key in _pick(self.running, number):
            self._end(key, status)

    def publish_feedback(self, number: int) -> None:
        if self._feedback.closed:
            return
        for key in _pick(list(self.statuses), number):
            message = Impl.FeedbackMessage()
            message.goal_id.uuid = list(key)
            message.feedback.sequence = [self.orders[key], next(self._feedback_numbers)]
            self._feedback.publish(message)

    def publish_status(self) -> None:
        if self._status.closed:
            return
        message = Impl.GoalStatusMessage()
        entries = []
        for key, status in self.statuses.items():
            entry = Status()
            entry.goal_info.goal_id.uuid = list(key)
            entry.status = int(status)
            entries.append(entry)
        message.status_list = entries
        self._status.publish(message)

    def answer_all(self) -> None:
        """Answer everything that is held, as a prompt server does."""
        for key in self.running:
            if self.statuses[key] is GoalStatus.CANCELING:
                self._end(key, GoalStatus.CANCELED)
        while self.sends:
            self.answer_send(0)
        while self.cancels:
            self.answer_cancel(0)
        for _ in tuple(self.asks):
            self.answer_ask(0)

    def _hold(self, held: list[tuple[Any, Any]], pair: tuple[Any, Any]) -> None:
        held.append(pair)
        if self.prompt:
            self._loop.call_soon(self.answer_all)

    def _end(self, key: Key, status: GoalStatus) -> None:
        self.statuses[key] = status
        self.publish_status()
        if self.prompt:
            self._loop.call_soon(self.answer_all)


def _reply(port: Any, header: Any, response: Any) -> None:
    # The client may be gone.
    with suppress(Undeliverable):
        port.send(header, response)


def _pick(items: list[Any], number: int) -> Iterator[Any]:
    """Take one of some items, if there is any."""
    if items:
        yield items.pop(number % len(items))
