"""An action server in a process of its own: ``python -m benchmarks.action_server KIND``.

KIND is ``rosasync`` or ``stock``. A goal of order 0 ends at once. Others publish feedback: the
order is how many messages, plus `SLOWLY` for a hundred a second instead of a thousand. A goal of
the order `HELD` runs until it is cancelled, with rosasync's server, which serves `CALL` as well.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from typing import Any

from tests.support.child import serve_commands

__all__ = ["CALL", "HELD", "NAME", "RESULT_TIMEOUT", "SLOWLY"]

NAME = "/bench/action"
CALL = "/bench/action_call"
SLOWLY = 1_000_000
HELD = -1
RESULT_TIMEOUT = 10.0
"""Seconds for which a server keeps results."""


def plan(order: int) -> tuple[int, float]:
    """Return the number of feedback messages, and the seconds between two."""
    return (order - SLOWLY, 0.01) if order >= SLOWLY else (order, 0.001)


def serve_stock() -> None:
    import rclpy
    from rclpy.action import ActionServer, CancelResponse
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.executors import MultiThreadedExecutor
    from test_msgs.action import Fibonacci

    def execute(goal: Any) -> Any:
        count, pause = plan(goal.request.order)
        begin = time.monotonic()
        for number in range(count):
            goal.publish_feedback(Fibonacci.Feedback(sequence=[number]))
            time.sleep(max(0.0, begin + (number + 1) * pause - time.monotonic()))
        goal.succeed()
        return Fibonacci.Result()

    rclpy.init()
    node = rclpy.create_node("bench_action_server")
    executor = MultiThreadedExecutor(32)
    executor.add_node(node)
    server = ActionServer(
        node,
        Fibonacci,
        NAME,
        execute,
        callback_group=ReentrantCallbackGroup(),
        cancel_callback=lambda goal: CancelResponse.ACCEPT,
        result_timeout=int(RESULT_TIMEOUT),
    )
    threading.Thread(target=executor.spin, daemon=True).start()
    serve_commands({})
    rclpy.shutdown()
    del server


async def serve_ours() -> None:
    from std_srvs.srv import Trigger
    from test_msgs.action import Fibonacci

    import rosasync

    async def execute(goal: Any) -> Any:
        if goal.request.order == HELD:
            await asyncio.Event().wait()
        count, pause = plan(goal.request.order)
        begin = time.monotonic()
        for number in range(count):
            goal.feedback(Fibonacci.Feedback(sequence=[number]))
            await asyncio.sleep(max(0.0, begin + (number + 1) * pause - time.monotonic()))
        return Fibonacci.Result()

    async with rosasync.Session("bench_action_server") as session:
        session.serve_action(
            Fibonacci, NAME, execute, concurrency=2000, result_timeout=RESULT_TIMEOUT
        )
        session.serve(Trigger, CALL, lambda request, response: response)
        await asyncio.to_thread(serve_commands, {})


if __name__ == "__main__":
    if sys.argv[1] == "stock":
        serve_stock()
    else:
        asyncio.run(serve_ours())
