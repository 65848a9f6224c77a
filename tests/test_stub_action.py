"""What a user tests with action stubs of `rosasync.testing`: one suite, in memory and real."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest
from test_msgs.action import Fibonacci

from rosasync import (
    CancelRejected,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    ServerGone,
    ServiceUnavailable,
    Session,
    UsageError,
)
from rosasync.testing import Graph, VirtualClock
from tests.support.times import LIMIT, TICK, until

pytestmark = pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True)

DRIVE = "/suite/drive"
S = GoalStatus


@pytest.fixture
async def session(ros_graph: Graph) -> AsyncIterator[Session]:
    async with ros_graph.session(timeout=2 * LIMIT) as session:
        yield session


async def drive(session: Session, order: int = 3, **options: Any) -> list[int]:
    """The code under test."""
    result = await session.act(Fibonacci, DRIVE, {"order": order}, **options)
    return list(result.sequence)


def sequence(*numbers: int) -> dict[str, Any]:
    return {"sequence": list(numbers)}


async def test_a_result_with_feedback(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(
        Fibonacci, DRIVE, sequence(1, 2), feedback=[sequence(1), Fibonacci.Feedback(sequence=[2])]
    )
    assert repr(stub) == f"<StubActionServer {DRIVE} up, 0 goals>"
    async with session.goal(Fibonacci, DRIVE, {"order": 5}) as goal:
        feedback = [list(message.sequence) async for message in goal]
        assert feedback == [[1], [2]]
        assert list((await goal.result()).sequence) == [1, 2]
    assert await drive(session, 6) == [1, 2]
    stub.assert_goals({"order": 5}, {"order": 6})
    stub.assert_statuses(S.SUCCEEDED, S.SUCCEEDED)
    assert stub.goals[0].id == goal.id
    assert stub.requests == [{"order": 5}, {"order": 6}]
    with pytest.raises(AssertionError, match="expected 1 goal, but it received 2 goals"):
        stub.assert_goals({"order": 5})
    with pytest.raises(AssertionError, match=r"expected ABORTED, but[^$]*SUCCEEDED, SUCCEEDED"):
        stub.assert_statuses(S.ABORTED)
    with pytest.raises(ValueError, match="no field 'ordre'"):
        stub.assert_goals({"ordre": 5})


async def test_answers_in_turn_and_by_goal(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(Fibonacci, DRIVE)
    stub.answer(GoalRejected, match={"order": 9})
    stub.answer(
        GoalAborted("blocked", result=sequence(7)), OSError("no power"), sequence(1), match=None
    )
    with pytest.raises(GoalRejected):
        await drive(session, 9)
    with pytest.raises(GoalAborted) as caught:
        await drive(session)
    assert list(caught.value.result.sequence) == [7]
    with pytest.raises(GoalAborted) as caught:
        await drive(session)
    assert list(caught.value.result.sequence) == []
    assert await drive(session) == [1]
    stub.assert_statuses(S.UNKNOWN, S.ABORTED, S.ABORTED, S.SUCCEEDED)
    assert ros_graph.unexpected == []
    with pytest.raises(GoalRejected):
        await drive(session, 4)
    assert ros_graph.unexpected == [f"{DRIVE} has no answer left for {{'order': 4}}"]
    with pytest.raises(AssertionError, match="has no answer left"):
        ros_graph.check()
    ros_graph.strict = False


async def test_a_goal_that_runs_until_it_is_cancelled(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(Fibonacci, DRIVE, None)
    async with session.goal(Fibonacci, DRIVE) as goal:
        await stub.wait_for_goals()
        await until(lambda: stub.goals[0].status is S.EXECUTING)
        with stub.refuse_cancellations(), pytest.raises(CancelRejected):
            await goal.cancel()
        stub.assert_statuses(S.EXECUTING)
        await goal.cancel()
        with pytest.raises(GoalCanceled):
            await goal.result()
    stub.assert_statuses(S.CANCELED)


async def test_a_goal_that_is_left_is_cancelled(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(Fibonacci, DRIVE, None)
    task = asyncio.create_task(drive(session))
    await stub.wait_for_goals()
    task.cancel()
    await until(lambda: stub.goals[0].status is S.CANCELED)
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_virtual_time(
    ros_graph: Graph, session: Session, virtual_clock: VirtualClock
) -> None:
    ros_graph.stub_action(
        Fibonacci, DRIVE, sequence(1), feedback=[sequence(1), sequence(2)], delay=100.0
    )
    # On real ROS, each tick of a goal's client costs a pause of the virtual clock.
    timeout = 2.0
    if ros_graph.kind == "memory":
        timeout = 250.0
        began = virtual_clock.time()
        assert await virtual_clock.skip(drive(session)) == [1]
        # The clock goes on by itself, by seconds on a busy machine.
        assert 300.0 <= virtual_clock.time() - began < 350.0
    async with session.goal(Fibonacci, DRIVE, {"order": 3}) as goal:
        with pytest.raises(GoalTimeout):
            await virtual_clock.skip(goal.result(timeout=timeout))
    await until(lambda: ros_graph.action_servers[0].goals[-1].status is S.CANCELED)


async def test_a_server_that_vanishes_with_goals_out(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(Fibonacci, DRIVE, None)
    task = asyncio.create_task(drive(session))
    await stub.wait_for_goals()
    await until(lambda: stub.goals[0].status is S.EXECUTING)
    await stub.vanish()
    await stub.vanish()
    assert repr(stub) == f"<StubActionServer {DRIVE} vanished, 1 goal>"
    with pytest.raises(ServerGone):
        await task
    with pytest.raises(ServiceUnavailable):
        await drive(session, wait=False)
    assert ros_graph.unexpected == []
    await stub.come_back()
    await stub.come_back()
    task = asyncio.create_task(drive(session))
    await stub.wait_for_goals(2)
    task.cancel()
    await until(lambda: stub.goals[1].status is S.CANCELED)


async def test_faults_hold_in_their_block(ros_graph: Graph, session: Session) -> None:
    stub = ros_graph.stub_action(Fibonacci, DRIVE)
    stub.answer(None, match={"order": 9}).answer(sequence(1))
    unanswered = "the cancellation was not answered within"
    async with session.goal(Fibonacci, DRIVE, {"order": 9}) as goal:
        with stub.drop_requests():
            with pytest.raises(GoalTimeout, match=unanswered):
                await goal.cancel(timeout=2 * TICK)
            await until(lambda: stub.lost_requests)
        stub.assert_statuses(S.EXECUTING)
        with stub.delay_responses(8 * TICK), pytest.raises(GoalTimeout, match=unanswered):
            await goal.cancel(timeout=2 * TICK)
        await until(lambda: stub.goals[0].status is S.CANCELED)
    with stub.drop_results():
        async with session.goal(Fibonacci, DRIVE, {"order": 4}) as goal:
            await until(lambda: stub.goals[-1].status is S.SUCCEEDED)
            with pytest.raises(GoalTimeout, match="has not ended within"):
                await goal.result(timeout=4 * TICK)
    assert await drive(session, 5) == [1]
    stub.assert_goals({"order": 9}, {"order": 4}, {"order": 5})


async def test_an_acceptance_that_is_lost(ros_graph: Graph, session: Session) -> None:
    """The status topic shows it, and the goal goes on without it."""
    stub = ros_graph.stub_action(Fibonacci, DRIVE, sequence(1))
    assert await drive(session, 1) == [1]
    with stub.drop_responses():
        assert await drive(session, 2) == [1]
    stub.assert_statuses(S.SUCCEEDED, S.SUCCEEDED)


async def test_a_handler(ros_graph: Graph, session: Session) -> None:
    async def handler(goal: Any) -> Any:
        goal.feedback(sequence(goal.request.order))
        return sequence(goal.request.order)

    drives = ros_graph.serve_action(
        Fibonacci,
        DRIVE,
        handler,
        on_goal=lambda request: request.order < 5,
        on_cancel=lambda goal: True,
    )
    assert await drive(session, 2) == [2]
    with pytest.raises(GoalRejected):
        await drive(session, 7)
    drives.assert_statuses(S.SUCCEEDED, S.UNKNOWN)


async def test_a_strict_graph(ros_graph: Graph, session: Session) -> None:
    ros_graph.stub_action(Fibonacci, "/optional", None, optional=True)
    ros_graph.stub_action(Fibonacci, DRIVE, None)
    with pytest.raises(ServiceUnavailable):
        await session.act(Fibonacci, "/other", wait=False)
    with pytest.raises(AssertionError) as caught:
        ros_graph.check()
    assert str(caught.value).splitlines()[1:] == [
        "/other (test_msgs/action/Fibonacci) was called, and has no server",
        f"{DRIVE} never got a goal",
    ]
    ros_graph.strict = False


async def test_bad_arguments(ros_graph: Graph) -> None:
    with pytest.raises(ValueError, match="sequenze"):
        ros_graph.stub_action(Fibonacci, DRIVE, {"sequenze": []}, optional=True)
    stub = ros_graph.action_servers[0]
    with pytest.raises(TypeError):
        stub.answer(3)
    with pytest.raises(TypeError):
        stub.answer(sequence(), feedback=[Fibonacci.Result()])
    with pytest.raises(ValueError, match="delay"):
        stub.answer(sequence(), delay=-1)
    with pytest.raises(ValueError, match="at least one answer"):
        stub.answer()
    with pytest.raises(ValueError, match="no field"):
        stub.answer(sequence(), match={"ordre": 2})
    with pytest.raises(ValueError, match="sequenze"):
        stub.answer(GoalAborted("x", result={"sequenze": []}))
    for single in (sequence(1), Fibonacci.Feedback()):
        with pytest.raises(TypeError, match="feedback must be a list of messages or mappings"):
            stub.answer(sequence(), feedback=single)
    wrong: Any = 3
    with pytest.raises(TypeError, match="match must be a mapping of fields, a function or None"):
        stub.answer(sequence(), match=wrong)
    with pytest.raises(TypeError, match="not list: give each as an argument of its own"):
        stub.assert_goals([{"order": 1}])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="seconds must be a number of seconds, not str"):
        stub.delay_responses("1")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="number must be a whole number, not str"):
        await stub.wait_for_goals("1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least one answer"):
        ros_graph.stub_action(Fibonacci, "/feedback", feedback=[sequence(1)], optional=True)
    with pytest.raises(TypeError, match="on_cancel must be callable"):
        ros_graph.stub_action(Fibonacci, "/on_cancel", None, on_cancel=wrong, optional=True)

    async def handler(goal: Any) -> Any: ...

    drives = ros_graph.serve_action(Fibonacci, "/handler", handler, optional=True)
    with pytest.raises(UsageError, match="/handler: its handler answers: use stub_action"):
        drives.answer(sequence())
