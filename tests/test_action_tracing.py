"""A goal is one traced call: its phases and its end; its services appear only if asked for."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from test_msgs.action import Fibonacci

from rosasync import GoalAborted, GoalTimeout, Session
from rosasync.opentelemetry import OpenTelemetryTrace
from tests.support.fake_graph import FakeGraph
from tests.support.times import LIMIT, TICK
from tests.support.traced import Recorder


async def fibonacci(goal: Any) -> Any:
    if goal.request.order < 0:
        raise GoalAborted("stuck")
    await asyncio.sleep(LIMIT if goal.request.order else 0)
    return {"sequence": []}


async def serve(graph: FakeGraph) -> Session:
    session = graph.session()
    await session.open()
    session.serve_action(Fibonacci, "/fibonacci", fibonacci, concurrency=10)
    return session


async def test_a_goal_is_one_call(fake_graph: FakeGraph) -> None:
    server, recorder = await serve(fake_graph), Recorder()
    async with fake_graph.session(trace=recorder) as session:
        await session.act(Fibonacci, "/fibonacci")
        with pytest.raises(GoalAborted):
            await session.act(Fibonacci, "/fibonacci", {"order": -1})
        with pytest.raises(GoalTimeout):
            await session.act(Fibonacci, "/fibonacci", {"order": 1}, timeout=20 * TICK)
        async with session.goal(Fibonacci, "/fibonacci", {"order": 1}) as goal:
            await goal.cancel()
        async with session.goal(Fibonacci, "/fibonacci", {"order": 1}) as goal:
            goal.detach()
    await server.aclose()
    assert recorder.of("client") == [
        "sent > accepted > answered",
        "sent > accepted > failed",
        "sent > accepted > canceling > cancelled",
        "sent > accepted > canceling > cancelled",
        "sent > accepted > detached",
    ]
    assert {(call.srv_name, call.srv_type) for call in recorder.calls} == {
        ("/fibonacci", "test_msgs/action/Fibonacci")
    }


async def test_the_spans_of_goals_that_do_not_succeed(fake_graph: FakeGraph) -> None:
    server = await serve(fake_graph)
    provider, spans = TracerProvider(), InMemorySpanExporter()
    provider.add_span_processor(SimpleSpanProcessor(spans))
    async with fake_graph.session(trace=OpenTelemetryTrace(provider)) as session:
        with pytest.raises(GoalAborted):
            await session.act(Fibonacci, "/fibonacci", {"order": -1})
        async with session.goal(Fibonacci, "/fibonacci", {"order": 1}) as goal:
            await goal.cancel()
    await server.aclose()
    aborted, cancelled = spans.get_finished_spans()
    assert not aborted.status.is_ok
    assert [event.name for event in cancelled.events] == ["sent", "accepted", "canceling"]


@pytest.mark.parametrize("action_calls", [False, True])
async def test_its_services_have_spans_if_asked_for(
    fake_graph: FakeGraph, action_calls: bool
) -> None:
    server = await serve(fake_graph)
    provider, spans = TracerProvider(), InMemorySpanExporter()
    provider.add_span_processor(SimpleSpanProcessor(spans))
    trace = OpenTelemetryTrace(provider, action_calls=action_calls)
    async with fake_graph.session(trace=trace) as session:
        await session.act(Fibonacci, "/fibonacci")
    await server.aclose()
    by_name = {span.name: span for span in spans.get_finished_spans()}
    goal = by_name.pop("test_msgs/action/Fibonacci")
    assert [event.name for event in goal.events] == ["sent", "accepted"]
    assert set(by_name) == ({"test_msgs/action/Fibonacci_SendGoal"} if action_calls else set())
