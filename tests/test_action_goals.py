"""What decides about a goal that is out: its status, when to ask for its result, when to let go."""

from __future__ import annotations

import asyncio
import math
import uuid
from collections.abc import AsyncIterator

import pytest
from test_msgs.action import Fibonacci

from rosasync import ContextShutdown, GoalStatus, ServerGone, ServiceUnavailable, Session
from rosasync._actions import result_plan
from rosasync._actions.active_goal import ActiveGoal
from rosasync._actions.active_goals import LINGER, PAUSE, ActiveGoals
from rosasync._actions.cancellation import END_TIMEOUT, CancelAnswer, Step, next_step
from rosasync._actions.result_plan import (
    ANSWER_PATIENCE,
    ENDED_ASK,
    ENDED_PATIENCE,
    FIRST_ASK,
    LAST_ASK,
    Due,
    ResultPlan,
)
from rosasync._client import graph_watch
from rosasync.testing import VirtualClock
from rosasync.testing._memory.graph import MemoryNode
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction
from tests.support.times import count_timers, until

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
    assert plan.next_time == math.inf
    plan.asked(0.0)
    plan.accepted(0.0)
    assert plan.next_time == FIRST_ASK
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
    assert plan.next_time == 20.0 + ENDED_PATIENCE
    assert plan.due(19.9 + ENDED_PATIENCE) is not Due.GIVE_UP
    assert plan.due(20.0 + ENDED_PATIENCE) is Due.GIVE_UP


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


class Timed:
    """Goals whose plans are followed in a time that only the test moves forward."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        # Before the clock is used, which adds what is skipped to this.
        monkeypatch.setattr(asyncio.get_running_loop(), "time", lambda: 0.0)
        self.clock = VirtualClock()
        self.calls: list[tuple[float, object]] = []
        self.goals = ActiveGoals(self.on_due, lambda: self.note("idle"))

    def note(self, what: object) -> None:
        self.calls.append((round(self.clock.time(), 3), what))

    def on_due(self, goal: ActiveGoal, due: Due) -> None:
        self.note(due)
        self.ask(goal)

    def ask(self, goal: ActiveGoal) -> None:
        goal.plan.asked(self.clock.time())
        self.goals.reschedule(goal)

    def add(self) -> ActiveGoal:
        goal = ActiveGoal(uuid.uuid4(), 0.0)
        self.goals.add(goal)
        return goal


async def test_the_timer_is_set_to_what_a_plan_demands(monkeypatch: pytest.MonkeyPatch) -> None:
    timed = Timed(monkeypatch)
    first, second = timed.add(), timed.add()
    assert timed.goals.find(first.key) is first
    await timed.clock.advance(2.0)
    timed.ask(first)
    await timed.clock.advance(1.0)
    timed.ask(second)
    await timed.clock.advance(10.0)
    assert timed.calls == [(7.0, Due.ASK), (8.0, Due.ASK)]
    first.show(SUCCEEDED, timed.clock.time())
    timed.goals.reschedule(first)
    await timed.clock.advance(1.0)
    assert timed.calls[2:] == [(13.5, Due.ASK)]


async def test_the_plans_of_many_goals_are_looked_at_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    timed = Timed(monkeypatch)
    for _ in range(100):
        timed.ask(timed.add())
        await timed.clock.advance(PAUSE / 100)
    await timed.clock.advance(FIRST_ASK)
    assert timed.calls == [(FIRST_ASK, Due.ASK)] + [(FIRST_ASK + PAUSE, Due.ASK)] * 99


async def test_the_timer_runs_once_after_the_last_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    timed = Timed(monkeypatch)
    first, second = timed.add(), timed.add()
    timed.ask(first)
    assert timed.goals.remove(first)
    assert not timed.goals.remove(first)
    assert list(timed.goals) == [second]
    timed.goals.remove(second)
    await timed.clock.advance(LINGER - 1.0)
    timed.goals.remove(timed.add())
    await timed.clock.advance(LINGER - 1.0)
    assert timed.calls == []
    await timed.clock.advance(2 * LINGER)
    assert timed.calls == [(2 * LINGER - 1.0, "idle")]
    timed.goals.remove(timed.add())
    timed.goals.stop_timer()
    await timed.clock.advance(2 * LINGER)
    assert len(timed.calls) == 1


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
            # The clock goes on by itself, by seconds on a busy machine.
            await virtual_clock.advance(0.3 * FIRST_ASK)
            assert len(server.asks) == 2
            await virtual_clock.advance(0.8 * FIRST_ASK)
            assert len(server.asks) == 4
            server.end_goal(0, GoalStatus.SUCCEEDED)
            server.answer_all()
            assert await goal.result() == await task


async def test_a_goal_that_runs_for_hours_wakes_nothing_but_its_plan(
    fake_graph: FakeGraph,
    virtual_clock: VirtualClock,
    server: ScriptedAction,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(graph_watch, "POLL_CONTEXT", 1e6)
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", {"order": 7}))
        await accept(virtual_clock, server)
        await virtual_clock.advance(1.0)
        timers = count_timers(monkeypatch)
        began = len(server.asks)
        await virtual_clock.advance(4 * 3600.0)
        asks = len(server.asks) - began
        assert asks == pytest.approx(4 * 3600.0 / LAST_ASK, abs=5)
        # Each request for the result sets two: one for the next, one for the pace.
        assert len(timers) <= 2 * asks + 2
        server.end_goal(0, GoalStatus.SUCCEEDED)
        server.answer_all()
        assert list((await task).sequence) == [7]


async def test_a_context_that_is_shut_down_without_an_event(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await accept(virtual_clock, server)
        await virtual_clock.advance(60.0)
        assert isinstance(session.node, MemoryNode)
        session.node.up = False
        await virtual_clock.advance(1.1 * graph_watch.POLL_CONTEXT)
        assert task.done()
        with pytest.raises(ContextShutdown):
            await task


async def test_a_server_vanishes_without_an_event_of_the_graph(virtual_clock: VirtualClock) -> None:
    graph = FakeGraph(graph_events=False)
    server = ScriptedAction(graph)
    async with graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await accept(virtual_clock, server)
        await virtual_clock.advance(60.0)
        server.vanish()
        await virtual_clock.advance(1.0)
        assert task.done()
        with pytest.raises(ServerGone, match="every server vanished"):
            await task
    server.close()


async def test_the_status_is_there_before_the_acceptance(
    fake_graph: FakeGraph,
    virtual_clock: VirtualClock,
    server: ScriptedAction,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The clock goes on by itself, and by a tenth of a second soon on a busy machine.
    patience = 0.8 * FIRST_ASK
    monkeypatch.setattr(result_plan, "ANSWER_PATIENCE", patience)
    async with fake_graph.session() as session:
        pursuit = session.goal(Fibonacci, "/fibonacci", {"order": 7})
        task = asyncio.create_task(pursuit.__aenter__())
        await virtual_clock.advance(0.1)
        with fake_graph.delay_responses(0.2 * patience):
            server.answer_send(0)
            await virtual_clock.advance(0.01)
        await virtual_clock.advance(0.3 * patience)
        goal = await task
        assert goal.accepted_at is not None
        assert len(server.asks) == 1
        server.prompt = True
        await virtual_clock.skip(pursuit.__aexit__(None, None, None))


@pytest.mark.parametrize("leaves", [False, True])
async def test_an_acceptance_that_is_lost_is_learnt_from_the_status(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction, leaves: bool
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", {"order": 7}))
        await virtual_clock.advance(0.1)
        with fake_graph.drop_responses():
            server.answer_send(0)
            await virtual_clock.advance(0.01)
        if leaves:
            task.cancel()
        await virtual_clock.advance(1.1 * ANSWER_PATIENCE)
        assert len(server.asks) == 1
        if leaves:
            server.answer_all()
            await virtual_clock.advance(0.1)
            assert list(server.statuses.values()) == [GoalStatus.CANCELING]
        server.end_goal(0, GoalStatus.SUCCEEDED)
        server.answer_all()
        if leaves:
            with pytest.raises(asyncio.CancelledError):
                await task
        else:
            assert list((await task).sequence) == [7]
        await virtual_clock.advance(0.1)
        assert session.core.actions.out == 0


async def test_an_acceptance_that_is_lost_is_learnt_from_the_cancellation(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", {"order": 7}))
        await virtual_clock.advance(0.1)
        server.lose_topics()
        with fake_graph.drop_responses():
            server.answer_send(0)
            await virtual_clock.advance(0.01)
        task.cancel()
        await virtual_clock.advance(0.1)
        server.answer_cancel(0)
        await virtual_clock.advance(1.1 * ANSWER_PATIENCE)
        assert len(server.asks) == 1
        server.end_goal(0, GoalStatus.CANCELED)
        server.answer_all()
        await virtual_clock.advance(0.1)
        assert session.core.actions.out == 0


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
            await virtual_clock.advance(0.01)
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


async def test_an_attached_goal_of_a_server_that_the_graph_shows_late(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
) -> None:
    async with fake_graph.session() as session:
        key = uuid.uuid4()
        async with session.attach(Fibonacci, "/fibonacci", key) as goal:
            late = ScriptedAction(fake_graph)
            late.orders[key.bytes] = 7
            late.statuses[key.bytes] = GoalStatus.EXECUTING
            late.publish_status()
            await virtual_clock.advance(0.1)
            server.vanish()
            await virtual_clock.advance(1.0)
            assert not goal.done
            late.prompt = True
            late.end_goal(0, GoalStatus.SUCCEEDED)
            await virtual_clock.advance(1.0)
            assert list((await goal.result()).sequence) == [7]
            late.close()


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
