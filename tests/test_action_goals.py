"""What decides about a goal that is out: its status, when to ask for its result, when to let go."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import AsyncIterator

import pytest
from test_msgs.action import Fibonacci

from rosasync import GoalStatus, ServerGone, ServiceUnavailable, Session
from rosasync._actions.active_goal import ActiveGoal
from rosasync._actions.active_goals import LINGER, TICK, ActiveGoals
from rosasync._actions.cancellation import END_TIMEOUT, CancelAnswer, Step, next_step
from rosasync._actions.result_plan import (
    ENDED_ASK,
    ENDED_PATIENCE,
    FIRST_ASK,
    LAST_ASK,
    Due,
    ResultPlan,
)
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction
from tests.support.times import until

UNKNOWN, ACCEPTED, EXECUTING, CANCELING, SUCCEEDED, CANCELED, ABORTED = GoalStatus


@pytest.mark.parametrize(
    ("known", "told", "then"),
    [
        (UNKNOWN, ACCEPTED, ACCEPTED),
        (UNKNOWN, CANCELED, CANCELED),
        (ACCEPTED, EXECUTING, EXECUTING),
        (EXECUTING, CANCELING, CANCELING),
        (CANCELING, SUCCEEDED, SUCCEEDED),
        # A message that was overtaken by a later one.
        (EXECUTING, ACCEPTED, EXECUTING),
        (CANCELING, EXECUTING, CANCELING),
        (SUCCEEDED, EXECUTING, SUCCEEDED),
        # Another server of the name.
        (SUCCEEDED, ABORTED, SUCCEEDED),
        (CANCELED, ABORTED, CANCELED),
    ],
)
def test_a_status_only_goes_on(known: GoalStatus, told: GoalStatus, then: GoalStatus) -> None:
    goal = ActiveGoal(uuid.uuid4(), 0.0)
    goal.update(known)
    goal.update(told)
    assert goal.status is then


def asked_at(plan: ResultPlan, until: float) -> list[float]:
    """Return the times at which a plan asks, if it is looked at every tenth of a second."""
    times = []
    for tenth in range(round(10 * until)):
        now = tenth / 10
        if plan.due(now) is Due.ASK:
            plan.asked(now)
            times.append(now)
    return times


def test_a_running_goal_is_asked_for_ever_more_rarely() -> None:
    plan = ResultPlan()
    assert plan.due(1e9) is Due.NOTHING
    plan.asked(0.0)
    assert asked_at(plan, 40.0) == [FIRST_ASK, 3 * FIRST_ASK, 7 * FIRST_ASK]
    for now in (1e3, 2e3, 3e3, 4e3, 5e3):
        plan.asked(now)
    assert plan.due(5e3 + LAST_ASK - 1) is Due.NOTHING
    assert plan.due(5e3 + LAST_ASK) is Due.ASK


def test_an_ended_goal_is_asked_for_soon_and_given_up() -> None:
    plan = ResultPlan()
    for now in (0.0, 5.0, 15.0):
        plan.asked(now)
    plan.ended(20.0)
    plan.ended(20.2)
    times = [20.0 + ENDED_ASK * (2**number - 1) for number in range(1, 6)]
    assert asked_at(plan, 20.0 + ENDED_PATIENCE) == times
    assert plan.due(20.0 + ENDED_PATIENCE) is not Due.GIVE_UP
    assert plan.due(20.1 + ENDED_PATIENCE) is Due.GIVE_UP


@pytest.mark.parametrize(
    ("answer", "canceling", "final", "step"),
    [
        (CancelAnswer.AGREED, False, False, Step.AWAIT_END),
        (CancelAnswer.ENDED, False, False, Step.STOP),
        # It was cancelled by another caller, or by a request whose answer was lost.
        (CancelAnswer.ENDED, True, False, Step.AWAIT_END),
        (CancelAnswer.REFUSED, False, False, Step.STOP),
        # The cancellation has overtaken the goal, or another server has it.
        (CancelAnswer.UNKNOWN, False, False, Step.RETRY),
        (CancelAnswer.UNKNOWN, False, True, Step.STOP),
        (None, False, True, Step.RETRY),
        (None, True, True, Step.RETRY),
    ],
)
def test_what_follows_a_cancellation(
    answer: CancelAnswer | None, canceling: bool, final: bool, step: Step
) -> None:
    assert next_step(answer, canceling=canceling, final=final) is step


async def test_the_timer_runs_while_goals_are_out_and_once_later() -> None:
    clock = VirtualClock()
    await clock.advance(0.0)
    calls: list[str] = []
    goals = ActiveGoals(lambda: calls.append("tick"), lambda: calls.append("idle"))
    first, second = (ActiveGoal(uuid.uuid4(), 0.0) for _ in range(2))
    goals.add(first)
    goals.add(second)
    assert goals.find(first.key) is first
    await clock.advance(4.5 * TICK)
    assert calls == ["tick"] * 4
    assert goals.remove(first)
    assert not goals.remove(first)
    assert list(goals) == [second]
    goals.remove(second)
    await clock.advance(LINGER - TICK)
    goals.add(first)
    await clock.advance(1.5 * TICK)
    assert calls == ["tick"] * 5
    goals.remove(first)
    await clock.advance(2 * LINGER)
    assert calls == ["tick"] * 5 + ["idle"]
    goals.add(first)
    goals.stop_timer()
    await clock.advance(LINGER)
    assert len(calls) == 6


@pytest.fixture
async def server(fake_graph: FakeGraph) -> AsyncIterator[ScriptedAction]:
    server = ScriptedAction(fake_graph)
    yield server
    server.close()


async def test_a_goal_that_is_followed_is_asked_for_as_rarely_as_ones_own(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session, fake_graph.session() as other:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", {"order": 7}))
        await virtual_clock.advance(0.01)
        server.answer_send(0)
        await virtual_clock.advance(0.01)
        (key,) = server.statuses
        async with other.attach(Fibonacci, "/fibonacci", uuid.UUID(bytes=key)) as goal:
            await virtual_clock.advance(0.9 * FIRST_ASK)
            assert len(server.asks) == 2
            await virtual_clock.advance(0.2 * FIRST_ASK)
            assert len(server.asks) == 4
            server.end_goal(0, GoalStatus.SUCCEEDED)
            server.answer_all()
            assert await goal.result() == await task


async def test_a_server_vanishes_before_its_acceptance_arrives(
    fake_graph: FakeGraph, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await until(lambda: server.sends)
        server.answer_send(0)
        server.vanish()
        with pytest.raises(ServerGone, match="every server vanished"):
            await task


@pytest.mark.parametrize("leaves", [False, True])
async def test_a_goal_of_a_server_that_was_cut_off_is_cancelled_when_it_is_back(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction, leaves: bool
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await accept(virtual_clock, server)
        if leaves:
            task.cancel()
        server.cut()
        with pytest.raises(asyncio.CancelledError if leaves else ServerGone):
            await virtual_clock.skip(task)
        await virtual_clock.advance(0.8 * END_TIMEOUT)
        server.prompt = True
        server.come_back()
        await virtual_clock.advance(0.1)
        assert list(server.statuses.values()) == [GoalStatus.CANCELED]
        await virtual_clock.advance(0.2 * END_TIMEOUT)
        assert session.core.actions.out == 0


async def test_a_goal_whose_acceptance_was_cut_off_is_cancelled_when_its_server_is_back(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await virtual_clock.advance(0.1)
        with fake_graph.drop_responses():
            server.answer_send(0)
        server.cut()
        with pytest.raises(ServerGone):
            await virtual_clock.skip(task)
        server.prompt = True
        server.come_back()
        await virtual_clock.advance(1.0)
        assert list(server.statuses.values()) == [GoalStatus.CANCELED]
        assert session.core.actions.out == 0


async def test_a_server_that_does_not_come_back_is_not_warned_of(
    fake_graph: FakeGraph,
    virtual_clock: VirtualClock,
    server: ScriptedAction,
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await accept(virtual_clock, server)
        server.vanish()
        with pytest.raises(ServerGone):
            await virtual_clock.skip(task)
        await virtual_clock.advance(1.1 * END_TIMEOUT)
        assert session.core.actions.out == 0
    assert not caplog.records


async def test_a_detached_goal_of_a_server_that_was_cut_off_runs_on(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        pursuit = asyncio.create_task(detach(session))
        await accept(virtual_clock, server)
        server.cut()
        with pytest.raises(ServerGone):
            await virtual_clock.skip(pursuit)
        server.prompt = True
        server.come_back()
        await virtual_clock.advance(1.0)
        assert list(server.statuses.values()) == [GoalStatus.EXECUTING]


async def accept(virtual_clock: VirtualClock, server: ScriptedAction) -> None:
    """Accept the goal that has just been started."""
    await virtual_clock.advance(0.1)
    server.answer_send(0)
    await virtual_clock.advance(0.1)


async def detach(session: Session) -> None:
    async with session.goal(Fibonacci, "/fibonacci") as goal:
        goal.detach()
        await goal.result()


async def test_a_server_vanishes_while_an_attached_goal_waits_for_its_topics(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    server.vanish()
    async with fake_graph.session() as session:
        pursuit = session.attach(Fibonacci, "/fibonacci", uuid.uuid4())
        task = asyncio.create_task(pursuit.__aenter__())
        await virtual_clock.advance(0.1)
        server.come_back(topics=False)
        await virtual_clock.advance(0.1)
        server.vanish()
        await virtual_clock.advance(2.0)
        assert not task.done()
        with pytest.raises(ServiceUnavailable):
            await virtual_clock.skip(task)
        assert session.core.actions.out == 0


async def test_a_new_server_that_the_graph_does_not_report(virtual_clock: VirtualClock) -> None:
    graph = FakeGraph(graph_events=False)
    server = ScriptedAction(graph)
    async with graph.session() as session:
        before = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await until(lambda: server.sends)
        server.vanish()
        server.come_back()
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", {"order": 7}))
        await until(lambda: server.sends)
        server.answer_send(0)
        await virtual_clock.advance(1.0)
        server.end_goal(0, GoalStatus.SUCCEEDED)
        await virtual_clock.advance(1.0)
        server.answer_all()
        assert list((await task).sequence) == [7]
        with pytest.raises(ServerGone):
            await before
    server.close()
