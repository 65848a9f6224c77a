"""A process of stock rclpy action clients: ``python -m tests.support.action_clients``.

Everything of rclpy happens in the one thread that spins: Jazzy's action client has no lock.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

from tests.support.executor import run_in, spin
from tests.support.process import NodeProcess
from tests.support.times import LIMIT

__all__ = ["ActionClientProcess", "Ended"]

T = TypeVar("T")


class Ended(NamedTuple):
    """The end of a goal: its status, and the sequence of its result."""

    status: int
    sequence: list[int]


class ActionClientProcess(NodeProcess):
    """The parent's side of one such process. Its actions are all ``Fibonacci``."""

    module = "tests.support.action_clients"

    async def send(self, name: str, order: int = 0) -> str | None:
        """Send a goal with an ``ActionClient``, and ask for its result once it is accepted.

        Returns:
            Its id in hexadecimal digits; None if it was rejected.
        """
        result: str | None = await asyncio.to_thread(self.ask_first, "send", name=name, order=order)
        return result

    async def ended(self, goal: str) -> Ended:
        """Wait for the result that `send` has asked for."""
        return Ended(*await self.ask("ended", goal=goal))

    async def feedback(self, goal: str, at_least: int = 0) -> list[list[int]]:
        """Wait for feedback, and return the sequences of all so far."""
        result: list[list[int]] = await self.ask("feedback", goal=goal, at_least=at_least)
        return result

    async def cancel_handle(self, goal: str) -> tuple[int, list[str]]:
        """Cancel a goal with its ``ClientGoalHandle``; return the code and the ids cancelled."""
        code, goals = await self.ask("cancel_handle", goal=goal)
        return code, goals

    async def cancel(
        self, name: str, goal: str = "00" * 16, stamp: int = 0
    ) -> tuple[int, list[str]]:
        """Call ``cancel_goal``; return the code and the ids of the goals that are cancelled."""
        code, goals = await self.ask("cancel", name=name, goal=goal, stamp=stamp)
        return code, goals

    async def result(self, name: str, goal: str) -> Ended:
        """Call ``get_result`` with a service client."""
        return Ended(*await self.ask("result", name=name, goal=goal))

    async def request(self, name: str, goal: str, order: int = 0) -> tuple[bool, int]:
        """Call ``send_goal`` with a service client; return whether accepted, and the stamp."""
        accepted, stamp = await self.ask("request", name=name, goal=goal, order=order)
        return accepted, stamp

    async def watch(self, name: str) -> None:
        """Subscribe to the status topic, and wait until it is matched."""
        await self.ask("watch", name=name)

    async def statuses(self, name: str, goal: str, last: int) -> list[int]:
        """Wait until a goal's status on the topic is ``last``; return all, without repetitions."""
        result: list[int] = await self.ask("statuses", name=name, goal=goal, last=last)
        return result

    async def listed(self, name: str) -> dict[str, int]:
        """Return the goals in the newest status message, with their statuses."""
        result: dict[str, int] = await self.ask("listed", name=name)
        return result


@dataclass
class _Goal:
    feedback: list[list[int]] = field(default_factory=list)
    handle: Any = None
    result: Any = None


class _Clients:
    """The child's side."""

    def __init__(self, node: Any, executor: Any) -> None:
        self._node = node
        self._executor = executor
        self._actions: dict[str, Any] = {}
        self._services: dict[tuple[str, str], Any] = {}
        self._goals: dict[str, _Goal] = {}
        self._messages: dict[str, list[dict[str, int]]] = {}

    def send(self, name: str, order: int) -> str | None:
        from rclpy.action import ActionClient
        from test_msgs.action import Fibonacci

        goal = _Goal()

        def client() -> Any:
            if name not in self._actions:
                self._actions[name] = ActionClient(self._node, Fibonacci, name)
            return self._actions[name]

        def on_feedback(message: Any) -> None:
            goal.feedback.append(list(message.feedback.sequence))

        def begin() -> Any:
            return client().send_goal_async(Fibonacci.Goal(order=order), on_feedback)

        def on_accepted() -> None:
            goal.result = goal.handle.get_result_async()

        self._until(lambda: client().server_is_ready())
        goal.handle = self._done(self._run(begin))
        if not goal.handle.accepted:
            return None
        self._run(on_accepted)
        goal_id = bytes(goal.handle.goal_id.uuid).hex()
        self._goals[goal_id] = goal
        return goal_id

    def ended(self, goal: str) -> tuple[int, list[int]]:
        return _ended(self._done(self._goals[goal].result))

    def feedback(self, goal: str, at_least: int) -> list[list[int]]:
        found = self._goals[goal].feedback
        self._until(lambda: len(found) >= at_least)
        return list(found)

    def cancel_handle(self, goal: str) -> tuple[int, list[str]]:
        handle = self._goals[goal].handle
        return _cancelled(self._done(self._run(handle.cancel_goal_async)))

    def cancel(self, name: str, goal: str, stamp: int) -> tuple[int, list[str]]:
        from action_msgs.srv import CancelGoal

        request = CancelGoal.Request()
        request.goal_info.goal_id.uuid = list(bytes.fromhex(goal))
        info = request.goal_info.stamp
        info.sec, info.nanosec = divmod(stamp, 1_000_000_000)
        return _cancelled(self._call(CancelGoal, name, "cancel_goal", request))

    def result(self, name: str, goal: str) -> tuple[int, list[int]]:
        from test_msgs.action import Fibonacci

        service = Fibonacci.Impl.GetResultService
        request = service.Request()
        request.goal_id.uuid = list(bytes.fromhex(goal))
        return _ended(self._call(service, name, "get_result", request))

    def request(self, name: str, goal: str, order: int) -> tuple[bool, int]:
        from test_msgs.action import Fibonacci

        service = Fibonacci.Impl.SendGoalService
        request = service.Request()
        request.goal_id.uuid = list(bytes.fromhex(goal))
        request.goal.order = order
        response = self._call(service, name, "send_goal", request)
        stamp = response.stamp.sec * 1_000_000_000 + response.stamp.nanosec
        return response.accepted, stamp

    def watch(self, name: str) -> None:
        from action_msgs.msg import GoalStatusArray
        from rclpy.qos import DurabilityPolicy, QoSProfile

        messages = self._messages[name] = []

        def on_message(message: Any) -> None:
            messages.append(
                {
                    bytes(each.goal_info.goal_id.uuid).hex(): each.status
                    for each in message.status_list
                }
            )

        def subscribe() -> Any:
            qos = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            topic = f"{name}/_action/status"
            return self._node.create_subscription(GoalStatusArray, topic, on_message, qos)

        subscription = self._run(subscribe)
        self._until(lambda: subscription.get_publisher_count() > 0)

    def statuses(self, name: str, goal: str, last: int) -> list[int]:
        messages: list[dict[str, int]] = []

        def is_last() -> bool:
            # Further messages may come before they are looked through.
            messages[:] = self._messages[name]
            return bool(messages) and messages[-1].get(goal) == last

        self._until(is_last)
        seen: list[int] = []
        for message in messages:
            status = message.get(goal)
            if status is not None and status not in seen[-1:]:
                seen.append(status)
        return seen

    def listed(self, name: str) -> dict[str, int]:
        return self._messages[name][-1]

    def _call(self, service: Any, name: str, part: str, request: Any) -> Any:
        def client() -> Any:
            key = name, part
            if key not in self._services:
                self._services[key] = self._node.create_client(service, f"{name}/_action/{part}")
            return self._services[key]

        self._until(lambda: client().service_is_ready())
        return self._done(self._run(lambda: client().call_async(request)))

    def _done(self, future: Any) -> Any:
        self._until(future.done)
        return future.result()

    def _until(self, condition: Callable[[], object]) -> None:
        end = time.monotonic() + LIMIT
        while not self._run(condition):
            assert time.monotonic() < end, f"not within {LIMIT:g} s"
            time.sleep(0.005)

    def _run(self, function: Callable[[], T]) -> T:
        return run_in(self._executor, function)


def _ended(response: Any) -> tuple[int, list[int]]:
    return response.status, list(response.result.sequence)


def _cancelled(response: Any) -> tuple[int, list[str]]:
    goals = [bytes(info.goal_id.uuid).hex() for info in response.goals_canceling]
    return response.return_code, goals


def main() -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("stock_action_client")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spin(executor, _Clients(node, executor))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
