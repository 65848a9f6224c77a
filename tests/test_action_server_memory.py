"""Action servers on a graph in memory: virtual time, and what many goals leave behind."""

from __future__ import annotations

import asyncio
import gc
import tracemalloc
import uuid
from typing import Any

import pytest
from action_msgs.msg import GoalStatusArray
from test_msgs.action import Fibonacci

from rosasync import (
    ContextShutdown,
    GoalAborted,
    GoalCanceled,
    GoalStatus,
    ServerGone,
    Session,
    UsageError,
)
from rosasync._actions import server_goals
from rosasync._core.ports import TopicQos
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.serving import AnyServer, UnmatchedClients
from tests.support.times import LIMIT, TICK, until
from tests.support.traced import Recorder

SEND, GET = Fibonacci.Impl.SendGoalService, Fibonacci.Impl.GetResultService


async def at_once(goal: Any) -> Any:
    return {"sequence": [goal.request.order]}


async def forever(goal: Any) -> Any:
    await asyncio.Event().wait()


def goal_of(order: int = 0) -> Any:
    request = SEND.Request()
    request.goal_id.uuid = list(uuid.uuid4().bytes)
    request.goal.order = order
    return request


async def run(session: Session, request: Any) -> Any:
    """Send a goal, and return the response with its result."""
    response = await session.call(SEND, "/fib/_action/send_goal", request, timeout=None)
    assert response.accepted
    return await get(session, request)


async def get(session: Session, request: Any) -> Any:
    return await session.call(
        GET, "/fib/_action/get_result", {"goal_id": request.goal_id}, timeout=None
    )


async def test_a_goal(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        messages: list[GoalStatusArray] = []
        session.core.node.open_subscription(
            GoalStatusArray, "/fib/_action/status", TopicQos(), messages.append
        )
        async with session.serve_action(Fibonacci, "fib", at_once) as server:
            assert server.action_name == "/fib"
            response = await run(session, goal_of(3))
            assert (response.status, list(response.result.sequence)) == (GoalStatus.SUCCEEDED, [3])
            await until(lambda: messages)
            assert messages[-1].status_list[0].status == GoalStatus.SUCCEEDED


async def test_results_expire_after_their_time(
    fake_graph: FakeGraph, virtual_clock: VirtualClock
) -> None:
    async with fake_graph.session() as session:
        server = session.serve_action(Fibonacci, "/fib", at_once)
        request = goal_of()
        await run(session, request)
        await virtual_clock.advance(890.0)
        later = goal_of()
        assert later != request
        await run(session, later)
        assert server.statistics().results == 2
        assert (await get(session, request)).status == GoalStatus.SUCCEEDED
        await virtual_clock.advance(11.0)
        assert server.statistics().results == 1
        assert (await get(session, request)).status == GoalStatus.UNKNOWN
        await virtual_clock.advance(890.0)
        assert server.statistics().results == 0


@pytest.mark.parametrize("timeout", [None, float("inf")])
async def test_results_without_an_expiry(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, timeout: float | None
) -> None:
    async with fake_graph.session() as session:
        server = session.serve_action(Fibonacci, "/fib", at_once, result_timeout=timeout)
        await run(session, goal_of())
        await virtual_clock.advance(1e6)
        assert server.statistics().results == 1


async def test_many_goals_leave_nothing_behind(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        server = session.serve_action(
            Fibonacci, "/fib", at_once, concurrency=10, result_timeout=0.01
        )

        async def goals(count: int) -> int:
            for _ in range(count // 10):
                await asyncio.gather(*(run(session, goal_of()) for _ in range(10)))
                # The graph in memory keeps what was sent.
                for client in fake_graph.clients:
                    client.sent.clear()
            await until(lambda: server.statistics().results == 0)
            gc.collect()
            return tracemalloc.get_traced_memory()[0]

        tracemalloc.start()
        try:
            await goals(100)
            before = await goals(100)
            after = await goals(500)
        finally:
            tracemalloc.stop()
        assert server.statistics().succeeded == 700
        assert after - before < 30_000


async def test_the_status_of_many_goals_is_published_less_often(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    # It is usually some milliseconds, in which a busy machine runs no more than one goal.
    monkeypatch.setattr(server_goals, "MAX_DELAY", LIMIT)
    monkeypatch.setattr(server_goals, "DELAY", LIMIT)
    async with fake_graph.session() as session:
        server = session.serve_action(Fibonacci, "/fib", at_once)
        published: list[GoalStatusArray] = []
        session.core.node.open_subscription(
            GoalStatusArray, "/fib/_action/status", TopicQos(1000), published.append
        )
        for _ in range(99):
            await run(session, goal_of())
        assert len(published) >= 99
        before = len(published)
        for _ in range(20):
            await run(session, goal_of())
        assert len(published) - before < 20
        await server.aclose()
        last = published[-1].status_list
        assert [each.status for each in last] == [GoalStatus.SUCCEEDED] * 119


def service_of(session: Session, part: str) -> AnyServer:
    """One of the services of the action that a session serves."""
    (service,) = (each for each in session.core.servers if each.srv_name.endswith(part))
    return service


class TestEnding:
    """Clients that have not asked for their result when the server is closed."""

    async def test_one_that_was_told_of_its_acceptance_late(
        self, fake_graph: FakeGraph, virtual_clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # Shorter than the delay of the acceptance, and longer than that of the request for the
        # result, by seconds: the clock goes on by itself.
        monkeypatch.setattr(server_goals, "ASKING_TIME", 7.0)
        async with fake_graph.session() as session, fake_graph.session() as client:
            server = session.serve_action(Fibonacci, "/fib", forever)
            clients = UnmatchedClients(service_of(session, "send_goal"))
            task = asyncio.create_task(run(client, goal_of()))
            await virtual_clock.advance(8.0)
            assert clients.attempts > 3
            ends: list[asyncio.Task[None]] = []
            send = clients._send

            def send_and_end(header: Any, response: Any) -> None:
                send(header, response)
                ends.append(asyncio.create_task(server.aclose()))

            clients._send = send_and_end
            clients.unmatched = False
            fake_graph.delay = 2.0
            await virtual_clock.advance(2.0)
            assert ends
            fake_graph.delay = 0.0
            await virtual_clock.advance(4.0)
            assert (await task).status == GoalStatus.CANCELED
            await asyncio.gather(*ends)

    async def test_one_that_has_left(
        self, fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(server_goals, "ASKING_TIME", 2 * LIMIT)
        async with fake_graph.session() as session:
            server = session.serve_action(Fibonacci, "/fib", forever)
            async with fake_graph.session() as client:
                assert (await client.call(SEND, "/fib/_action/send_goal", goal_of())).accepted
                closing = asyncio.create_task(server.aclose())
                await until(lambda: server.statistics().canceled)
                await asyncio.sleep(2 * TICK)
                assert not closing.done()
            async with asyncio.timeout(LIMIT):
                await closing

    async def test_one_that_has_never_asked(
        self, fake_graph: FakeGraph, virtual_clock: VirtualClock, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Its acceptance was sent long ago, so its request is not under way."""
        monkeypatch.setattr(server_goals, "ASKING_TIME", 2 * LIMIT)
        async with fake_graph.session() as session, fake_graph.session() as client:
            server = session.serve_action(Fibonacci, "/fib", forever, concurrency=2)
            assert (await client.call(SEND, "/fib/_action/send_goal", goal_of())).accepted
            await virtual_clock.advance(11 * LIMIT)
            task = asyncio.create_task(client.act(Fibonacci, "/fib"))
            await until(lambda: server.statistics().asking)
            async with asyncio.timeout(LIMIT):
                await server.aclose()
            with pytest.raises(GoalCanceled):
                await task


class TestTracing:
    """The trace of a session follows goals, and their calls only if it asks for them."""

    async def test_goals(self, fake_graph: FakeGraph) -> None:
        trace = Recorder()

        async def handler(goal: Any) -> Any:
            match goal.request.order:
                case 1:
                    raise GoalAborted("blocked")
                case 2:
                    await asyncio.sleep(LIMIT)
            return {"sequence": []}

        async with fake_graph.session(trace=trace) as session, fake_graph.session() as client:
            session.serve_action(Fibonacci, "/fib", handler)
            await client.act(Fibonacci, "/fib")
            with pytest.raises(GoalAborted):
                await client.act(Fibonacci, "/fib", {"order": 1})
            first = asyncio.create_task(client.act(Fibonacci, "/fib", {"order": 2}))
            await until(lambda: len(trace.of("server")) == 3)
            second = asyncio.create_task(client.act(Fibonacci, "/fib"))
            await until(lambda: len(trace.of("server")) == 4)
            first.cancel()
            await second
        assert trace.of("server") == [
            "handling > answered",
            "handling > failed > failed",
            "handling > canceling > cancelled",
            "queued > handling > answered",
        ]
        assert {(call.srv_name, call.srv_type) for call in trace.calls} == {
            ("/fib", "test_msgs/action/Fibonacci")
        }

    async def test_their_calls_too(self, fake_graph: FakeGraph) -> None:
        trace = Recorder()
        trace.action_calls = True  # type: ignore[attr-defined]
        async with fake_graph.session(trace=trace) as session, fake_graph.session() as client:
            session.serve_action(Fibonacci, "/fib", at_once)
            await client.act(Fibonacci, "/fib")
        assert {call.srv_name for call in trace.calls} == {
            "/fib",
            "/fib/_action/send_goal",
            "/fib/_action/get_result",
        }

    async def test_a_server_that_ends_at_once(self, fake_graph: FakeGraph) -> None:
        trace = Recorder()

        async def handler(goal: Any) -> Any:
            await asyncio.sleep(LIMIT)

        async with fake_graph.session(trace=trace) as session, fake_graph.session() as client:
            server = session.serve_action(Fibonacci, "/fib", handler)
            task = asyncio.create_task(client.act(Fibonacci, "/fib"))
            await until(lambda: trace.calls)
            server.end(ContextShutdown)
            with pytest.raises(ServerGone):
                await task
        assert trace.of("server") == ["handling > dropped"]


def test_feedback_from_a_thread_that_outlasts_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_goals, "ASKING_TIME", 0.0)
    goals: list[Any] = []

    async def handler(goal: Any) -> Any:
        goals.append(goal)
        await asyncio.sleep(LIMIT)

    async def main() -> None:
        async with FakeGraph().session() as session:
            session.serve_action(Fibonacci, "/fib", handler)
            request = await session.call(SEND, "/fib/_action/send_goal", goal_of())
            assert request.accepted
            await until(lambda: goals)

    asyncio.run(main())
    with pytest.raises(UsageError, match="has ended"):
        goals[0].feedback({"sequence": []})
