"""Goals in memory, in any order of acceptance, feedback, result, cancellation and loss."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from test_msgs.action import Fibonacci

from rosasync import (
    CallError,
    Goal,
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalStatus,
    GoalTimeout,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
)
from rosasync._actions.client import GONE_DELAY
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction

EXPECTED = (
    GoalAborted,
    GoalCanceled,
    GoalRejected,
    GoalTimeout,
    ServerGone,
    ServiceUnavailable,
    SessionClosed,
    asyncio.CancelledError,
)

LONGEST_CUT = 50.0
"""Seconds without a server after which its goals are not expected to be cancelled any more."""


class Run:
    """A session with its callers, a scripted server, and one step after another."""

    def __init__(self, graph: FakeGraph, session: Session, server: ScriptedAction) -> None:
        self.graph = graph
        self.session = session
        self.server = server
        self.clock = VirtualClock()
        self.there = True
        self.cut_for = 0.0
        self.detached: set[bytes] = set()
        self.tasks: list[asyncio.Task[None]] = []
        self.results = 0

    async def step(self, kind: str, number: int) -> None:
        server = self.server
        steps: dict[str, Callable[[], object]] = {
            "act": lambda: self.start(self.act(len(self.tasks), number)),
            "block": lambda: self.start(self.block(len(self.tasks), number)),
            "detach": lambda: self.start(self.detach(len(self.tasks))),
            "leave": lambda: self.tasks and self.tasks[number % len(self.tasks)].cancel(),
            "accept": lambda: server.answer_send(number),
            "reject": lambda: server.answer_send(number, accept=False),
            "agree": lambda: server.answer_cancel(number),
            "refuse": lambda: server.answer_cancel(number, agree=False),
            "succeed": lambda: server.end_goal(number, GoalStatus.SUCCEEDED),
            "abort": lambda: server.end_goal(number, GoalStatus.ABORTED),
            "answer": lambda: server.answer_ask(number),
            "lose": lambda: server.lose_ask(number),
            "feedback": lambda: server.publish_feedback(number),
            "status": server.publish_status,
        }
        if kind == "vanish":
            self.vanish_or_come_back(cut=bool(number % 2))
        elif kind == "wait":
            seconds = (0.01, 0.3, 3.0, 30.0)[number % 4]
            await self.clock.advance(seconds)
            self.cut_for += 0.0 if self.there else seconds
        else:
            steps[kind]()
        for _ in range(number % 5):
            await asyncio.sleep(0)

    def start(self, work: Any) -> None:
        self.tasks.append(asyncio.create_task(work))

    def vanish_or_come_back(self, cut: bool = False) -> None:
        if self.there:
            self.server.cut() if cut else self.server.vanish()
        else:
            if self.cut_for > LONGEST_CUT:
                self.server.statuses.clear()
            self.server.come_back()
        self.there = not self.there

    async def act(self, order: int, number: int) -> None:
        def on_feedback(feedback: Fibonacci.Feedback) -> None:
            assert feedback.sequence[0] == order

        result = await self.session.act(
            Fibonacci,
            "/fibonacci",
            {"order": order},
            timeout=(None, 0.2, 2.0)[number % 3],
            accept_timeout=(10.0, 0.1)[number % 2],
            on_feedback=on_feedback,
        )
        self.check(result, order)

    async def block(self, order: int, number: int) -> None:
        async with self.session.goal(Fibonacci, "/fibonacci", {"order": order}, feedback=2) as goal:
            seen = -1
            async for feedback in goal:
                assert feedback.sequence[0] == order
                assert feedback.sequence[1] > seen
                seen = feedback.sequence[1]
                if seen % 3 == number % 3:
                    return
            if number % 2:
                await goal.cancel(timeout=1.0)
            self.check(await goal.result(timeout=5.0), order)

    async def detach(self, order: int) -> None:
        async with self.session.goal(Fibonacci, "/fibonacci", {"order": order}) as goal:
            goal.detach()
            self.detached.add(goal.id.bytes)
        await self.watch(goal, order)

    async def watch(self, goal: Goal[Any, Any], order: int) -> None:
        async with self.session.attach(Fibonacci, "/fibonacci", goal.id) as same:
            self.check(await same.result(), order)

    def check(self, result: Fibonacci.Result, order: int) -> None:
        assert list(result.sequence) == [order]
        self.results += 1

    async def finish(self, close: bool) -> None:
        """Let everything end: callers leave, or the session closes; the server answers at once."""
        self.server.prompt = True
        if not self.there:
            self.vanish_or_come_back()
        # A session that has seen no server for a moment closes without it.
        await self.clock.advance(2 * GONE_DELAY)
        self.server.answer_all()
        if not close:
            for task in self.tasks:
                task.cancel()
            await self.clock.skip(asyncio.wait(self.tasks)) if self.tasks else None
            await self.clock.advance(200.0)
            assert self.session.core.actions.out == 0
        await self.clock.skip(self.session.aclose())
        await self.clock.skip(asyncio.wait(self.tasks)) if self.tasks else None
        assert set(self.server.running) <= self.detached


KINDS = {
    "act": 5,
    "block": 4,
    "detach": 1,
    "leave": 4,
    "accept": 6,
    "reject": 1,
    "agree": 3,
    "succeed": 3,
    "abort": 1,
    "answer": 3,
    "lose": 1,
    "feedback": 4,
    "status": 2,
    "vanish": 1,
    "wait": 3,
}
STEPS = st.lists(
    st.tuples(
        st.sampled_from([kind for kind, weight in KINDS.items() for _ in range(weight)]),
        st.integers(0, 11),
    ),
    max_size=60,
)


async def play(steps: list[tuple[str, int]], close: bool, graph_events: bool) -> None:
    problems: list[dict[str, Any]] = []
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda loop, context: problems.append(context))
    graph = FakeGraph(graph_events=graph_events)
    async with graph.session() as session:
        server = ScriptedAction(graph)
        run = Run(graph, session, server)
        for kind, number in steps:
            await run.step(kind, number)
        await run.finish(close)
        for task in run.tasks:
            error = asyncio.CancelledError() if task.cancelled() else task.exception()
            if error is not None and not isinstance(error, EXPECTED):
                raise error
            if isinstance(error, CallError):
                assert error.srv_name == "/fibonacci"
        server.close()
    assert not problems
    others = asyncio.all_tasks() - {asyncio.current_task()}
    assert not others


@given(STEPS, st.booleans(), st.booleans())
@settings(deadline=None, max_examples=150)
def test_any_order_leaves_no_goal_behind(
    steps: list[tuple[str, int]], close: bool, graph_events: bool
) -> None:
    asyncio.run(play(steps, close, graph_events))
