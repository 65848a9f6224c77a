"""Feedback between clients and servers that have just been discovered: nothing is lost."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from test_msgs.action import Fibonacci

from rosasync import ContextShutdown, GoalStatus, Session
from rosasync._actions import active_goals, feedback, server_watch
from rosasync._actions.active_goals import LINGER
from rosasync._actions.feedback import MOST_HELD
from rosasync._actions.server_watch import MATCH_TIMEOUT
from rosasync.testing import VirtualClock
from rosasync.testing._memory.topics import MemorySubscription
from tests.support.action_servers import ActionServerProcess
from tests.support.fake_graph import FakeGraph
from tests.support.scripted_action import ScriptedAction
from tests.support.serving import UnmatchedClients, discard
from tests.support.times import LIMIT, TICK, until

NEW_CLIENTS = """
import asyncio, sys
from test_msgs.action import Fibonacci
from rosasync import Session
from rosasync._actions import server_watch

server_watch.MATCH_TIMEOUT = 20.0

async def main():
    for _ in range(4):
        async with Session("new_client", bridge=sys.argv[1], timeout=20.0) as session:
            async with session.goal(Fibonacci, "/count", {"order": 3}) as goal:
                print([message.sequence[0] async for message in goal])
                await goal.result()

asyncio.run(main())
"""
"""In a process of its own: within one, messages do not pass through the middleware's protocol."""


HOLD_TIME, SETTLE_TIME, PERIOD = 10.0, 8.0, 0.05
"""Seconds, for the constants in `feedback`. They are longer: real time goes on beside a virtual
clock, by seconds on a busy machine."""


async def count(goal: Any) -> Any:
    """Publish one message for each number up to the order, and end at once."""
    message = Fibonacci.Feedback()
    for number in range(goal.request.order):
        message.sequence = [number]
        goal.feedback(message)
    return {"sequence": [goal.request.order]}


async def numbers(session: Session, order: int, name: str = "/count") -> list[int]:
    """Send a goal, and return the numbers in its feedback, read after its end."""
    async with session.goal(Fibonacci, name, {"order": order}, feedback=1000) as goal:
        await goal.result(timeout=LIMIT)
        return [message.sequence[0] async for message in goal]


class NewSubscriptions:
    """Makes the subscriptions of a server's clients new to its middleware.

    Attributes:
        matched: whether they are matched. What is published before is lost.
        arrived: whether they are known to have what was published.
        asked: how often they were looked for.
        published: the number in each message that was published.
        error: raised instead, if it is set.
    """

    def __init__(self, server: Any, matched: bool = False, arrived: bool = True) -> None:
        self.matched = matched
        self.arrived = arrived
        self.error: Exception | None = None
        self.asked = 0
        self.published: list[int] = []
        publisher = server._feedback_publisher
        self._publish = publisher.publish
        publisher.publish = self._publish_or_lose
        publisher.reaches = self._reaches
        publisher.acknowledged = lambda: self.arrived

    def _reaches(self, client: object) -> bool:
        self.asked += 1
        if self.error is not None:
            raise self.error
        return self.matched

    def _publish_or_lose(self, message: Any) -> None:
        if self.error is not None:
            raise self.error
        self.published.append(message.feedback.sequence[0])
        if self.matched:
            self._publish(message)


class TestNewClients:
    """A server holds back what a client that was just discovered would not get."""

    @pytest.fixture(autouse=True)
    def times(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(feedback, "HOLD_TIME", HOLD_TIME)
        monkeypatch.setattr(feedback, "SETTLE_TIME", SETTLE_TIME)
        monkeypatch.setattr(feedback, "PERIOD", PERIOD)

    @pytest.fixture
    async def session(self, fake_graph: FakeGraph) -> AsyncIterator[Session]:
        async with fake_graph.session() as session:
            yield session

    async def test_feedback_waits_for_the_match_and_the_result_for_the_feedback(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count))
        task = asyncio.create_task(numbers(session, 12))
        await virtual_clock.advance(HOLD_TIME / 2)
        assert new.published == []
        assert not task.done()
        new.matched = True
        await until(lambda: new.published)
        # A stock client has room for ten messages.
        assert len(new.published) <= 10
        assert await virtual_clock.skip(task) == list(range(12))

    async def test_a_client_that_is_not_matched_is_waited_for_once(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count))
        started = virtual_clock.time()
        assert await virtual_clock.skip(numbers(session, 3)) == []
        assert virtual_clock.time() - started >= HOLD_TIME
        assert new.published == [0, 1, 2]
        asked = new.asked
        assert await numbers(session, 2) == []
        assert new.asked == asked

    async def test_no_more_than_some_messages_are_held_back(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count))
        started = virtual_clock.time()
        await virtual_clock.skip(numbers(session, MOST_HELD + 20))
        assert new.published == list(range(MOST_HELD + 20))
        assert virtual_clock.time() - started < HOLD_TIME

    async def test_a_result_waits_until_the_feedback_has_arrived(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        server = session.serve_action(Fibonacci, "/count", count)
        new = NewSubscriptions(server, matched=True, arrived=False)
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(SETTLE_TIME / 2)
        assert new.published == [0, 1, 2]
        assert not task.done()
        new.arrived = True
        assert await virtual_clock.skip(task) == [0, 1, 2]

    async def test_but_not_for_long(self, session: Session, virtual_clock: VirtualClock) -> None:
        server = session.serve_action(Fibonacci, "/count", count)
        NewSubscriptions(server, matched=True, arrived=False)
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(SETTLE_TIME + 2 * PERIOD)
        assert await task == [0, 1, 2]

    async def test_nobody_looks_for_a_client_that_was_reached_until_the_graph_changes(
        self, session: Session, fake_graph: FakeGraph
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count), matched=True)
        await numbers(session, 3)
        assert new.asked == 1
        await numbers(session, 3)
        assert new.asked == 1
        fake_graph.changed()
        await numbers(session, 3)
        assert new.asked == 2

    async def test_without_events_of_the_graph_it_looks_for_each_goal(
        self, virtual_clock: VirtualClock
    ) -> None:
        async with FakeGraph(graph_events=False).session() as session:
            new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count), matched=True)
            for goals in (1, 2):
                assert await virtual_clock.skip(numbers(session, 3)) == [0, 1, 2]
                assert new.asked == goals

    async def test_nobody_looks_for_a_client_whose_goal_has_no_feedback(
        self, session: Session
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count))
        await numbers(session, 0)
        assert new.asked == 0

    async def test_no_feedback_precedes_an_acceptance_that_is_sent_again(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        server = session.serve_action(Fibonacci, "/count", count)
        new = NewSubscriptions(server, matched=True)
        clients = UnmatchedClients(server._services[-1])
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(HOLD_TIME / 2)
        assert clients.attempts > 1
        assert new.published == []
        clients.unmatched = False
        assert await virtual_clock.skip(task) == [0, 1, 2]

    async def test_the_end_of_the_server_waits_for_what_is_held_back(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        server = session.serve_action(Fibonacci, "/count", count)
        new = NewSubscriptions(server)
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(TICK)
        closing = asyncio.create_task(server.aclose())
        await virtual_clock.advance(TICK)
        new.matched = True
        await virtual_clock.skip(closing)
        assert await task == [0, 1, 2]

    async def test_a_later_goal_is_not_held_up(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        """The feedback of a goal that has run for long needs no proof that it arrives."""
        go_on = asyncio.Event()

        async def late(goal: Any) -> Any:
            await go_on.wait()
            return await count(goal)

        server = session.serve_action(Fibonacci, "/count", late)
        NewSubscriptions(server, matched=True, arrived=False)
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(HOLD_TIME)
        started = virtual_clock.time()
        go_on.set()
        assert await virtual_clock.skip(task) == [0, 1, 2]
        assert virtual_clock.time() - started < SETTLE_TIME

    async def test_a_node_that_is_down_sends_nothing_any_more(
        self, session: Session, virtual_clock: VirtualClock
    ) -> None:
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count))
        task = asyncio.create_task(numbers(session, 3))
        await virtual_clock.advance(TICK)
        asked, new.error = new.asked, ContextShutdown()
        await virtual_clock.advance(HOLD_TIME)
        assert (new.asked, new.published) == (asked + 1, [])
        await discard(task)

    async def test_few_clients_are_remembered(
        self, session: Session, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(feedback, "MOST_CLIENTS", 0)
        new = NewSubscriptions(session.serve_action(Fibonacci, "/count", count), matched=True)
        for goals in (1, 2):
            await numbers(session, 3)
            assert new.asked == goals


class TestNewTopics:
    """A client whose topics are new sends its goal when their server has matched them."""

    @pytest.fixture
    async def server(self, fake_graph: FakeGraph) -> AsyncIterator[ScriptedAction]:
        """A server that is asked for a second goal, after the topics of the first were closed."""
        server = ScriptedAction(fake_graph)
        yield server
        server.close()

    @pytest.fixture
    async def session(
        self, fake_graph: FakeGraph, virtual_clock: VirtualClock, server: ScriptedAction
    ) -> AsyncIterator[Session]:
        async with fake_graph.session() as session:
            server.prompt = True
            task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
            await virtual_clock.advance(TICK)
            server.end_goal(0, GoalStatus.SUCCEEDED)
            await virtual_clock.skip(task)
            await virtual_clock.advance(LINGER + TICK)
            server.prompt = False
            yield session

    @pytest.fixture
    def match(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
        """A function that delivers what servers have kept for the subscriptions made since."""
        catch_up = MemorySubscription.catch_up
        late: list[tuple[MemorySubscription, Any]] = []
        monkeypatch.setattr(MemorySubscription, "catch_up", lambda *pair: late.append(pair))

        def match() -> None:
            for subscription, publisher in late:
                catch_up(subscription, publisher)

        return match

    async def test_a_goal_waits_for_the_status_that_its_server_has_kept(
        self,
        session: Session,
        virtual_clock: VirtualClock,
        server: ScriptedAction,
        match: Callable[[], None],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(server_watch, "MATCH_TIMEOUT", 100.0)
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci", accept_timeout=None))
        await virtual_clock.advance(10.0)
        assert server.sends == []
        match()
        await virtual_clock.advance(10.0)
        assert len(server.sends) == 1
        end(server, task)

    async def test_but_not_for_long(
        self,
        session: Session,
        virtual_clock: VirtualClock,
        server: ScriptedAction,
        match: Callable[[], None],
    ) -> None:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await virtual_clock.advance(2 * MATCH_TIMEOUT)
        assert len(server.sends) == 1
        end(server, task)

    async def test_nor_for_that_of_a_server_that_was_replaced(
        self,
        session: Session,
        virtual_clock: VirtualClock,
        server: ScriptedAction,
        match: Callable[[], None],
    ) -> None:
        server.vanish()
        server.come_back()
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        await virtual_clock.advance(TICK)
        assert len(server.sends) == 1
        end(server, task)

    async def test_what_is_there_takes_no_time(
        self, session: Session, server: ScriptedAction
    ) -> None:
        task = asyncio.create_task(session.act(Fibonacci, "/fibonacci"))
        for _ in range(20):
            await asyncio.sleep(0)
        assert len(server.sends) == 1
        end(server, task)


def end(server: ScriptedAction, task: asyncio.Task[Any]) -> None:
    """Let a server answer its goal, and the goal's caller go."""
    server.prompt = True
    server.answer_all()
    task.cancel()


@pytest.fixture
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait longer for matches and deliveries, which a busy machine delays."""
    monkeypatch.setattr(feedback, "HOLD_TIME", LIMIT)
    monkeypatch.setattr(feedback, "SETTLE_TIME", LIMIT)
    monkeypatch.setattr(server_watch, "MATCH_TIMEOUT", LIMIT)


@pytest.mark.usefixtures("patience")
async def test_new_clients_get_all_feedback(session: Session) -> None:
    """Without the wait for its arrival, the result overtakes it for three clients of four.

    Not for the first: nothing was published before that its subscription need not get.
    """
    session.serve_action(Fibonacci, "/count", count)
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", NEW_CLIENTS, session.bridge), stdout=subprocess.PIPE
    )
    output, _ = await process.communicate()
    assert output.decode() == 4 * "[0, 1, 2]\n"


@pytest.mark.usefixtures("patience")
async def test_new_topics_get_all_feedback(
    session: Session, action_server: ActionServerProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(active_goals, "LINGER", 0.0)
    session.serve_action(Fibonacci, "/count", count)
    await action_server.serve("/stock", feedback=3)
    for _ in range(4):
        assert await numbers(session, 3) == [0, 1, 2]
        assert len(await numbers(session, 3, "/stock")) == 3
        await until(lambda: not session.core.actions.out)
