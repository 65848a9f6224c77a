"""Places in the window, on fake ports: who gets the place of a lost or abandoned request."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import Limits, QueueTimeout, ResponseTimeout, Retry, Session
from rosasync._client import response_times
from tests.support.plain import Echo, echo
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from rosasync.testing._memory.services import MemoryClient
    from tests.support.fake_graph import FakeGraph

LONG = 1000.0
"""Seconds of grace: no place of these tests comes back with its end."""


@pytest.fixture
def patience(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> float:
    """Seconds without any answer after which a place is given up."""
    seconds: float = getattr(request, "param", TICK)
    monkeypatch.setattr(response_times, "PATIENCE_INITIAL", seconds)
    monkeypatch.setattr(response_times, "PATIENCE_MIN", seconds)
    return seconds


async def ask(session: Session, value: object, **options: Any) -> object:
    response = await session.call(Echo, "/echo", Echo.Request(value), **options)
    return response.value


async def abandon(session: Session, requests: int) -> None:
    """Send requests, and cancel their calls."""
    tasks = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(requests)]
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    assert session.pool.statistics().abandoned == requests


def the_port(graph: FakeGraph) -> MemoryClient:
    ((client,),) = ([*node.clients] for node in graph.nodes)
    return client


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize("answered", [0, 1])
@pytest.mark.usefixtures("patience")
async def test_abandoned_requests_do_not_hold_the_window_for_the_grace_period(
    fake_graph: FakeGraph, window: int, answered: int
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=window, grace=LONG)) as session:
        await session.wait_for_service(Echo, "/echo")
        for number in range(answered):
            await ask(session, number)
        with fake_graph.drop_requests():
            await abandon(session, window)
        assert await ask(session, "next", timeout=LIMIT) == "next"
        # Its answer shows that all requests before it have left the queue.
        assert session.pool.statistics().abandoned == 0


@pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
async def test_a_grace_that_has_ended_by_the_time_its_timer_is_set(fake_graph: FakeGraph) -> None:
    """uvloop gives a handle that is no timer then; it was asked for its time."""
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(grace=1e-9)) as session:
        await session.wait_for_service(Echo, "/echo")
        with fake_graph.drop_requests():
            tasks = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(3)]
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            assert all(task.cancelled() for task in tasks)
        assert await ask(session, "next", timeout=LIMIT) == "next"


@pytest.mark.usefixtures("patience")
async def test_a_lease_gets_its_place_back(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with (
        fake_graph.session(limits=Limits(in_flight=1, grace=LONG)) as session,
        session.pool.lease(Echo, "/echo") as client,
    ):
        with fake_graph.drop_requests(), pytest.raises(ResponseTimeout):
            await client.call(Echo.Request(1), timeout=TICK / 10)
        assert (await client.call(Echo.Request(2), timeout=LIMIT)).value == 2


@pytest.mark.parametrize("patience", [100 * LIMIT], indirect=True)
@pytest.mark.usefixtures("patience")
async def test_not_before_the_time_without_answers(fake_graph: FakeGraph) -> None:
    server = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(grace=LONG)) as session:
        await ask(session, 0)
        with fake_graph.hold_requests():
            await abandon(session, 10)
            with pytest.raises(QueueTimeout, match="10 abandoned"):
                await ask(session, "next", timeout=2 * TICK)
            assert len(the_port(fake_graph).sent) == 11
        assert await ask(session, "next") == "next"
    assert server.lost == 0


@pytest.mark.usefixtures("patience")
async def test_while_no_caller_waits_the_places_are_kept(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=4, grace=LONG)) as session:
        await ask(session, 0)
        with fake_graph.drop_requests():
            await abandon(session, 3)
            await asyncio.sleep(4 * TICK)
            assert session.pool.statistics().abandoned == 3
        assert await ask(session, 1) == 1


@pytest.mark.parametrize("patience", [100 * LIMIT], indirect=True)
@pytest.mark.usefixtures("patience")
async def test_a_new_server_has_none_of_the_abandoned_requests(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=2, grace=LONG)) as session:
        await ask(session, 0)
        await asyncio.sleep(0)
        with fake_graph.drop_requests():
            await abandon(session, 1)
            later = session.start(Echo, "/echo", Echo.Request(1), timeout=None)
            waiting = session.start(Echo, "/echo", Echo.Request(2), timeout=None)
        # The graph still shows the old one, as it does for seconds if a process was killed.
        fake_graph.serve(Echo, "/echo", echo)
        assert (await asyncio.wait_for(waiting, LIMIT)).value == 2
        assert session.pool.statistics().abandoned == 0
        later.cancel()
        await asyncio.wait([later])
        assert session.pool.statistics().abandoned == 0


@pytest.mark.parametrize("retry", [None, Retry(2, LONG)])
@pytest.mark.usefixtures("patience")
async def test_calls_that_are_out_on_a_dead_server_do_not_hold_up_the_next_one(
    fake_graph: FakeGraph, retry: Retry | None
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(timeout=None) as session:
        await ask(session, 0)
        with fake_graph.drop_requests():
            out = [session.start(Echo, "/echo", retry=retry) for _ in range(10)]
        waiting = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(20)]
        # The graph still shows the old server, as it does for seconds if a process was killed.
        fake_graph.serve(Echo, "/echo", echo)
        answers = await asyncio.wait_for(asyncio.gather(*waiting), LIMIT)
        assert [answer.value for answer in answers] == list(range(20))
        total = session.pool.statistics()
        if retry is None:
            assert (total.in_flight, total.abandoned) == (10, 0)
            for task in out:
                task.cancel()
        # The others have gone to the next server, after the answers to three later requests.
        await asyncio.wait_for(asyncio.wait(out), LIMIT)
        assert session.pool.statistics().idle == 1


@pytest.mark.parametrize("patience", [100 * LIMIT], indirect=True)
@pytest.mark.usefixtures("patience")
async def test_while_the_old_server_answers_the_next_one_costs_no_call_its_answer(
    fake_graph: FakeGraph,
) -> None:
    old = fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(timeout=None) as session:
        await ask(session, 0)
        with fake_graph.hold_requests():
            calls = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(30)]
            await until(lambda: session.pool.statistics().in_flight == 10)
            fake_graph.serve(Echo, "/echo", echo)
            await asyncio.sleep(TICK)
            assert session.pool.statistics().in_flight == 10
        answers = await asyncio.gather(*calls)
    assert [answer.value for answer in answers] == list(range(30))
    assert old.lost == 0


async def test_the_statistics_show_the_window(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=4)) as session:
        total = session.pool.statistics()
        assert (total.window, total.share, total.servers) == (0, 0, 0)
        await ask(session, 0)
        await asyncio.sleep(0)
        total = session.pool.statistics()
        assert (total.window, total.share, total.servers) == (4, 10, 1)
        async with fake_graph.session() as other:
            await ask(other, 0)
            await until(lambda: session.pool.statistics().share == 5)
            async with fake_graph.session() as third:
                await ask(third, 0)
                await until(lambda: session.pool.statistics().share == 3)
                assert session.pool.statistics().window == 3
                assert third.pool.statistics().window == 3
        fake_graph.serve(Echo, "/echo", echo)
        await until(lambda: session.pool.statistics().servers == 2)
