"""Places in the window: when the place of an abandoned request comes back."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import Limits, QueueTimeout, ResponseTimeout, Session
from rosasync._client import response_times
from rosasync._client.client import Client
from rosasync._client.response_times import ResponseTimes
from tests.support.plain import Echo, echo
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from rosasync.testing import FakeClient, FakeGraph

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


def the_port(graph: FakeGraph) -> FakeClient:
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


async def test_only_one_place_in_each_time_without_answers(
    fake_graph: FakeGraph, patience: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = asyncio.get_running_loop()
    call_at = loop.call_at
    due: list[float] = []

    def spy(
        when: float, callback: Callable[..., object], *args: Any, **options: Any
    ) -> asyncio.TimerHandle:
        if getattr(callback, "__func__", None) is Client._on_timer:
            due.append(when)
        return call_at(when, callback, *args, **options)

    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=3, grace=LONG)) as session:
        await ask(session, 0)
        port = the_port(fake_graph)
        with fake_graph.drop_requests():
            await abandon(session, 3)
            monkeypatch.setattr(loop, "call_at", spy)
            tasks = [session.start(Echo, "/echo", Echo.Request(n)) for n in range(3)]
            for places in (1, 2, 3):
                await until(lambda n=places: len(port.sent) >= 4 + n)  # type: ignore[misc]
                total = session.pool.statistics()
                assert total.in_flight + total.abandoned == 3
            assert len(port.sent) == 7
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    waits = [later - earlier for earlier, later in pairwise(due)]
    assert len([wait for wait in waits if wait >= patience]) >= 2
    assert not [wait for wait in waits if 0 < wait < patience]


@pytest.mark.parametrize("answered", [False, True])
@pytest.mark.parametrize("patience", [100 * LIMIT], indirect=True)
async def test_an_answer_begins_the_time_again(
    fake_graph: FakeGraph, patience: float, answered: bool
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(in_flight=2, grace=LONG * LIMIT)) as session:
        await ask(session, 0)
        (client,) = session.pool.service(Echo, "/echo", None).clients
        port = the_port(fake_graph)
        with fake_graph.drop_requests():
            await abandon(session, 2)
        client._silent_since -= 2 * patience
        if answered:
            # To none of them: the server is alive, and may still answer them.
            port.deliver(1, Echo.Response())
        waiting = session.start(Echo, "/echo", Echo.Request(1), timeout=None)
        await asyncio.sleep(TICK)
        assert len(port.sent) == (3 if answered else 4)
        waiting.cancel()
        await asyncio.wait([waiting])


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


async def test_what_was_sent_before_a_new_server_came_takes_no_place_afterwards(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session(limits=Limits(grace=LONG)) as session:
        await ask(session, 0)
        await asyncio.sleep(0)
        with fake_graph.drop_requests():
            early = session.start(Echo, "/echo", Echo.Request(1), timeout=None)
        fake_graph.serve(Echo, "/echo", echo)
        with fake_graph.drop_requests():
            late = session.start(Echo, "/echo", Echo.Request(2), timeout=None)
            # The servers are queried in the turn after the match.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
        for task, abandoned in ((early, 0), (late, 1)):
            task.cancel()
            await asyncio.wait([task])
            assert session.pool.statistics().abandoned == abandoned


def test_patience_is_a_multiple_of_the_lowest_response_time() -> None:
    times = ResponseTimes()
    assert times.patience == 1.0
    times.add(0.125)
    assert times.patience == 0.5
    times.add(0.0625)
    assert times.patience == 0.25


def test_a_slow_server_makes_a_client_patient() -> None:
    times = ResponseTimes()
    for _ in range(15):
        times.add(3.0)
    assert 6.0 < times.patience < 12.0


def test_patience_has_a_minimum() -> None:
    times = ResponseTimes()
    times.add(0.0001)
    assert times.patience == 0.2


def test_losses_that_are_repaired_late_do_not_make_a_client_patient() -> None:
    times = ResponseTimes()
    for _ in range(100):
        times.add(3.0)
        times.add(0.001)
        times.add(0.001)
    times.add(1.0)
    assert times.patience < 0.5


async def test_a_slow_response_is_seen_although_its_caller_has_left(
    fake_graph: FakeGraph,
) -> None:
    fake_graph.serve(Echo, "/echo", echo)
    async with fake_graph.session() as session:
        with fake_graph.delay_responses(6 * TICK):
            with pytest.raises(ResponseTimeout):
                await ask(session, 1, timeout=TICK)
            (client,) = session.pool.service(Echo, "/echo", None).clients
            await until(lambda: session.pool.statistics().late == 1)
        assert client._response_times.patience > 1.0


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
