"""What decides about a goal that is out: when its result is asked for, and when it is lost."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from uuid import UUID

import pytest
from test_msgs.action import Fibonacci

from rosasync import GoalStatus, ServerGone
from rosasync._actions.active_goal import FIRST_ASK
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction
from tests.support.times import until


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
        async with other.attach(Fibonacci, "/fibonacci", UUID(bytes=key)) as goal:
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
