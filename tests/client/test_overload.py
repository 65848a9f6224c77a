"""Overloads in virtual time: what is answered, and what `Retry` adds to it."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from rosasync import Limits, Retry
from rosasync._client.dispatch import Dispatch
from rosasync._client.probes import next_pause
from rosasync._client.retry import PER_SECOND
from tests.support.fake_graph import FakeGraph
from tests.support.overload import Case, Outcome, StockCaller, VirtualLoop, offer, simulate
from tests.support.plain import Echo, echo

HASTY = Retry(attempts=10, after=0.05, backoff=1.0, budget=0.2)


def play(scenario: Callable[[FakeGraph], Awaitable[None]]) -> None:
    """Run a scenario on a loop in virtual time."""
    loop = VirtualLoop()
    try:
        loop.run_until_complete(_run(scenario))
    finally:
        loop.close()


async def _run(scenario: Callable[[FakeGraph], Awaitable[None]]) -> None:
    await scenario(FakeGraph())


@pytest.mark.parametrize(
    ("case", "goodput", "late"),
    [
        # The timeout is ten times the work.
        (Case(work=0.01, timeouts=(0.1,), load=1.5), 0.97, 0.02),
        (Case(work=0.01, timeouts=(0.1,), load=1.5, exponential=True), 0.92, 0.06),
        (Case(work=0.01, timeouts=(0.1,), load=4, exponential=True), 0.9, 0.08),
        # Five times the work, so that a full window would take longer than the callers have.
        (Case(work=0.1, timeouts=(0.5,), load=1.5), 0.93, 0.05),
        # Fifty times the work, with response times that overlap.
        (Case(work=0.01, timeouts=(0.5,), load=4, exponential=True), 0.95, 0.05),
    ],
)
def test_the_server_works_for_callers_that_still_wait(
    case: Case, goodput: float, late: float
) -> None:
    result = simulate(case)
    assert result.goodput >= goodput
    assert result.late <= late
    assert result.lost == 0


MIXED = tuple(0.2 + 1.8 * (7 * n % 50) / 50 for n in range(50))
"""Seconds after which callers leave, from 0.2 to 2."""


@pytest.mark.parametrize("server", ["rosasync-status", "stock"])
@pytest.mark.parametrize("load", [2, 4])
@pytest.mark.parametrize("patience", [(1.0,), MIXED, (1.0, None)], ids=["1", "mixed", "half"])
def test_the_server_works_for_callers_that_have_not_left(
    server: str, load: float, patience: tuple[float | None, ...]
) -> None:
    result = simulate(Case("rosasync-leaving", server, load=load, timeouts=patience))
    assert result.goodput >= 0.9


@pytest.mark.parametrize("server", ["rosasync-status", "stock"])
def test_no_more_is_out_than_is_answered_before_callers_leave(server: str) -> None:
    """A full window would take as long as they wait."""
    result = simulate(Case("rosasync-leaving", server, work=0.1, load=2, timeouts=(1.0,)))
    assert result.goodput >= 0.9


def test_with_a_client_for_each_call_the_server_works_for_callers_that_still_wait() -> None:
    """Eight requests that are out take longer than a caller has."""
    case = Case(work=0.1, timeouts=(0.5,), load=1.5)
    result = simulate(case, limits=Limits(clients=8, in_flight=1))
    assert result.goodput >= 0.8
    assert result.late <= 0.2


@pytest.mark.parametrize(
    ("case", "goodput"),
    [
        # Without pauses between the probes: 0.78, 0.46, 0.83 and 0.39.
        (Case(work=0.1, timeouts=(0.5,), load=4, processes=4), 0.88),
        (Case(work=0.1, timeouts=(0.5,), load=1.5, processes=4), 0.6),
        (Case(work=0.1, timeouts=(1.0,), load=4, processes=8), 0.9),
        (Case(work=0.1, timeouts=(1.0,), load=1.5, processes=8), 0.65),
    ],
)
def test_several_clients_that_ask_how_quick_the_server_is_do_not_fill_its_queue(
    case: Case, goodput: float
) -> None:
    assert simulate(case).goodput >= goodput


def test_a_client_pauses_after_a_probe_that_took_too_long() -> None:
    assert next_pause(0.0, took=0.6, left=0.5, others=3) == pytest.approx(0.2)
    # Longer after the next one, up to half of the time that its caller had.
    assert next_pause(0.2, took=0.44, left=0.5, others=3) == pytest.approx(0.24)
    assert next_pause(0.24, took=0.8, left=0.5, others=3) == pytest.approx(0.25)
    # Shorter after a quick one, also because the others cannot have much out.
    assert next_pause(0.25, took=0.35, left=0.5, others=3) == pytest.approx(0.2)
    assert next_pause(0.25, took=0.01, left=0.5, others=3) == 0.0
    # A client that is alone waits only for its own requests.
    assert next_pause(0.0, took=5.0, left=0.5, others=0) == 0.0


@pytest.mark.parametrize("failing", ["requests", "responses"])
def test_retries_keep_to_their_budget_whatever_fails(failing: str) -> None:
    async def scenario(graph: FakeGraph) -> None:
        graph.serve(Echo, "/echo", echo)
        async with graph.session() as session:
            await session.wait_for_service(Echo, "/echo")
            lossy = graph.drop_requests() if failing == "requests" else graph.drop_responses()
            with lossy:
                outcome = await offer(session, 100, 5.0, timeout=0.5, retry=HASTY)
            retried = session.pool.statistics().retried
            assert outcome.answered == 0
            # The tokens of the first second, those of the time, and the share of the calls.
            assert 0 < retried <= PER_SECOND * (1.0 + 5.5) + HASTY.budget * 500

    play(scenario)


def test_what_a_server_has_dropped_is_not_sent_again_in_an_overload() -> None:
    async def scenario(graph: FakeGraph) -> None:
        async with graph.session() as serving, graph.session() as session:
            server = serving.serve(Echo, "/echo", _forever, concurrency=1, backlog=0, status=True)
            await session.wait_for_service(Echo, "/echo")
            running = session.start(Echo, "/echo", timeout=None)
            await asyncio.sleep(0.1)
            calls = [session.start(Echo, "/echo", timeout=2.0, retry=HASTY) for _ in range(3)]
            await asyncio.sleep(0.01)
            assert server.statistics().dropped == 3
            (client,) = session.pool.service(Echo, "/echo", None).clients
            assert isinstance(client.owner, Dispatch)
            client.owner.order.overloaded_until = 1000.0
            errors = await asyncio.gather(*calls, return_exceptions=True)
            assert all("the server is slower than its callers" in str(error) for error in errors)
            assert session.pool.statistics().retried == 0
            running.cancel()

    play(scenario)


async def _forever(request: Any, response: Any) -> Any:
    await asyncio.Event().wait()


@pytest.mark.parametrize("retry", [None, HASTY])
def test_retries_to_a_server_that_serves_the_newest_first_keep_to_their_budget(
    retry: Retry | None,
) -> None:
    """Answers to later requests show no loss there, so the fast retry errs."""
    runs: dict[int, int] = {}

    async def scenario(graph: FakeGraph) -> None:
        async def handler(request: Any, response: Any) -> Any:
            await asyncio.sleep(0.01)
            if request.value >= 0:
                runs[request.value] = runs.get(request.value, 0) + 1
            return Echo.Response(request.value)

        async with graph.session() as serving, graph.session() as session:
            server = serving.serve(Echo, "/echo", handler, concurrency=1)
            await session.wait_for_service(Echo, "/echo")
            flood = StockCaller(graph, Outcome(), value=-1)
            numbers, calls = itertools.count(), []
            for number in range(1000):
                await flood.call(1.0)
                if number % 5 == 0:
                    request = Echo.Request(next(numbers))
                    calls.append(session.start(Echo, "/echo", request, timeout=1.0, retry=retry))
                await asyncio.sleep(0.005)
            assert server.statistics().overloads
            await asyncio.wait(calls)
            answered = sum(call.exception() is None for call in calls)
            twice = sum(count - 1 for count in runs.values())
            assert answered >= 0.9 * len(calls)
            assert twice <= session.pool.statistics().retried <= PER_SECOND * 7 + 0.2 * 200
            if retry is None:
                assert twice == 0

    play(scenario)
