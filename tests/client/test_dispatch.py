"""Who goes next, on fake ports in virtual time: overload, and what must not suffer from it."""

from __future__ import annotations

import asyncio
import random
import re
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from rosasync import Limits, QueueTimeout, ResponseTimeout, Retry, Session
from rosasync._client.client import Client
from rosasync._client.dispatch import Dispatch
from tests.support.fake_graph import FakeGraph
from tests.support.overload import Outcome, SerialServer, VirtualLoop, keep_calling, offer
from tests.support.plain import Echo

Scenario = Callable[[Session, SerialServer], Awaitable[None]]

WORK = 0.01
"""Seconds for which the server works on each request: it can do a hundred a second."""
LEARN = 1.0
"""Seconds after the beginning of an overload in which the response times become known."""


def play(scenario: Scenario, *, work: float = WORK, spread: bool = False, **options: Any) -> None:
    """Run a scenario on a loop in virtual time."""
    loop = VirtualLoop()

    async def run() -> None:
        graph = FakeGraph()
        async with graph.session(**options) as session:
            server = SerialServer(graph, work, spread=random.Random(1) if spread else None)
            await session.wait_for_service(Echo, "/echo")
            await scenario(session, server)

    try:
        loop.run_until_complete(run())
    finally:
        loop.close()


@pytest.mark.parametrize("spread", [False, True])
@pytest.mark.parametrize(
    ("work", "callers", "timeout"),
    [
        (0.01, 50, 0.5),
        (0.01, 300, 0.5),
        (0.001, 300, 0.1),
        # A full window would take longer than the callers have.
        (0.1, 50, 0.6),
    ],
)
def test_in_a_standing_overload_the_server_works_for_callers_that_still_wait(
    work: float, callers: int, timeout: float, spread: bool
) -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        await keep_calling(session, callers, 100 * work, timeout=timeout)
        before = server.served
        outcome = await keep_calling(session, callers, 400 * work, timeout=timeout)
        served = server.served - before
        assert outcome.answered >= (0.85 if spread else 0.97) * served
        assert served >= 0.95 * 400 * (work / server.work)
        assert server.lost == 0

    play(scenario, work=work, spread=spread)


@pytest.mark.parametrize("rate", [150, 200, 400, 1000])
@pytest.mark.parametrize("retry", [None, Retry(after=0.2)])
def test_whatever_is_offered(rate: int, retry: Retry | None) -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        outcome = await offer(session, rate, 5.0, timeout=1.0, retry=retry)
        assert outcome.answered >= 0.95 * server.served
        assert server.served >= 0.95 * 5.0 / WORK
        assert set(outcome.errors) <= {QueueTimeout, ResponseTimeout}
        assert outcome.errors[ResponseTimeout] <= 0.05 * server.served

    play(scenario)


@pytest.mark.parametrize("load", [0.5, 0.9])
def test_below_its_capacity_nothing_is_refused(load: float) -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        outcome = await offer(session, load / WORK, 5.0, timeout=0.2)
        assert not outcome.errors

    play(scenario)


@pytest.mark.parametrize("slower", [1, 10])
def test_after_an_overload_every_call_is_answered_at_once(slower: int) -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        server.work = slower * WORK
        await offer(session, 4 / server.work, 5.0, timeout=0.5)
        server.work = WORK
        outcome = await offer(session, 0.5 / WORK, 1.0, timeout=0.5)
        assert not outcome.errors

    play(scenario)


def test_no_call_is_sent_with_less_time_left_than_an_answer_takes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    short: list[float] = []
    send = Client.send

    def spy(client: Client, call: Any, now: float) -> Any:
        if not client.window.idle and call.deadline - now < client.window.expected(now):
            short.append(now)
        return send(client, call, now)

    async def scenario(session: Session, server: SerialServer) -> None:
        await keep_calling(session, 40, LEARN, timeout=0.3)
        monkeypatch.setattr(Client, "send", spy)
        await keep_calling(session, 40, 5.0, timeout=0.3)
        assert short == []

    play(scenario)


def test_a_call_without_a_deadline_is_never_passed_over() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        load = asyncio.create_task(keep_calling(session, 100, 5.0, timeout=0.5))
        await asyncio.sleep(LEARN)
        patient = [session.start(Echo, "/echo", timeout=None) for _ in range(20)]
        await asyncio.wait_for(asyncio.gather(*patient), 2.0)
        await load

    play(scenario)


async def call_and_note(
    session: Session, number: int, timeout: float | None, answered: list[int]
) -> None:
    """Make a call, and note its number when it is answered."""
    await session.call(Echo, "/echo", Echo.Request(number), timeout=timeout)
    answered.append(number)


def test_among_those_with_time_enough_the_first_to_come_is_served_first() -> None:
    answered: list[int] = []

    async def scenario(session: Session, server: SerialServer) -> None:
        load = asyncio.create_task(keep_calling(session, 30, 5.0, timeout=0.2))
        await asyncio.sleep(LEARN)
        await asyncio.gather(
            *(call_and_note(session, number, 60.0, answered) for number in range(50))
        )
        assert answered == sorted(answered)
        await load

    play(scenario)


def test_a_server_that_has_become_quick_again_serves_those_that_were_passed_over() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        server.work = 0.3
        load = asyncio.create_task(keep_calling(session, 30, 5.0, timeout=10.0))
        await asyncio.sleep(4.0)
        victims = [session.start(Echo, "/echo", timeout=1.0) for _ in range(20)]
        await asyncio.sleep(0)
        server.work = 0.001
        await load
        outcome = await asyncio.gather(*victims, return_exceptions=True)
        assert not [error for error in outcome if isinstance(error, Exception)]

    play(scenario, limits=Limits(in_flight=2))


def test_the_error_says_how_long_an_answer_takes_and_what_was_left() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        calls = [session.start(Echo, "/echo", timeout=0.5) for _ in range(100)]
        errors = [
            e
            for e in await asyncio.gather(*calls, return_exceptions=True)
            if isinstance(e, Exception)
        ]
        passed = re.compile(r"the server answers after 0\.1\d* s now, and 0\.\d+ s were left")
        assert any(isinstance(e, QueueTimeout) and passed.search(str(e)) for e in errors)

    play(scenario)


def test_a_lone_call_is_sent_however_short_its_time() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        for _ in range(50):
            await session.call(Echo, "/echo", timeout=10.0)
        server.work = 0.5
        for _ in range(5):
            with pytest.raises(ResponseTimeout):
                await session.call(Echo, "/echo", timeout=0.01)
            await asyncio.sleep(1.0)
        server.work = WORK
        outcome = Outcome()
        await outcome.call(session, timeout=0.02)
        assert outcome.answered == 1

    play(scenario)


def test_in_an_overload_nothing_is_sent_again() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        hasty = Retry(attempts=10, after=0.05, backoff=1.0, budget=10.0)
        load = asyncio.create_task(keep_calling(session, 100, 5.0, timeout=0.5, retry=hasty))
        await asyncio.sleep(LEARN)
        before = session.pool.statistics().retried
        await load
        assert session.pool.statistics().retried - before <= 5

    play(scenario)


# Callers that leave without notice.


async def keep_leaving(session: Session, rate: float, seconds: float, patience: float) -> int:
    """Have callers come that give up when they have waited so long; return how many did not."""
    answered = 0

    async def call() -> None:
        nonlocal answered
        try:
            async with asyncio.timeout(patience):
                await session.call(Echo, "/echo", timeout=None)
        except TimeoutError:
            return
        answered += 1

    async with asyncio.TaskGroup() as callers:
        for _ in range(round(rate * seconds)):
            callers.create_task(call())
            await asyncio.sleep(1 / rate)
    return answered


def test_a_patient_caller_is_served_while_others_leave() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        load = asyncio.create_task(keep_leaving(session, 400, 6.0, patience=0.5))
        await asyncio.sleep(2.0)
        patient = [session.start(Echo, "/echo", timeout=None) for _ in range(20)]
        # Each eighth turn, as soon as they have waited for longer than the others.
        await asyncio.wait_for(asyncio.gather(*patient), 0.6 + 20 * 8 * WORK)
        # The rest was for those that leave.
        assert await load >= 0.85 * (6.0 / WORK) - 20

    play(scenario)


def test_patient_callers_are_served_in_their_order_while_others_leave() -> None:
    answered: list[int] = []

    async def scenario(session: Session, server: SerialServer) -> None:
        load = asyncio.create_task(keep_leaving(session, 400, 4.0, patience=0.2))
        await asyncio.sleep(LEARN)
        await asyncio.gather(
            *(call_and_note(session, number, None, answered) for number in range(40))
        )
        assert answered == sorted(answered)
        await load

    play(scenario)


def test_callers_cancelled_together_do_not_change_the_order() -> None:
    answered: list[int] = []

    async def scenario(session: Session, server: SerialServer) -> None:
        halted = [session.start(Echo, "/echo", timeout=None) for _ in range(50)]
        await asyncio.sleep(0.05)
        for task in halted:
            task.cancel()
        async with asyncio.TaskGroup() as callers:
            for number in range(100):
                callers.create_task(call_and_note(session, number, None, answered))
                await asyncio.sleep(WORK / 2)
        assert answered == list(range(100))

    play(scenario)


def test_those_passed_over_are_sent_when_no_caller_leaves_any_more() -> None:
    """No request is answered and no caller comes, so only a poll of the graph lets them go."""

    async def scenario(session: Session, server: SerialServer) -> None:
        await keep_leaving(session, 30, 4.0, patience=0.35)
        await asyncio.sleep(0.4)
        server.work = 1000.0
        patient = [session.start(Echo, "/echo", timeout=None) for _ in range(6)]
        await asyncio.sleep(0.1)
        assert session.pool.statistics().in_flight < 6
        await asyncio.sleep(3.0)
        assert session.pool.statistics().in_flight == 6
        for task in patient:
            task.cancel()

    play(scenario, work=0.1)


def test_those_that_give_up_while_there_is_no_server_say_nothing() -> None:
    async def scenario(session: Session, server: SerialServer) -> None:
        server.close()
        await asyncio.sleep(1.0)
        await keep_leaving(session, 100, 1.0, patience=0.2)
        dispatch = next(iter(session.pool.service(Echo, "/echo", None).clients)).owner
        assert isinstance(dispatch, Dispatch)
        assert dispatch.order.patience.until < 0

    play(scenario)
