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
# Calls at once with one timeout in ms, time that passes, a caller that leaves, and a server that
# becomes slower or quicker.
STEPS = st.one_of(
    CALLS,
    WAITS,
    CALLS,
    WAITS,
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
# No caller has time enough, and nothing is out.
PROBE: list[Step] = [*LEARN, ("call", 1, None), ("call", 2, 300), ("call", 2, 500)]


class Model:
    """Watches the decisions of one service.

    Attributes:
        waiting: the numbers of the calls that were made and have neither been sent nor ended.
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
        self.tasks: list[asyncio.Task[None]] = []
        self.numbers = iter(range(1_000_000))
        self.assigning = False
        self.wrong: list[AssertionError] = []

    async def play(self, steps: Sequence[Step]) -> None:
        """Take the steps, and let everything end."""
        for kind, what, timeout in steps:
            if kind in ("call", "retry"):
                retry = RETRY if kind == "retry" else None
                self.call(what, None if timeout is None else timeout / 1000, retry)
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

    def call(self, count: int, timeout: float | None, retry: Retry | None) -> None:
        for _ in range(count):
            self.tasks.append(asyncio.create_task(self._call(timeout, retry)))

    async def _call(self, timeout: float | None, retry: Retry | None) -> None:
        number = next(self.numbers)
        others = set(self.waiting)
        self.waiting.add(number)
        try:
            request = Echo.Request(number)
            await self.session.call(Echo, "/echo", request, timeout=timeout, retry=retry)
        except PoolFull:
            # Nothing has happened since.
            with self.noting():
                room = self.limits.waiting + sum(max(0, w.free) for w in self.windows())
                assert len(others) >= room, "refused although there is room"
        except CallError:
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
        needed, left = client.window.expected(now), left_of(call, now)
        others = [waiter for waiter in (*dispatch.queue, *dispatch.passed) if not waiter.gone]
        if again:
            assert now >= dispatch.overloaded_until, "sent again in an overload"
            assert left >= needed, "sent again too late"
        elif left >= needed:
            earlier = [other for other in others if number_of(other) < number]
            assert all(left_of(other, now) < needed for other in earlier), "overtaken"
        else:
            # The one that finds out how quick the server is.
            assert all(window.idle for window in self.windows()), "sent too late"
            assert all(left_of(other, now) <= left for other in others), "others have more time"

    def check(self) -> None:
        """Raise what was wrong, and check that no caller waits for a place that is free."""
        check_places(self.service, self.limits)
        with self.noting():
            self.check_waiting()
        if self.wrong:
            raise self.wrong[0]

    def check_waiting(self) -> None:
        """Check that nobody waits for a free place of a client that was ever matched."""
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
        assert all(left_of(waiter, now) < needed for waiter in passed), "passed over without need"
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
        models[-1].assigning = True
        assign(dispatch)
        models[-1].assigning = False
        with models[-1].noting():
            models[-1].check_waiting()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Client, "send", watched_send)
        patch.setattr(Dispatch, "assign", watched_assign)
        yield models


@settings(deadline=None, max_examples=120, derandomize=True)
@given(steps=st.lists(STEPS, min_size=3, max_size=30), limits=LIMITS, spread=st.booleans())
@example(steps=QUICK_AGAIN, limits=Limits(waiting=5), spread=False)
@example(steps=PROBE, limits=Limits(in_flight=1), spread=False)
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
