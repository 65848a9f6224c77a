"""An action client in a process of its own: ``python -m benchmarks.action_client KIND``.

KIND is ``rosasync`` or ``stock``: rclpy's ``ActionClient``, with its executor in a thread. There,
each goal is sent from the callback that has the result of the one before, which spares it every
change of threads.
"""

from __future__ import annotations

import asyncio
import resource
import statistics
import sys
import threading
import time
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from benchmarks.action_server import CALL, HELD, NAME
from tests.support.child import serve_commands

__all__ = ["Ours", "Stock"]

PATIENCE = 30.0
"""Seconds for one goal."""
STALLED = 10.0
"""Seconds without any result after which the goals of rclpy's client are given up."""


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def resident() -> int:
    """Return the resident memory of this process in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


class Ours:
    """A session, whose loop runs while a message is answered."""

    def __init__(self) -> None:
        import rosasync

        self._loop = asyncio.new_event_loop()
        self._session = rosasync.Session("bench_action_client", timeout=PATIENCE)
        self._loop.run_until_complete(self._session.__aenter__())

    def goals(self, count: int, at_once: int, order: int) -> int:
        """Run goals, and return how many feedback messages came."""
        return self._loop.run_until_complete(self._goals(count, at_once, order))

    async def _goals(self, count: int, at_once: int, order: int) -> int:
        from test_msgs.action import Fibonacci

        left, received = count, 0

        def on_feedback(feedback: Any) -> None:
            nonlocal received
            received += 1

        async def worker() -> None:
            nonlocal left
            while left > 0:
                left -= 1
                await self._session.act(
                    Fibonacci,
                    NAME,
                    Fibonacci.Goal(order=order),
                    timeout=PATIENCE,
                    on_feedback=on_feedback if order else None,
                )

        async with asyncio.TaskGroup() as group:
            for _ in range(at_once):
                group.create_task(worker())
        return received

    def beside(self, goals: int, calls: int) -> float:
        """Return the time of a call beside goals that run, as a multiple of its time alone."""
        return self._loop.run_until_complete(self._beside(goals, calls))

    async def _beside(self, goals: int, calls: int) -> float:
        from std_srvs.srv import Trigger
        from test_msgs.action import Fibonacci

        async def call_seconds() -> list[float]:
            times = []
            for _ in range(calls):
                begin = time.perf_counter()
                await self._session.call(Trigger, CALL)
                times.append(time.perf_counter() - begin)
            return times

        alone = await call_seconds()
        async with AsyncExitStack() as stack:
            # Held goals end as cancelled when they are left.
            for _ in range(goals):
                goal = self._session.goal(Fibonacci, NAME, {"order": HELD}, cancel_timeout=0.0)
                await stack.enter_async_context(goal)
            beside = await call_seconds()
        return statistics.median(beside) / statistics.median(alone)

    def close(self) -> None:
        self._loop.run_until_complete(self._session.aclose())
        self._loop.close()


class Stock:
    """rclpy's ``ActionClient``."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.action import ActionClient
        from rclpy.executors import SingleThreadedExecutor
        from test_msgs.action import Fibonacci

        rclpy.init()
        self._type = Fibonacci
        self._node = rclpy.create_node("bench_action_client")
        self._client = ActionClient(self._node, Fibonacci, NAME)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()
        if not self._client.wait_for_server(PATIENCE):
            raise TimeoutError("no action server")

    def goals(self, count: int, at_once: int, order: int) -> int:
        """Run goals, and return how many feedback messages came."""
        left, out, received, results = count, 0, 0, 0
        done = threading.Event()

        def on_feedback(feedback: Any) -> None:
            nonlocal received
            received += 1

        def send() -> None:
            nonlocal left, out
            left -= 1
            out += 1
            goal = self._type.Goal(order=order)
            future = self._client.send_goal_async(
                goal, feedback_callback=on_feedback if order else None
            )
            future.add_done_callback(accepted)

        def accepted(future: Any) -> None:
            future.result().get_result_async().add_done_callback(ended)

        def ended(future: Any) -> None:
            nonlocal out, results
            out -= 1
            results += 1
            if left > 0:
                send()
            elif not out:
                done.set()

        def begin() -> None:
            for _ in range(min(at_once, count)):
                send()

        self._executor.create_task(begin)
        seen = -1
        while not done.wait(STALLED if not order else PATIENCE):
            if results == seen:
                raise TimeoutError(f"{out} goals of rclpy's client never ended")
            seen = results
        return received

    def close(self) -> None:
        import rclpy

        self._executor.shutdown()
        rclpy.shutdown()
        self._thread.join(5.0)


def main() -> None:
    client = Stock() if sys.argv[1] == "stock" else Ours()

    def goals(**wanted: int) -> dict[str, float]:
        cpu, begin = cpu_seconds(), time.perf_counter()
        received = client.goals(**wanted)
        seconds = time.perf_counter() - begin
        return {"seconds": seconds, "cpu": cpu_seconds() - cpu, "received": received}

    commands: dict[str, Any] = {"goals": goals, "memory": resident}
    if isinstance(client, Ours):
        commands["beside"] = client.beside
    serve_commands(commands)
    client.close()


if __name__ == "__main__":
    main()
