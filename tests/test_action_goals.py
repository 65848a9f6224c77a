"""What decides about a goal that is out: when its result is asked for."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from uuid import UUID

import pytest
from test_msgs.action import Fibonacci

from rosasync import GoalStatus
from rosasync._actions.active_goal import FIRST_ASK
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction


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
