"""Goals of stock action servers in another process, on both bridges."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal
from uuid import uuid4

import pytest
from std_srvs.srv import Trigger
from test_msgs.action import Fibonacci, NestedMessage

from rosasync import (
    CancelRejected,
    ContextShutdown,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync._actions import registry, server_watch
from rosasync._client import graph_watch
from rosasync.testing import VirtualClock
from tests.support.action_servers import ActionServerProcess, none_runs
from tests.support.nodes import borrowed_node
from tests.support.times import LIMIT, TICK, count_timers, until

if TYPE_CHECKING:
    from tests.conftest import Bridge


@pytest.fixture(autouse=True)
def match_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for the topics, on a busy machine: the feedback before their match is lost."""
    monkeypatch.setattr(server_watch, "MATCH_TIMEOUT", LIMIT)


async def test_a_goal_gives_its_result(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/fibonacci")
    result = await session.act(Fibonacci, "/fibonacci", {"order": 5})
    assert list(result.sequence) == [0, 1, 2, 3, 4]
    result = await session.act("test_msgs/action/Fibonacci", "fibonacci", Fibonacci.Goal(order=2))
    assert list(result.sequence) == [0, 1]


async def test_nested_messages(session: Session, action_server: ActionServerProcess) -> None:
    await action_server.serve("/nested", "test_msgs/action/NestedMessage", feedback=2)
    received: list[NestedMessage.Feedback] = []
    goal = {"nested_field": {"int32_value": 7}}
    result = await session.act(NestedMessage, "/nested", goal, on_feedback=received.append)
    assert result.nested_field.int32_value == 7
    assert [type(message) for message in received] == [NestedMessage.Feedback] * 2


async def test_feedback_and_status(session: Session, action_server: ActionServerProcess) -> None:
    await action_server.serve("/held", hold=True, feedback=5)
    async with session.goal(Fibonacci, "/held", {"order": 3}) as goal:
        assert goal.accepted_at is not None
        assert not goal.done
        first = [(await anext(goal)).sequence[0] for _ in range(5)]
        assert first == [0, 1, 2, 3, 4]
        await until(lambda: goal.status is GoalStatus.EXECUTING)
        await action_server.release("/held")
        assert [feedback async for feedback in goal] == []
        assert goal.done
        assert goal.status is GoalStatus.SUCCEEDED
        results = await asyncio.gather(*(goal.result() for _ in range(3)))
        assert [list(result.sequence) for result in results] == [[0, 1, 2]] * 3
        assert goal.feedback_dropped == 0
    assert list((await goal.result()).sequence) == [0, 1, 2]


async def test_a_slow_reader_loses_the_oldest_feedback(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, feedback=20)
    async with session.goal(Fibonacci, "/held", feedback=4) as goal:
        await until(lambda: goal.feedback_dropped == 16)
        await action_server.release("/held")
        assert [f.sequence[0] async for f in goal] == [16, 17, 18, 19]


@pytest.mark.parametrize("end", ["abort", "raise", "return"])
async def test_an_aborted_goal_raises_with_its_result(
    session: Session, action_server: ActionServerProcess, end: str
) -> None:
    await action_server.serve("/aborts", end=end)
    with pytest.raises(GoalAborted, match="/aborts: the server aborted the goal") as caught:
        await session.act(Fibonacci, "/aborts", {"order": 3})
    error = caught.value
    assert (error.srv_name, error.srv_type) == ("/aborts", "test_msgs/action/Fibonacci")
    assert list(error.result.sequence) == ([] if end == "raise" else [0, 1, 2])


async def test_a_rejected_goal(session: Session, action_server: ActionServerProcess) -> None:
    await action_server.serve("/rejects", accept=False)
    with pytest.raises(GoalRejected, match="the server rejected the goal") as caught:
        await session.act(Fibonacci, "/rejects")
    assert caught.value.goal_id.version == 4


async def test_cancel_returns_when_the_server_has_agreed(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        await goal.cancel()
        assert goal.status in (GoalStatus.CANCELING, GoalStatus.CANCELED)
        with pytest.raises(GoalCanceled) as caught:
            await goal.result()
        assert list(caught.value.result.sequence) == [0]
        await goal.cancel()
    assert await action_server.goals("/held") == {goal.id: GoalStatus.CANCELED}


@pytest.mark.parametrize("end", ["succeed", "abort"])
async def test_a_goal_that_is_being_cancelled_may_end_otherwise(
    session: Session, action_server: ActionServerProcess, end: Literal["succeed", "abort"]
) -> None:
    await action_server.serve("/held", hold=True, canceled=end)
    async with session.goal(Fibonacci, "/held") as goal:
        await goal.cancel()
        if end == "succeed":
            assert list((await goal.result()).sequence) == [0]
        else:
            with pytest.raises(GoalAborted):
                await goal.result()
        assert goal.status is (GoalStatus.SUCCEEDED if end == "succeed" else GoalStatus.ABORTED)
    assert await action_server.goals("/held") == {goal.id: goal.status}


async def test_a_cancellation_that_is_not_answered_in_time(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held", cancel_timeout=LIMIT) as goal:
        with pytest.raises(GoalTimeout, match="the cancellation was not answered within"):
            await goal.cancel(timeout=0)
        assert await action_server.running("/held", at_least=1) == [goal.id]
        await goal.cancel(timeout=LIMIT)


async def test_an_error_of_on_feedback_passes_on_and_cancels_the_goal(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, feedback=5, readers=1)

    async def fails(feedback: Fibonacci.Feedback) -> None:
        raise ZeroDivisionError(feedback.sequence[0])

    with pytest.raises(ZeroDivisionError, match="^0$"):
        await session.act(Fibonacci, "/held", on_feedback=fails)
    await none_runs(action_server, "/held")


async def test_a_server_that_keeps_no_results(
    session: Session, action_server: ActionServerProcess
) -> None:
    """The result is asked for before its end, so it arrives nevertheless."""
    await action_server.serve("/forgetful", hold=True, result_timeout=0)
    async with session.goal(Fibonacci, "/forgetful", {"order": 2}) as goal:
        await action_server.release("/forgetful")
        assert list((await goal.result()).sequence) == [0, 1]
    async with asyncio.timeout(LIMIT):
        while True:
            async with session.attach(Fibonacci, "/forgetful", goal.id) as late:
                with suppress(GoalRejected):
                    await late.result()
                    continue
            break


async def test_a_server_that_refuses_to_cancel(
    session: Session, action_server: ActionServerProcess, caplog: pytest.LogCaptureFixture
) -> None:
    await action_server.serve("/stubborn", hold=True, cancel=False)
    async with session.goal(Fibonacci, "/stubborn", cancel_timeout=LIMIT) as goal:
        with pytest.raises(CancelRejected, match="refuses to cancel"):
            await goal.cancel()
        assert not goal.done
    assert "refuses to cancel goal" in caplog.text
    await action_server.release("/stubborn")


async def test_leaving_the_block_cancels_the_goal_and_waits_for_its_end(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held", cancel_timeout=LIMIT) as goal:
        pass
    assert goal.status is GoalStatus.CANCELED
    with pytest.raises(ZeroDivisionError):
        async with session.goal(Fibonacci, "/held", cancel_timeout=LIMIT) as goal:
            raise ZeroDivisionError
    assert goal.status is GoalStatus.CANCELED


async def test_a_cancelled_caller_does_not_wait_and_the_goal_is_cancelled(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    task = asyncio.create_task(session.act(Fibonacci, "/held"))
    await action_server.goals("/held", at_least=1)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await none_runs(action_server, "/held")


async def test_a_goal_that_is_left_before_its_acceptance_is_cancelled_after_it(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/slow", hold=True, accept_later=True)
    task = asyncio.create_task(session.act(Fibonacci, "/slow"))
    await action_server.asked("/slow")
    task.cancel()
    with pytest.raises(GoalTimeout, match="was sent, but not answered within"):
        async with session.goal(Fibonacci, "/slow", accept_timeout=20 * TICK):
            raise AssertionError("the server has not answered")
    await action_server.accept("/slow")
    await action_server.goals("/slow", at_least=2)
    await none_runs(action_server, "/slow")


async def test_a_timeout_cancels_the_goal(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held"):
        pass
    with pytest.raises(GoalTimeout, match="within 1 s; it is cancelled") as caught:
        await session.act(Fibonacci, "/held", timeout=1.0, accept_timeout=LIMIT)
    assert isinstance(caught.value, TimeoutError)
    await action_server.goals("/held", at_least=2)
    await none_runs(action_server, "/held")


async def test_a_result_may_be_awaited_with_a_timeout_and_the_goal_runs_on(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        with pytest.raises(GoalTimeout, match="has not ended within 0.05 s"):
            await goal.result(timeout=TICK)
        assert await action_server.running("/held", at_least=1) == [goal.id]
        await action_server.release("/held")
        await goal.result(timeout=LIMIT)


async def test_the_end_of_the_session_cancels_what_is_not_detached(
    action_server: ActionServerProcess, bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(registry, "CLOSE_TIMEOUT", LIMIT)
    await action_server.serve("/held", hold=True)
    session = Session("closes", bridge=bridge, timeout=LIMIT)
    await session.open() if hasattr(session, "open") else await session.__aenter__()
    tasks = [asyncio.create_task(session.act(Fibonacci, "/held")) for _ in range(5)]
    async with session.goal(Fibonacci, "/held") as goal:
        goal.detach()
    await action_server.goals("/held", at_least=6)
    await session.aclose()
    assert await action_server.running("/held") == [goal.id]
    for task in tasks:
        with pytest.raises(SessionClosed):
            await task
    await action_server.release("/held")


async def test_a_goal_can_be_followed_by_another_session(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with Session("other", timeout=LIMIT) as other:
        async with session.goal(Fibonacci, "/held", {"order": 4}) as goal:
            async with other.attach(Fibonacci, "/held", goal.id) as left_early:
                pass
            async with (
                other.attach(Fibonacci, "/held", goal.id) as attached,
                session.attach(Fibonacci, "/held", goal.id) as same,
            ):
                await until(lambda: attached.status is GoalStatus.EXECUTING)
                assert attached.id == goal.id
                assert await action_server.running("/held") == [goal.id]
                await action_server.release("/held")
                for handle in (attached, same, goal):
                    assert list((await handle.result()).sequence) == [0, 1, 2, 3]
        assert not left_early.done
        async with other.attach(Fibonacci, "/held", uuid4()) as unknown:
            with pytest.raises(GoalRejected, match="does not know the goal"):
                await unknown.result()


@pytest.mark.parametrize("why", ["detached", "attached", "refused"])
async def test_a_goal_that_runs_on_after_its_block_is_not_waited_for(
    session: Session, action_server: ActionServerProcess, why: str
) -> None:
    """Neither after the block, nor by tasks that waited in it; it may still be cancelled."""
    await action_server.serve("/held", hold=True, cancel=why != "refused")
    tasks: list[asyncio.Task[Any]] = []

    async def read() -> list[Any]:
        return [feedback async for feedback in goal]

    async with session.goal(Fibonacci, "/held", cancel_timeout=LIMIT) as goal:
        if why != "refused":
            goal.detach()
        if why != "attached":
            tasks += map(asyncio.create_task, (goal.result(), read()))
            await asyncio.sleep(0)
    if why == "attached":
        async with session.attach(Fibonacci, "/held", goal.id) as goal:
            tasks += map(asyncio.create_task, (goal.result(), read()))
            await asyncio.sleep(0)
    async with asyncio.timeout(LIMIT):
        for waited in (tasks[0], goal.result(), goal.result(timeout=LIMIT)):
            with pytest.raises(UsageError, match=r"not followed any more.*session.attach\("):
                await waited
        assert await tasks[1] == await read() == []
    assert not goal.done
    assert await action_server.running("/held", at_least=1) == [goal.id]
    if why == "refused":
        with pytest.raises(CancelRejected):
            await goal.cancel()
        await action_server.release("/held")
    else:
        await goal.cancel()
        await none_runs(action_server, "/held")


async def test_detaching_after_the_block_is_too_late(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, cancel=False)
    async with session.goal(Fibonacci, "/held", cancel_timeout=0.0) as goal:
        pass
    with pytest.raises(UsageError, match="is being cancelled already: call detach"):
        goal.detach()
    await action_server.release("/held")


async def test_an_ended_goal_still_has_its_result(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/fibonacci")
    async with session.goal(Fibonacci, "/fibonacci", {"order": 2}) as goal:
        await goal.result()
    async with session.attach(Fibonacci, "/fibonacci", goal.id) as attached:
        assert list((await attached.result()).sequence) == [0, 1]


async def test_attaching_to_a_server_that_vanishes_before_it_is_matched(session: Session) -> None:
    """It has no feedback topic, so that its services are there and it is not matched yet."""
    services = {
        "/half/_action/send_goal": Fibonacci.Impl.SendGoalService,
        "/half/_action/cancel_goal": Fibonacci.Impl.CancelGoalService,
        "/half/_action/get_result": Fibonacci.Impl.GetResultService,
    }
    attached = session.attach(Fibonacci, "/half", uuid4(), accept_timeout=40 * TICK)
    with borrowed_node() as node:
        for name, service in services.items():
            node.create_service(service, name, print)
        await until(lambda: all(session.service_is_ready(s, n) for n, s in services.items()))
        task = asyncio.create_task(attached.__aenter__())
        await until(lambda: session.core.actions.out)
    with pytest.raises(ServiceUnavailable):
        await task


async def test_there_is_no_server(session: Session) -> None:
    with pytest.raises(ServiceUnavailable, match="/nothing: no action server for") as caught:
        await session.act(Fibonacci, "/nothing", accept_timeout=4 * TICK)
    assert caught.value.srv_name == "/nothing"
    with pytest.raises(ServiceUnavailable):
        await session.act(Fibonacci, "/nothing", wait=False)
    with pytest.raises(ServiceUnavailable):
        await session.act(Fibonacci, "/nothing", wait=2 * TICK)
    with pytest.raises(ServiceUnavailable, match="/nothing: no action server for"):
        await session.act(Fibonacci, "/nothing", timeout=4 * TICK)


async def test_a_similar_name_is_that_of_an_action(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/fibonacci")
    # Each service is discovered apart from the others.
    parts = [f"/fibonacci/_action/{part}" for part in ("send_goal", "cancel_goal")]
    await until(lambda: all(map(session.node.count_services, parts)))
    similar = r"there are /fibonacci \(test_msgs/action/Fibonacci\)$"
    with pytest.raises(ServiceUnavailable, match=similar):
        await session.act(Fibonacci, "/fibonaci", wait=False)
    with pytest.raises(ServiceUnavailable) as caught:
        await session.call(Trigger, "/fibonacci/_action/cancel", wait=False)
    assert "there are /fibonacci/_action/cancel_goal" in str(caught.value)


async def test_the_server_vanishes(session: Session, action_server: ActionServerProcess) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        await until(lambda: goal.status is GoalStatus.EXECUTING)
        await action_server.stop("/held")
        with pytest.raises(ServerGone, match="every server vanished before the goal ended"):
            await goal.result()


def shut_down_silently(context: Any) -> None:
    """Shut a context down as rclpy's signal handler does: nothing reports it."""
    context._call_on_shutdown_callbacks = lambda: None
    context.shutdown()


def shut_down(context: Any) -> None:
    context.shutdown()


@pytest.mark.parametrize("end", [shut_down, shut_down_silently])
async def test_the_context_is_shut_down(
    session: Session, action_server: ActionServerProcess, end: Callable[[Any], None]
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        await asyncio.to_thread(end, session.node.context)
        with pytest.raises(ContextShutdown):
            await goal.result()


async def test_the_context_of_a_borrowed_node_is_shut_down(
    bridge: Bridge, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    with borrowed_node() as node:
        async with (
            Session(node, bridge=bridge, timeout=LIMIT) as session,
            session.goal(Fibonacci, "/held") as goal,
        ):
            await asyncio.to_thread(shut_down_silently, node.context)
            with pytest.raises(ContextShutdown):
                await goal.result()


async def test_a_goal_that_runs_for_an_hour(
    session: Session,
    action_server: ActionServerProcess,
    virtual_clock: VirtualClock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Between the requests for its result it wakes nothing, except the poll of the context."""
    monkeypatch.setattr(graph_watch, "POLL_CONTEXT", 1e6)
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held", {"order": 3}) as goal:
        await virtual_clock.advance(0.0)
        timers = count_timers(monkeypatch)
        await virtual_clock.advance(3600.0)
        assert len(timers) < 60
        await action_server.release("/held")
        result = await goal.result()
        assert list(result.sequence) == [0, 1, 2]


async def test_forty_goals_at_once(session: Session, action_server: ActionServerProcess) -> None:
    await action_server.serve("/fibonacci", feedback=3)
    received: list[int] = []

    async def one(order: int) -> int:
        count = 0

        def on_feedback(feedback: Fibonacci.Feedback) -> None:
            nonlocal count
            count += 1

        goal = {"order": order}
        result = await session.act(Fibonacci, "/fibonacci", goal, on_feedback=on_feedback)
        received.append(count)
        return len(result.sequence)

    assert await asyncio.gather(*map(one, range(40))) == list(range(40))
    assert received == [3] * 40


async def test_wrong_arguments_raise_before_anything_is_sent(session: Session) -> None:
    with pytest.raises(TypeError, match="expected test_msgs/action/Fibonacci_Goal"):
        await session.act(Fibonacci, "/fibonacci", Fibonacci.Result())
    with pytest.raises(TypeError, match="on_feedback must be callable, not int"):
        await session.act(Fibonacci, "/fibonacci", on_feedback=3)  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="ordr"):
        session.goal(Fibonacci, "/fibonacci", {"ordr": 1})
    with pytest.raises(ValueError, match="feedback must be at least 1"):
        session.goal(Fibonacci, "/fibonacci", feedback=0)
    with pytest.raises(TypeError, match="goal_id must be a uuid.UUID"):
        session.attach(Fibonacci, "/fibonacci", "7")  # type: ignore[call-overload]
