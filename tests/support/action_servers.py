"""A process of stock action servers: ``python -m tests.support.action_servers``.

They are of ``rclpy.action.ActionServer``, spun by a ``MultiThreadedExecutor``. What a goal does is
in the script of its server, so a test decides when each goal goes on and how it ends.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from contextlib import suppress
from traceback import extract_tb
from typing import Any, Literal
from uuid import UUID

from tests.support.child import serve_commands
from tests.support.executor import run_in
from tests.support.process import NodeProcess
from tests.support.times import LIMIT, TICK

__all__ = ["FIBONACCI", "ActionServerProcess", "End", "none_runs"]

FIBONACCI = "test_msgs/action/Fibonacci"

End = Literal["succeed", "abort", "raise", "return"]
"""How a goal ends: as succeeded or aborted, by an exception, or without setting a state."""


class ActionServerProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.support.action_servers"

    def __init__(self, node: str = "stock_action_server", **options: Any) -> None:
        super().__init__(node, **options)

    async def serve(self, name: str, action_type: str = FIBONACCI, **options: Any) -> None:
        """Create an action server without blocking the loop; the options are `serve_now`'s."""
        await asyncio.to_thread(self.serve_now, name, action_type, **options)

    def serve_now(
        self,
        name: str,
        action_type: str = FIBONACCI,
        *,
        end: End = "succeed",
        hold: bool = False,
        feedback: int = 0,
        readers: int = 0,
        rate: float = 0.0,
        accept: bool = True,
        accept_delay: float = 0.0,
        accept_later: bool = False,
        cancel: bool = True,
        canceled: End | Literal["canceled"] = "canceled",
        result_timeout: int = 900,
        ignored_asks: int = 0,
        idle: bool = False,
    ) -> None:
        """Create an action server, and return when it exists.

        Args:
            name: the action's name.
            action_type: the name of its type.
            end: how its goals end.
            hold: whether a goal runs until `release` is called, or until it is cancelled.
            feedback: how many feedback messages a goal publishes first.
            readers: how many subscriptions to its feedback have to be discovered before that.
            rate: how many of them in a second; 0 for as many as it can.
            accept: whether it accepts goals.
            accept_delay: seconds before it answers to a goal.
            accept_later: whether it answers to goals when `accept` is called, and not before.
            cancel: whether it agrees to cancel goals.
            canceled: how a goal ends that is cancelled.
            result_timeout: seconds for which it keeps results.
            ignored_asks: how many requests for a result it ignores at first.
            idle: whether a held goal takes no thread of the executor, so that hundreds may run.
        """
        arguments: dict[str, Any] = {
            "name": name,
            "action_type": action_type,
            "end": end,
            "hold": hold,
            "feedback": feedback,
            "readers": readers,
            "rate": rate,
            "accept": accept,
            "accept_delay": accept_delay,
            "accept_later": accept_later,
            "cancel": cancel,
            "canceled": canceled,
            "result_timeout": result_timeout,
            "ignored_asks": ignored_asks,
            "idle": idle,
        }
        self.ask_first("serve", patience=LIMIT, **arguments)

    async def stop(self, name: str) -> None:
        """Destroy the action server."""
        await self.ask("stop", name=name)

    async def accept(self, name: str) -> None:
        """Let the server answer to the goals that have come, and to further ones."""
        await self.ask("accept", name=name)

    async def release(self, name: str) -> None:
        """Let every held goal of the server end, and further ones."""
        await self.ask("release", name=name)

    async def goals(self, name: str, at_least: int = 0) -> dict[UUID, int]:
        """Wait until ``at_least`` goals have been accepted; return the status of each so far."""
        goals: dict[str, int] = await self.ask("goals", name=name, at_least=at_least)
        return {UUID(key): status for key, status in goals.items()}

    async def asked(self, name: str) -> None:
        """Wait until a goal has come to the server, which it may not have accepted yet."""
        await self.ask("asked", name=name)

    async def running(self, name: str, at_least: int = 0) -> list[UUID]:
        """Return the goals that have not ended, once ``at_least`` have been accepted.

        A client may know of its acceptance a moment earlier than the server.
        """
        goals = await self.goals(name, at_least)
        return [key for key, status in goals.items() if status < 4]

    async def forge(self, name: str, goal_id: UUID) -> None:
        """Publish bytes on the feedback topic that are not a message, for a goal.

        Once, so repeat it: a subscription may know its publisher much later than the reverse.
        """
        await self.ask("forge", name=name, goal_id=goal_id.hex)

    def clear_now(self) -> None:
        """Destroy all action servers; blocks."""
        self.ask_now("clear", patience=LIMIT)


async def none_runs(server: ActionServerProcess, name: str) -> None:
    """Wait until the server has no goal that runs."""
    for _ in range(100):
        if not await server.running(name):
            return
        await asyncio.sleep(LIMIT / 100)
    raise AssertionError(f"{await server.running(name)} still run")


class _Server:
    """One action server of the process, and the goals it has accepted."""

    def __init__(self, node: Any, options: dict[str, Any]) -> None:
        from rclpy.action import ActionServer, CancelResponse, GoalResponse
        from rclpy.callback_groups import ReentrantCallbackGroup

        from rosasync._ros.types import action_type

        self._node = node
        self.options = options
        self.type = action_type(options["action_type"])
        self.asked = threading.Event()
        self.accepting = threading.Event()
        if not options["accept_later"]:
            self.accepting.set()
        self.released = threading.Event()
        self.goals: dict[str, Any] = {}
        self.accepted = threading.Condition()
        self._cancel = (CancelResponse.REJECT, CancelResponse.ACCEPT)[options["cancel"]]
        self._accept = (GoalResponse.REJECT, GoalResponse.ACCEPT)[options["accept"]]
        self.server = ActionServer(
            node,
            self.type,
            options["name"],
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=lambda goal: self._cancel,
            result_timeout=options["result_timeout"],
        )
        self._ignored = options["ignored_asks"]
        self._answer_ask = self.server._execute_get_result_request
        self.server._execute_get_result_request = self._take_ask
        self._idle: list[Any] = []
        if options["idle"]:
            threading.Thread(target=self._watch_idle, daemon=True).start()

    def statuses(self) -> dict[str, int]:
        return {key: goal() for key, goal in dict(self.goals).items()}

    async def _take_ask(self, request: Any) -> None:
        if self._ignored > 0:
            self._ignored -= 1
        else:
            await self._answer_ask(request)

    def _watch_idle(self) -> None:
        """Start idle goals when they are to end."""
        while not self.released.wait(0.01):
            for goal in tuple(self._idle):
                if goal.is_cancel_requested:
                    self._idle.remove(goal)
                    goal.execute()
        for goal in self._idle:
            goal.execute()

    def _on_goal(self, goal: Any) -> Any:
        self.asked.set()
        self.accepting.wait()
        time.sleep(self.options["accept_delay"])
        return self._accept

    def _on_accepted(self, goal: Any) -> None:
        last = [0]

        def status() -> int:
            # The handle is destroyed when the result expires.
            with suppress(Exception):
                last[0] = goal.status
            return last[0]

        # First, because a test may release the goals as soon as they are known.
        if self.options["idle"]:
            self._idle.append(goal)
        with self.accepted:
            self.goals[bytes(goal.goal_id.uuid).hex()] = status
            self.accepted.notify_all()
        if not self.options["idle"]:
            goal.execute()

    def _execute(self, goal: Any) -> Any:
        options = self.options
        topic = f"{options['name']}/_action/feedback"
        while self._node.count_subscribers(topic) < options["readers"]:
            time.sleep(0.02)
        if options["readers"]:
            # What is discovered is matched a moment later.
            time.sleep(TICK)
        for number in range(options["feedback"]):
            self._publish(goal, number)
            if options["rate"]:
                time.sleep(1 / options["rate"])
        while options["hold"] and not self.released.wait(0.01):
            if goal.is_cancel_requested:
                return self._end(goal, options["canceled"], 1)
        return self._end(goal, options["end"], getattr(goal.request, "order", 0))

    def _end(self, goal: Any, end: str, order: int) -> Any:
        if end == "succeed":
            goal.succeed()
        elif end == "abort":
            goal.abort()
        elif end == "canceled":
            goal.canceled()
        elif end == "raise":
            raise RuntimeError("the goal fails")
        return self._result(goal, order)

    def _publish(self, goal: Any, number: int) -> None:
        feedback = self.type.Feedback()
        if hasattr(feedback, "sequence"):
            feedback.sequence = [number]
        goal.publish_feedback(feedback)

    def _result(self, goal: Any, order: int) -> Any:
        result = self.type.Result()
        if hasattr(result, "sequence"):
            result.sequence = list(range(order))
        else:
            result.nested_field.int32_value = goal.request.nested_field.int32_value
        return result


class _Servers:
    """The child's side: the commands, run in the thread that reads them."""

    def __init__(self, node: Any, executor: Any) -> None:
        self._node = node
        self._executor = executor
        self._servers: dict[str, _Server] = {}
        self._forgers: dict[str, Any] = {}

    def serve(self, **options: Any) -> None:
        self._servers[options["name"]] = _Server(self._node, options)

    def stop(self, name: str) -> None:
        server = self._servers.pop(name)
        server.accepting.set()
        run_in(self._executor, server.server.destroy)
        server.released.set()

    def accept(self, name: str) -> None:
        self._servers[name].accepting.set()

    def release(self, name: str) -> None:
        self._servers[name].released.set()

    def asked(self, name: str) -> None:
        assert self._servers[name].asked.wait(LIMIT), "no goal has come"

    def goals(self, name: str, at_least: int) -> dict[str, int]:
        server = self._servers[name]
        with server.accepted:
            server.accepted.wait_for(lambda: len(server.goals) >= at_least, LIMIT)
        assert len(server.goals) >= at_least, f"{len(server.goals)} < {at_least}"
        return server.statuses()

    def forge(self, name: str, goal_id: str) -> None:
        if name not in self._forgers:
            feedback = self._servers[name].type.Impl.FeedbackMessage
            topic = f"{name}/_action/feedback"
            self._forgers[name] = self._node.create_publisher(feedback, topic, 10)
        for goal in (bytes.fromhex(goal_id), b""):
            self._forgers[name].publish(b"\0\1\0\0" + goal)

    def clear(self) -> None:
        while self._forgers:
            self._node.destroy_publisher(self._forgers.popitem()[1])
        for name in tuple(self._servers):
            self.release(name)
            self.stop(name)


def main() -> None:
    import rclpy
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(sys.argv[1])
    executor = MultiThreadedExecutor(8)
    executor.add_node(node)
    finished = threading.Event()

    def spin() -> None:
        while not finished.is_set():
            # An action server that is destroyed by one thread may be in another's wait set, or
            # have just accepted a goal.
            with suppress(rclpy_implementation.RCLError, rclpy_implementation.InvalidHandle):
                try:
                    executor.spin_once()
                except KeyError as error:
                    # With thousands of goals, rclpy 7.1 was once told of an expired one that it
                    # does not have.
                    if extract_tb(error.__traceback__)[-1].name != "_execute_expire_goals":
                        raise

    spinner = threading.Thread(target=spin)
    spinner.start()
    servers = _Servers(node, executor)
    serve_commands(servers)
    servers.clear()
    finished.set()
    executor.create_task(lambda: None)
    spinner.join()
    executor.shutdown()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
