"""Who goes next in any overload, in virtual time: what must hold of each decision."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rosasync import CallError, Limits, PoolFull, Retry, Session
from rosasync._client.client import Client
from rosasync._client.dispatch import Dispatch
from rosasync._client.order import TURNS
from rosasync._client.window import Window
from tests.support.fake_graph import FakeGraph
from tests.support.overload import DELAY, SerialServer, VirtualLoop
from tests.support.places import check_places
from tests.support.plain import Echo

RETRY = Retry(attempts=3, after=0.05)
WORKS = [0.001, 0.01, 0.05, 0.2]
LONG = 30.0
"""Seconds after which an overload is over and its response times are stale."""

Step = tuple[str, Any, Any]

CALLS = st.tuples(
    st.just("call"), st.integers(1, 15), st.sampled_from([None, 20, 50, 100, 200, 300, 500, 2000])
)
WAITS = st.tuples(st.just("wait"), st.sampled_from([0.0, 0.005, 0.02, 0.1, 0.3, 12.0]), st.none())
LEAVING = st.tuples(
    st.just("leaving"), st.integers(1, 15), st.sampled_from([20, 50, 100, 200, 300, 500, 2000])
)
# Calls at once with one timeout in ms, which their session does not know if they are leaving; time
# that passes; a caller that is cancelled; and a server that becomes slower or quicker.
STEPS = st.one_of(
    CALLS,
    WAITS,
    CALLS,
    WAITS,
    LEAVING,
    st.tuples(st.just("retry"), st.integers(1, 5), st.sampled_from([100, 300, 2000])),
    st.tuples(st.just("cancel"), st.integers(0, 1000), st.none()),
    st.tuples(st.just("work"), st.sampled_from(WORKS), st.none()),
)
LIMITS = st.builds(
    Limits,
    clients=st.sampled_from([1, 1, 2, 8]),
    in_flight=st.sampled_from([1, 2, 10]),
    waiting=st.sampled_from([3, 20, 1000]),
    grace=st.sampled_from([0.0, 0.5, 10.0]),
)
# Three answers after 0.2 s.
LEARN: list[Step] = [("work", 0.2, None), *([("call", 1, None), ("wait", 0.3, None)] * 3)]
# No caller has time enough, until the server is quick again. Then as many come as have room.
QUICK_AGAIN: list[Step] = [
    *LEARN,
    ("call", 10, None),
    ("call", 3, 500),
    ("call", 2, 300),
    ("wait", 0.005, None),
    ("work", 0.001, None),
    ("wait", 0.3, None),
    ("call", 15, 2000),
]
# Twice as many callers as are answered leave after 0.3 s. A few stay: they are patient.
LEAVERS: list[Step] = [
    *LEARN,
    ("work", 0.01, None),
    *([("leaving", 10, 300), ("call", 1, None), ("wait", 0.02, None), ("wait", 0.02, None)] * 40),
]
# Some leave so soon that no other has time enough for sure, and then no more come.
IN_DOUBT: list[Step] = [
    *LEARN,
    ("work", 0.01, None),
    *([("leaving", 5, 100), ("leaving", 5, 2000), ("wait", 0.02, None)] * 40),
    *([("wait", 0.1, None)] * 20),
]
# An answer takes nearly as long as they wait, so the window is never full.
SLOW_LEAVERS: list[Step] = [
    *LEARN,
    *([("leaving", 5, 500), ("leaving", 5, 2000), ("wait", 0.3, None)] * 10),
    *([("wait", 0.1, None)] * 20),
    ("call", 10, None),
]
# No caller has time enough, and nothing is out.
PROBE: list[Step] = [*LEARN, ("call", 1, None), ("call", 2, 300), ("call", 2, 500)]


class Model:
    """Watches the decisions of one service.

    Attributes:
        waiting: the numbers of the calls that were made and have neither been sent nor ended.
        since: when each call was made.
        turns: the calls that were let go since a patient one was.
        passed: the numbers of the calls that were passed over before the next decision.
        assigning: whether `Dispatch.assign` runs.
        wrong: what was wrong with decisions. Not raised there, because the library would treat that
            as a send that fails.
    """

    def __init__(self, session: Session, server: SerialServer, limits: Limits) -> None:
        self.session = session
        self.service = session.pool.service(Echo, "/echo", None)
        self.server = server
        self.limits = limits
        self.waiting: set[int] = set()
        self.since: list[float] = []
        self.turns = 0
        self.passed: set[int] = set()
        self.tasks: list[asyncio.Task[None]] = []
        self.numbers = iter(range(1_000_000))
        self.assigning = False
        self.wrong: list[AssertionError] = []

    async def play(self, steps: Sequence[Step]) -> None:
        """Take the steps, and let everything end."""
        for kind, what, timeout in steps:
            if kind in ("call", "retry", "leaving"):
                self.call(kind, what, None if timeout is None else timeout / 1000)
            elif kind == "wait":
                await asyncio.sleep(what)
            elif kind == "work":
                self.server.work = what
            elif self.tasks:
                self.tasks[what % len(self.tasks)].cancel()
            await settle()
            self.check()
        await self.end()

    async def end(self) -> None:
        """Check that everyone who is patient gets a place, and that the overload is over then."""
        async with asyncio.timeout(10 * LONG):
            while self.waiting:
                await asyncio.sleep(0.1)
                await settle()
                self.check()
        # Those that the server has lost from its queue.
        for task in self.tasks:
            task.cancel()
        await asyncio.gather(*self.tasks, return_exceptions=True)
        self.server.worker.spread = None
        await asyncio.sleep(LONG)
        await self.session.call(Echo, "/echo", timeout=self.server.work + 3 * DELAY)

    def call(self, kind: str, count: int, timeout: float | None) -> None:
        for _ in range(count):
            self.tasks.append(asyncio.create_task(self._call(kind, timeout)))

    async def _call(self, kind: str, timeout: float | None) -> None:
        number = next(self.numbers)
        others = set(self.waiting)
        self.waiting.add(number)
        self.since.append(asyncio.get_running_loop().time())
        request, retry = Echo.Request(number), RETRY if kind == "retry" else None
        known, unknown = (None, timeout) if kind == "leaving" else (timeout, None)
        try:
            async with asyncio.timeout(unknown):
                await self.session.call(Echo, "/echo", request, timeout=known, retry=retry)
        except PoolFull:
            # Nothing has happened since.
            with self.noting():
                room = self.limits.waiting + sum(max(0, w.free) for w in self.windows())
                assert len(others) >= room, "refused although there is room"
        except (CallError, TimeoutError):
            pass
        finally:
            self.waiting.discard(number)

    @contextmanager
    def noting(self) -> Iterator[None]:
        """Note an error in this block, so that `check` raises it."""
        try:
            yield
        except AssertionError as error:
            self.wrong.append(error)

    def windows(self) -> list[Window]:
        return [client.window for client in self.service.clients]

    def before_send(self, client: Client, call: Any, now: float) -> None:
        """Check one decision: that this call is sent now."""
        dispatch = client.owner
        assert isinstance(dispatch, Dispatch)
        number = call.request.value
        again = call.newest is not None
        self.waiting.discard(number)
        if not self.assigning:
            assert dispatch.idle, "sent without a look at those that wait"
            return
        others = [waiter for waiter in (*dispatch.queue, *dispatch.passed) if not waiter.gone]
        if again:
            assert now >= dispatch.order.overloaded_until, "sent again in an overload"
            assert left_of(call, now) >= client.window.expected(now), "sent again too late"
        else:
            self.check_order(client, call, others, now)
        self.passed = {number_of(waiter) for waiter in dispatch.passed}

    def check_order(self, client: Client, call: Any, others: list[Any], now: float) -> None:
        """Check that none of these callers should have been sent instead."""
        needed = client.window.expected(now)
        earlier = [other for other in others if number_of(other) < number_of(call)]
        fresh = [other for other in others if self.is_fresh(other, needed, now)]
        if self.is_fresh(call, needed, now):
            assert not any(self.is_fresh(other, needed, now) for other in earlier), "overtaken"
            # Not those that this decision has passed over.
            before = [other for other in others if number_of(other) in self.passed]
            patient = any(self.is_patient(other, needed, now) for other in before)
            assert not (patient and self.turns >= TURNS - 1), "a patient caller had its turn"
            self.turns += 1
        elif self.is_patient(call, needed, now):
            assert not any(self.is_patient(other, needed, now) for other in earlier), "overtaken"
            assert not fresh or self.turns >= TURNS - 1, "not the turn of a patient caller"
            self.turns = 0
        else:
            assert not fresh, "others are answered in time"
            assert not any(self.is_patient(other, needed, now) for other in others), "others stay"
            later = [other for other in others if self.may_stay(other, needed, now)]
            if self.may_stay(call, needed, now):
                assert all(number_of(other) < number_of(call) for other in later), "not the last"
                return
            # The one that finds out how quick the server is.
            assert not later, "others may be answered in time"
            assert all(window.idle for window in self.windows()), "sent too late"
            ends = self.ends_at(call, now)
            assert all(self.ends_at(other, now) <= ends for other in others), "others wait longer"

    # What a caller is, if its request would be answered after `needed` seconds.

    def is_fresh(self, waiter: Any, needed: float, now: float) -> bool:
        """Return whether it is answered in time."""
        return self.ends_at(waiter, now) - now >= needed

    def is_patient(self, waiter: Any, needed: float, now: float) -> bool:
        """Return whether it has waited for longer than those that left, and is not late."""
        _, long = self.patience(now)
        return left_of(waiter, now) >= needed and now - self.since[number_of(waiter)] > long

    def may_stay(self, waiter: Any, needed: float, now: float) -> bool:
        """Return whether it may be answered in time, as those that come next."""
        short, long = self.patience(now)
        left = min(left_of(waiter, now), self.since[number_of(waiter)] + long - now)
        return short < math.inf and needed <= short and left >= needed

    def ends_at(self, waiter: Any, now: float) -> float:
        """Return until when it waits, as far as is known."""
        short, _ = self.patience(now)
        return min(now + left_of(waiter, now), self.since[number_of(waiter)] + short)

    def patience(self, now: float) -> tuple[float, float]:
        dispatch = next(iter(self.service.clients)).owner
        assert isinstance(dispatch, Dispatch)
        return dispatch.order.patience.waits(now)

    def check(self) -> None:
        """Raise what was wrong, and check that no caller waits for a place that is free."""
        check_places(self.service, self.limits)
        with self.noting():
            self.check_waiting()
        if self.wrong:
            raise self.wrong[0]

    def check_waiting(self, assigned: bool = False) -> None:
        """Check that nobody waits for a free place of a client that was ever matched.

        Args:
            assigned: whether this is right after an assignment, before callers become patient.
        """
        clients = [client for client in self.service.clients if client.matched_generation >= 0]
        free = [client for client in clients if client.window.free > 0]
        if not free:
            return
        dispatch, window = free[0].owner, free[0].window
        assert isinstance(dispatch, Dispatch)
        assert all(waiter.gone for waiter in dispatch.queue), "waits although there is room"
        now = asyncio.get_running_loop().time()
        needed = window.expected(now)
        passed = [waiter for waiter in dispatch.passed if not waiter.gone]
        assert not any(self.is_fresh(waiter, needed, now) for waiter in passed), "passed over"
        if assigned:
            assert not any(self.is_patient(waiter, needed, now) for waiter in passed), "not served"
            assert not any(self.may_stay(waiter, needed, now) for waiter in passed), "not tried"
        silent = all(each.idle for each in self.windows())
        assert not (passed and silent), "nobody finds out how quick the server is"


def left_of(waiter: Any, now: float) -> float:
    return math.inf if waiter.deadline is None else waiter.deadline - now


def number_of(waiter: Any) -> int:
    number = waiter.request.value
    assert isinstance(number, int)
    return number


async def settle() -> None:
    """Let everything happen that needs no time."""
    for _ in range(10):
        await asyncio.sleep(0)


@pytest.fixture(scope="module")
def watched() -> Iterator[list[Model]]:
    """The model that watches the decisions, if there is one."""
    models: list[Model] = []
    send, assign = Client.send, Dispatch.assign

    def watched_send(client: Client, call: Any, now: float) -> Any:
        with models[-1].noting():
            models[-1].before_send(client, call, now)
        return send(client, call, now)

    def watched_assign(dispatch: Dispatch) -> None:
        models[-1].passed = {number_of(waiter) for waiter in dispatch.passed}
        models[-1].assigning = True
        assign(dispatch)
        models[-1].assigning = False
        with models[-1].noting():
            models[-1].check_waiting(assigned=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Client, "send", watched_send)
        patch.setattr(Dispatch, "assign", watched_assign)
        yield models


@settings(deadline=None, max_examples=120, derandomize=True)
@given(steps=st.lists(STEPS, min_size=3, max_size=30), limits=LIMITS, spread=st.booleans())
@example(steps=QUICK_AGAIN, limits=Limits(waiting=5), spread=False)
@example(steps=PROBE, limits=Limits(in_flight=1), spread=False)
@example(steps=LEAVERS, limits=Limits(), spread=False)
@example(steps=IN_DOUBT, limits=Limits(), spread=False)
@example(steps=SLOW_LEAVERS, limits=Limits(grace=0.5), spread=True)
def test_any_overload(
    watched: list[Model], steps: list[Step], limits: Limits, spread: bool
) -> None:
    loop = VirtualLoop()

    async def run() -> None:
        graph = FakeGraph()
        graph.delay = DELAY
        async with graph.session(limits=limits) as session:
            chance = random.Random(1) if spread else None
            server = SerialServer(graph, WORKS[1], spread=chance)
            model = Model(session, server, limits)
            watched[:] = [model]
            await session.wait_for_service(Echo, "/echo")
            await model.play(steps)

    try:
        loop.run_until_complete(run())
    finally:
        loop.close()
