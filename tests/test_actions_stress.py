"""Goals in bad times, with stock action servers: no orphan, no loss, no wait without end."""

from __future__ import annotations

import asyncio
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Any
from uuid import UUID

import pytest
from test_msgs.action import Fibonacci

from rosasync import (
    GoalError,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    RosasyncError,
    ServerGone,
    Session,
)
from rosasync._actions import registry, result_plan
from tests.support.action_servers import ActionServerProcess, none_runs
from tests.support.process import ROOT, own
from tests.support.times import LIMIT, TICK, until

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from tests.conftest import Bridge


class Leavers:
    """Callers that leave their goals at random moments, in every way."""

    def __init__(self, bridge: Bridge, choose: random.Random) -> None:
        self.bridge = bridge
        self.choose = choose
        self.detached: set[object] = set()
        self.sent = 0

    async def detach(self) -> None:
        """Detach one goal calmly: on a busy machine, the others may leave before they can."""
        async with (
            Session("detaches", bridge=self.bridge, timeout=LIMIT) as session,
            session.goal(Fibonacci, "/held") as goal,
        ):
            goal.detach()
        self.detached.add(goal.id)

    async def run(self, goals: int) -> None:
        """Open sessions that send goals, until there were so many."""
        while self.sent < goals:
            await self._run_session(min(self.choose.randint(5, 25), goals - self.sent))

    async def _run_session(self, goals: int) -> None:
        # The end of this block leaves what is still out.
        async with Session("leaver", bridge=self.bridge, timeout=LIMIT) as session:
            await session.wait_for_service(
                Fibonacci.Impl.SendGoalService, "/held/_action/send_goal", timeout=LIMIT
            )
            tasks = [asyncio.create_task(self._leave(session)) for _ in range(goals)]
            self.sent += goals
            await asyncio.sleep(self.choose.uniform(0, 2 * TICK))
            for task in self.choose.sample(tasks, goals // 2):
                task.cancel()
                if self.choose.random() < 0.3:
                    await asyncio.sleep(self.choose.uniform(0, TICK / 10))
            if self.choose.random() < 0.5:
                await asyncio.sleep(self.choose.uniform(0, 4 * TICK))
        for outcome in await asyncio.gather(*tasks, return_exceptions=True):
            # Besides the errors of goals: asyncio's own, of a timeout or a group.
            expected = RosasyncError | asyncio.CancelledError | TimeoutError | ExceptionGroup
            if outcome is not None and not isinstance(outcome, expected):
                raise outcome

    async def _leave(self, session: Session) -> None:
        choose = self.choose
        await asyncio.sleep(choose.choice([0, 0, choose.uniform(0, TICK)]))
        way = choose.choice(["act", "timeout", "block", "error", "group", "detach", "late"])
        if way == "act":
            await session.act(Fibonacci, "/held", {"order": 1})
        elif way == "timeout":
            await session.act(Fibonacci, "/held", timeout=choose.uniform(0, 2 * TICK))
        elif way == "late":
            await session.act(Fibonacci, "/held", accept_timeout=choose.uniform(0, TICK / 2))
        elif way == "group":
            async with asyncio.timeout(choose.uniform(0, 2 * TICK)), asyncio.TaskGroup() as group:
                for _ in range(2):
                    group.create_task(session.act(Fibonacci, "/held"))
        else:
            async with session.goal(Fibonacci, "/held", cancel_timeout=TICK) as goal:
                if way == "detach":
                    goal.detach()
                    self.detached.add(goal.id)
                await asyncio.sleep(choose.uniform(0, TICK))
                if way == "error":
                    raise GoalError("left by an error")


@pytest.fixture(autouse=True)
def close_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the end of a session wait longer: on a busy machine, its goals end later."""
    monkeypatch.setattr(registry, "CLOSE_TIMEOUT", LIMIT)


async def leave_goals(server: ActionServerProcess, bridge: Bridge, goals: int, seed: int) -> None:
    await server.serve("/held", hold=True, idle=True, accept_delay=0.001)
    leavers = Leavers(bridge, random.Random(seed))
    await leavers.detach()
    await leavers.run(goals)
    running: set[object] = set()
    for _ in range(40):
        running = set(await server.running("/held"))
        if running <= leavers.detached:
            break
        await asyncio.sleep(LIMIT / 80)
    assert running <= leavers.detached, f"{len(running - leavers.detached)} of {leavers.sent}"
    assert running, "no goal was detached"


async def test_no_goal_is_left_behind(action_server: ActionServerProcess, bridge: Bridge) -> None:
    await leave_goals(action_server, bridge, 200, seed=1)


@pytest.mark.soak
async def test_no_goal_of_two_thousand_is_left_behind(
    action_server: ActionServerProcess, bridge: Bridge
) -> None:
    await leave_goals(action_server, bridge, 2000, seed=2)


def test_the_end_of_the_loop_leaves_no_goal_behind(
    action_server: ActionServerProcess, bridge: Bridge
) -> None:
    """As Ctrl-C ends ``asyncio.run``: every task is cancelled, in the middle of everything."""

    async def program() -> None:
        async with Session("interrupted", bridge=bridge, timeout=LIMIT) as session:
            goals.extend(asyncio.create_task(session.act(Fibonacci, "/held")) for _ in range(11))
            await action_server.goals("/held", at_least=5)
            goals[0].cancel()
            tasks[0].cancel()
            await asyncio.sleep(LIMIT)

    tasks: list[asyncio.Task[None]] = []
    goals: list[asyncio.Task[Any]] = []

    async def run() -> None:
        tasks.append(asyncio.create_task(program()))
        await tasks[0]

    action_server.serve_now("/held", hold=True, idle=True)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(run())
    assert all(goal.cancelled() or goal.exception() for goal in goals)
    asyncio.run(none_runs(action_server, "/held"))


async def receive(session: Session) -> tuple[list[int], float]:
    """Return the feedback of a goal, and the most seconds for which the loop stood still."""
    received: list[int] = []
    goal = asyncio.create_task(
        session.act(
            Fibonacci, "/fast", on_feedback=lambda feedback: received.append(feedback.sequence[0])
        )
    )
    pause = 0.0
    while not goal.done():
        before = time.monotonic()
        await asyncio.sleep(TICK / 5)
        pause = max(pause, time.monotonic() - before)
    await goal
    return received, pause


@pytest.mark.parametrize("count", [500, pytest.param(5000, marks=pytest.mark.slow)])
async def test_a_quick_reader_gets_all_feedback(
    session: Session, action_server: ActionServerProcess, count: int
) -> None:
    """Half a second of it, and five."""
    await action_server.serve("/fast", feedback=count, rate=1000, readers=1)
    received, pause = await receive(session)
    # Who stands still, as on a busy machine, is not quick.
    while received != list(range(count)) and pause > 4 * TICK:
        received, pause = await receive(session)
    assert received == list(range(count))


async def test_forged_feedback_is_dropped(
    session: Session, action_server: ActionServerProcess, caplog: pytest.LogCaptureFixture
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        reader = asyncio.create_task(anext(goal))
        async with asyncio.timeout(LIMIT):
            while not goal.feedback_dropped:
                await action_server.forge("/held", goal.id)
        assert "a feedback message is dropped" in caplog.text
        await action_server.release("/held")
        with pytest.raises(StopAsyncIteration):
            await reader
        await goal.result()


async def test_a_lost_request_for_the_result_is_sent_again(
    session: Session, action_server: ActionServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(result_plan, "ENDED_ASK", 2 * TICK)
    await action_server.serve("/forgets", ignored_asks=2)
    result = await session.act(Fibonacci, "/forgets", {"order": 2})
    assert list(result.sequence) == [0, 1]


async def test_a_server_that_never_sends_a_result_is_not_waited_for_without_end(
    session: Session, action_server: ActionServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(result_plan, "ENDED_PATIENCE", 4 * TICK)
    await action_server.serve("/mute", ignored_asks=1_000_000)
    with pytest.raises(GoalTimeout, match="ended as SUCCEEDED, and the server does not send its"):
        await session.act(Fibonacci, "/mute")


async def test_a_killed_server_and_its_successor(bridge: Bridge) -> None:
    async with Session("survivor", bridge=bridge, timeout=LIMIT) as session:
        # Alive for the others also if a busy machine stops it for two seconds.
        with ActionServerProcess("mortal", lease=3) as server:
            await server.serve("/mortal", hold=True)
            goals = [asyncio.create_task(session.act(Fibonacci, "/mortal")) for _ in range(5)]
            await server.goals("/mortal", at_least=5)
            server.kill()
            for goal in goals:
                with pytest.raises(ServerGone):
                    await goal
        with ActionServerProcess("successor") as server:
            await server.serve("/mortal")
            result = await session.act(Fibonacci, "/mortal", {"order": 1}, accept_timeout=2 * LIMIT)
            assert list(result.sequence) == [0]


async def test_a_replaced_server_does_not_have_the_goals(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    async with session.goal(Fibonacci, "/held") as goal:
        await until(lambda: goal.status is GoalStatus.EXECUTING)
        await action_server.stop("/held")
        await action_server.serve("/held", hold=True)
        with pytest.raises(ServerGone):
            await goal.result(timeout=LIMIT)


async def test_goals_that_run_take_no_place_in_the_window(
    session: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, idle=True)
    tasks = [asyncio.create_task(session.act(Fibonacci, "/held")) for _ in range(30)]
    await action_server.goals("/held", at_least=30)
    await until(lambda: session.core.actions.out == 30)
    await until(lambda: session.pool.statistics().in_flight == 0)
    statistics = session.pool.statistics()
    assert (statistics.waiting, statistics.abandoned) == (0, 0)
    names = {key.srv_name for key in statistics.keys}
    assert names == {"/held/_action/send_goal", "/held/_action/cancel_goal"}
    await action_server.release("/held")
    await asyncio.gather(*tasks)
    assert session.core.actions.out == 0
    statuses = (await action_server.goals("/held")).values()
    assert set(statuses) == {GoalStatus.SUCCEEDED}


async def test_two_servers_of_one_name(
    session: Session, action_server: ActionServerProcess
) -> None:
    """Both get every goal, and both get every cancellation."""
    with ActionServerProcess("second") as second:
        servers = (action_server, second)
        for server in servers:
            await server.serve("/twice", hold=True, idle=True)
        await see_both(session)
        await match_all(session, servers)
        async with AsyncExitStack() as stack:
            pursuits = [session.goal(Fibonacci, "/twice") for _ in range(5)]
            goals = [await stack.enter_async_context(pursuit) for pursuit in pursuits]
            ids, left = ({goal.id for goal in each} for each in (goals, goals[3:]))
            for server in servers:
                await shown(server, lambda statuses: ids <= statuses.keys())
            for goal in goals[:3]:
                await goal.cancel()
            for server in servers:
                await shown(server, lambda statuses: running(statuses) & ids == left)
                await server.release("/twice")
            for goal in goals[3:]:
                assert len((await goal.result()).sequence) == 0


async def test_a_goal_that_one_of_two_servers_rejects_is_cancelled_on_the_other(
    session: Session, action_server: ActionServerProcess
) -> None:
    rejected: set[object] = set()
    with ActionServerProcess("second") as second:
        await action_server.serve("/twice", accept=False)
        await second.serve("/twice", hold=True, idle=True, accept_delay=TICK)
        await see_both(session)
        async with asyncio.timeout(LIMIT):
            # The first goals reach only one of them.
            while not rejected & (await second.goals("/twice")).keys():
                try:
                    await session.act(Fibonacci, "/twice", timeout=10 * TICK)
                except GoalRejected as error:
                    rejected.add(error.goal_id)
                    await asyncio.sleep(2 * TICK)
                except GoalTimeout:
                    # The other one has accepted it, alone or first.
                    pass
        await shown(second, lambda statuses: not running(statuses) & rejected)


async def see_both(session: Session) -> None:
    """Wait until the graph shows both servers."""
    await until(lambda: session.node.count_services("/twice/_action/get_result") == 2)


async def match_all(session: Session, servers: Iterable[ActionServerProcess]) -> None:
    """Send and cancel goals until each server has cancelled one: the first ones reach only one."""
    async with asyncio.timeout(LIMIT):
        for server in servers:
            while GoalStatus.CANCELED not in (await server.goals("/twice")).values():
                with suppress(GoalTimeout):
                    await session.act(Fibonacci, "/twice", timeout=2 * TICK)


def running(statuses: dict[UUID, int]) -> set[object]:
    """Return the goals that have not ended."""
    return {goal for goal, status in statuses.items() if status < GoalStatus.SUCCEEDED}


async def shown(
    server: ActionServerProcess, condition: Callable[[dict[UUID, int]], object]
) -> None:
    """Wait until the goals of a server are as wanted."""
    for _ in range(100):
        if condition(statuses := await server.goals("/twice")):
            return
        await asyncio.sleep(LIMIT / 100)
    raise AssertionError(statuses)


@pytest.mark.soak
@pytest.mark.timeout(15 * 60)
@pytest.mark.parametrize("sides", ["client", "both"])
def test_ten_thousand_goals_leave_no_memory_behind(
    action_server: ActionServerProcess, bridge: Bridge, sides: str
) -> None:
    if sides == "client":
        action_server.serve_now("/quick", result_timeout=5)
    program = [sys.executable, "-m", "tests.support.goal_memory", bridge, sides]
    output = subprocess.run(program, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert float(own(output)) < 1.0
