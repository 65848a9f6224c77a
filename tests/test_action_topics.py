"""Feedback and statuses: they reach the goals that they are for, and no others."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from typing import Any

import pytest
from action_msgs.msg import GoalStatus as Status
from action_msgs.msg import GoalStatusArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from test_msgs.action import Fibonacci

from rosasync import GoalStatus, Session
from rosasync._actions import active_goals, registry
from tests.support.action_servers import ActionServerProcess
from tests.support.nodes import borrowed_node
from tests.support.times import LIMIT, TICK, until

Impl = Fibonacci.Impl
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


async def test_a_slow_reader_delays_no_other_goal(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, feedback=20, readers=1)
    reading, go_on = asyncio.Event(), asyncio.Event()

    async def read_slowly(feedback: Fibonacci.Feedback) -> None:
        reading.set()
        await go_on.wait()

    slow = asyncio.create_task(session.act(Fibonacci, "/held", on_feedback=read_slowly))
    await reading.wait()
    async with session.goal(Fibonacci, "/held", {"order": 2}, feedback=20) as goal:
        assert [(await anext(goal)).sequence[0] for _ in range(20)] == list(range(20))
        await action_server.release("/held")
        assert list((await goal.result(LIMIT)).sequence) == [0, 1]
    assert not slow.done()
    go_on.set()
    await slow


async def test_what_never_reaches_a_slow_function_is_logged(
    session: Session,
    action_server: ActionServerProcess,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(registry, "ACT_FEEDBACK", 4)
    await action_server.serve("/fast", feedback=20, readers=1)
    received: list[int] = []

    async def receive_slowly(feedback: Fibonacci.Feedback) -> None:
        received.append(feedback.sequence[0])
        # Until the goal has ended, so that all other feedback has come.
        await until(lambda: session.core.actions.out == 0)

    await session.act(Fibonacci, "/fast", on_feedback=receive_slowly)
    dropped = 20 - len(received)
    assert received[-4:] == [16, 17, 18, 19]
    assert f"/fast: {dropped} feedback messages of goal" in caplog.text


async def test_an_action_has_one_subscription_to_each_topic_while_goals_are_out(
    session: Session, action_server: ActionServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(active_goals, "LINGER", TICK)
    await action_server.serve("/held", hold=True, idle=True)

    def subscriptions() -> list[int]:
        topics = ("feedback", "status")
        return [session.node.count_subscribers(f"/held/_action/{topic}") for topic in topics]

    tasks = [asyncio.create_task(session.act(Fibonacci, "/held")) for _ in range(10)]
    await action_server.goals("/held", at_least=10)
    await until(lambda: subscriptions() == [1, 1])
    for task in tasks[1:]:
        task.cancel()
    await until(lambda: session.core.actions.out == 1)
    assert subscriptions() == [1, 1]
    await action_server.release("/held")
    await tasks[0]
    await until(lambda: subscriptions() == [0, 0])


async def test_what_is_for_others_is_not_deserialized(
    session: Session, action_server: ActionServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, read = session.core.node, list[int]()
    deserialize = node.deserialize

    def count(message_type: Any, serialized: bytes) -> Any:
        message = deserialize(message_type, serialized)
        read.append(message.sequence[0])
        return message

    monkeypatch.setattr(node, "deserialize", count)
    await action_server.serve("/held", hold=True, feedback=20, readers=2)
    async with Session("other", timeout=2 * LIMIT) as other, AsyncExitStack() as stack:
        # Each is sent the feedback of both.
        blocks = [each.goal(Fibonacci, "/held", feedback=20) for each in (session, other)]
        goal, same = await asyncio.gather(*map(stack.enter_async_context, blocks))
        for each in (goal, same):
            assert [(await anext(each)).sequence[0] for _ in range(20)] == list(range(20))
            assert each.feedback_dropped == 0
        await until(lambda: goal.status is same.status is GoalStatus.EXECUTING)
        assert read == list(range(20))
        await action_server.release("/held")


@pytest.mark.parametrize("forged", [b"", b"\xff" * 4, b"\1\0\0\0" + b"\xff" * 24])
async def test_a_forged_status_is_dropped(
    session: Session,
    action_server: ActionServerProcess,
    caplog: pytest.LogCaptureFixture,
    forged: bytes,
) -> None:
    await action_server.serve("/held", hold=True)
    with borrowed_node() as node:
        publisher = node.create_publisher(GoalStatusArray, "/held/_action/status", LATCHED)
        async with session.goal(Fibonacci, "/held", {"order": 2}) as goal:
            async with asyncio.timeout(LIMIT):
                # A subscription may know its publisher much later than the reverse.
                while "a status message is dropped" not in caplog.text:
                    publisher.publish(b"\0\1\0\0" + forged)
                    await asyncio.sleep(TICK)
            await action_server.release("/held")
            assert list((await goal.result(LIMIT)).sequence) == [0, 1]
    assert goal.status is GoalStatus.SUCCEEDED


async def test_feedback_and_status_before_the_acceptance_are_kept(session: Session) -> None:
    """Of a server that is slow to answer. A client learns nothing of the goal before."""
    ended = threading.Event()
    with borrowed_node() as node, spun(node, ended):
        serve_hastily(node, "/hasty", ended)
        async with asyncio.timeout(LIMIT):
            async with session.goal(Fibonacci, "/hasty", {"order": 7}) as goal:
                assert list((await anext(goal)).sequence) == [7]
                await until(lambda: goal.status is GoalStatus.EXECUTING)
                goal.detach()


@contextmanager
def spun(node: Any, ended: threading.Event) -> Iterator[None]:
    """Spin a node in a thread, as a stock program does, and set the event at the end."""
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        executor.shutdown()
        thread.join()


def serve_hastily(node: Any, name: str, ended: threading.Event) -> None:
    """Serve an action that says everything of a goal before it accepts it, and gives no result."""
    topic = f"{name}/_action"
    feedback = node.create_publisher(Impl.FeedbackMessage, f"{topic}/feedback", 10)
    statuses = node.create_publisher(GoalStatusArray, f"{topic}/status", LATCHED)

    def hold(request: Any, response: Any) -> Any:
        ended.wait(LIMIT)
        return response

    def accept(request: Any, response: Any) -> Any:
        while not feedback.get_subscription_count():
            time.sleep(TICK / 10)
        message = Impl.FeedbackMessage(goal_id=request.goal_id)
        message.feedback.sequence = [request.goal.order]
        feedback.publish(message)
        time.sleep(TICK)
        status = Status(status=GoalStatus.EXECUTING)
        status.goal_info.goal_id = request.goal_id
        statuses.publish(GoalStatusArray(status_list=[status]))
        time.sleep(TICK)
        response.accepted = True
        return response

    node.create_service(Impl.GetResultService, f"{topic}/get_result", hold)
    node.create_service(Impl.CancelGoalService, f"{topic}/cancel_goal", hold)
    node.create_service(Impl.SendGoalService, f"{topic}/send_goal", accept)
