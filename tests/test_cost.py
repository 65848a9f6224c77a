"""What one call costs, counted and not timed: Python function calls, and objects left behind.

The bounds are a little above what was counted when they were set. A count above its bound means
that every call now does more than it did. Remove what was added, or raise the bound in the same
change if it is worth its price; ``benchmarks profile`` measures that in time.
"""

from __future__ import annotations

import asyncio
import gc
import statistics
import sys
import time
import tracemalloc
from array import array
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import astuple, dataclass, replace
from types import FrameType
from typing import TYPE_CHECKING, Any

import pytest
from test_msgs.action import Fibonacci

import rosasync
from rosasync import ServerGoal, Session
from rosasync._client import graph_watch
from tests.support.echo import ECHO, request_of
from tests.support.serving import echo_call
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.support.fake_graph import FakeGraph

CALLS = 150
BATCHES = 4
WARM_UP = 200
AT_ONCE = 10
Call = Callable[[], Awaitable[object]]
OWN = rosasync.__path__[0]
CHECKS = "<rosasync check of "
"""How the names of the functions that check messages begin, which are compiled at first use."""
TESTING = f"{OWN}/testing/"


class Echo:
    """A service of plain Python."""

    class Request:
        pass

    class Response:
        pass


@dataclass(frozen=True)
class Cost:
    """What one call costs.

    Attributes:
        functions: how often functions of the library are entered. Resuming a coroutine counts too.
        c_functions: how many C functions those call.
        peak: the most bytes in use during the call, above those before it, by tracemalloc.
        left: bytes that stay in use after the call. The lowest of several batches counts, because
            asyncio removes cancelled timers only now and then.
        cycles: objects that only the garbage collector frees.
    """

    functions: float
    c_functions: float
    peak: float
    left: float
    cycles: float

    def __le__(self, bound: Cost) -> bool:
        return all(a <= b for a, b in zip(astuple(self), astuple(bound), strict=True))


FAKE = Cost(functions=17, c_functions=14, peak=2000, left=100, cycles=0)
"""On the fake graph, which keeps the number of every request."""
BOUNDS = {
    "direct": Cost(functions=21, c_functions=18, peak=1700, left=50, cycles=0),
    "executor": Cost(functions=20, c_functions=16, peak=6300, left=50, cycles=0),
}
"""The bytes include rclpy's own, the functions do not."""


MANY_FUNCTIONS, MANY_C_FUNCTIONS = 30, 22
"""What a call enters on the fake graph that waits for its place with many others."""

STATUS = 6
"""How many functions more a server with ``status=True`` enters for a request; its client none."""


@pytest.fixture(autouse=True)
def no_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop the poll that runs twice a second: on a busy machine, it runs beside every few calls."""
    monkeypatch.setattr(graph_watch, "POLL_CONTEXT", 10_000.0)


async def cost_of(call: Call, calls: int = 1) -> Cost:
    """Measure a call, or ``calls`` of them at once; return the medians for one."""
    warm_up, rounds = WARM_UP // calls, CALLS // calls
    for _ in range(warm_up):
        await call()
    functions, c_functions = await _count_functions(call, rounds)
    peak, left, cycles = await _count_memory(call, warm_up, rounds)
    counts = (functions, c_functions, peak, left, cycles)
    return Cost(*(count / calls for count in counts))


async def _count_functions(call: Call, rounds: int) -> tuple[float, float]:
    entered, c_entered = [], []
    counts: Counter[str] = Counter()

    def on_event(frame: FrameType, event: str, arg: Any) -> None:
        name = frame.f_code.co_filename
        if name.startswith((OWN, CHECKS)) and not name.startswith(TESTING):
            counts[event] += 1

    sys.setprofile(on_event)
    try:
        for _ in range(rounds):
            counts.clear()
            await call()
            entered.append(counts["call"])
            c_entered.append(counts["c_call"])
    finally:
        sys.setprofile(None)
    return statistics.median(entered), statistics.median(c_entered)


async def _count_memory(call: Call, warm_up: int, rounds: int) -> tuple[float, float, float]:
    peaks = array("q", bytes(8 * rounds))
    left = []
    gc.collect()
    gc.disable()
    tracemalloc.start()
    try:
        for _ in range(warm_up):
            await call()
        for _ in range(BATCHES):
            start = tracemalloc.get_traced_memory()[0]
            for number in range(rounds):
                tracemalloc.reset_peak()
                before = tracemalloc.get_traced_memory()[0]
                await call()
                peaks[number] = tracemalloc.get_traced_memory()[1] - before
            left.append(tracemalloc.get_traced_memory()[0] - start)
        cycles = gc.collect()
    finally:
        tracemalloc.stop()
        gc.enable()
    return statistics.median(peaks), min(left) / rounds, cycles // (BATCHES * rounds)


async def test_a_call_on_the_fake_graph(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", lambda request: Echo.Response())
    request = Echo.Request()
    async with fake_graph.session() as session:
        client = session.client(Echo, "/echo")
        assert await cost_of(lambda: client.call(request)) <= FAKE
        by_name = replace(FAKE, functions=FAKE.functions + 1)
        assert await cost_of(lambda: session.call(Echo, "/echo", request)) <= by_name


async def test_a_call_one_at_a_time(session: Session, echo: str) -> None:
    request = request_of("x")
    client = session.client(ECHO, echo)
    await client.wait(LIMIT)
    assert await cost_of(lambda: client.call(request)) <= BOUNDS[session.bridge]


async def test_one_of_ten_calls_at_once(session: Session, echo: str) -> None:
    request = request_of("x")
    client = session.client(ECHO, echo)
    await client.wait(LIMIT)

    async def ten() -> None:
        await asyncio.gather(*(client.call(request) for _ in range(AT_ONCE)))

    # On a busy machine the responses come in several batches, and each batch wakes the loop. And
    # sometimes the loop tries to take a response that it has already taken with another one.
    bound = BOUNDS[session.bridge]
    more = replace(bound, functions=bound.functions + 1, c_functions=bound.c_functions + 1)
    assert await cost_of(ten, AT_ONCE) <= more


@pytest.mark.parametrize("callers", [64, 512])
async def test_a_call_beside_many_that_wait(fake_graph: FakeGraph, callers: int) -> None:
    fake_graph.serve(Echo, "/echo", lambda request: Echo.Response())
    request = Echo.Request()
    async with fake_graph.session() as session:
        client = session.client(Echo, "/echo")

        async def many() -> None:
            await asyncio.gather(*(client.call(request) for _ in range(callers)))

        await many()
        functions, c_functions = await _count_functions(many, 3)
    assert functions / callers <= MANY_FUNCTIONS
    assert c_functions / callers <= MANY_C_FUNCTIONS


async def test_a_server_with_status_costs_its_callers_nothing(fake_graph: FakeGraph) -> None:
    request = request_of("x")
    async with fake_graph.session() as server, fake_graph.session() as session:
        server.serve(ECHO, "/plain", echo_call)
        server.serve(ECHO, "/told", echo_call, status=True)
        plain, told = session.client(ECHO, "/plain"), session.client(ECHO, "/told")
        without = await cost_of(lambda: plain.call(request))
        cost = await cost_of(lambda: told.call(request))
        publishers = fake_graph.topics.publishers
        assert any(publisher.topic_name.endswith("/reports") for publisher in publishers)
        assert not any(publisher.kept for publisher in publishers)
    # Both sides are in this process: the server keeps the call until it is answered.
    assert cost.functions <= without.functions + STATUS
    assert cost.left <= without.left + 50
    assert cost.cycles == 0


async def test_what_is_more_is_noticed(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", lambda request: Echo.Response())
    request = Echo.Request()
    kept: list[Any] = []
    async with fake_graph.session() as session:
        client = session.client(Echo, "/echo")

        async def twice() -> None:
            await client.call(request)
            await client.call(request)

        async def kept_call() -> None:
            kept.append([await client.call(request), bytearray(100)])

        async def cyclic_call() -> None:
            cycle: list[Any] = [await client.call(request)]
            cycle.append(cycle)

        assert (await cost_of(twice)).functions == 2 * FAKE.functions
        assert (await cost_of(kept_call)).left > FAKE.left
        assert (await cost_of(cyclic_call)).cycles > FAKE.cycles


@asynccontextmanager
async def goals_that_run(session: Session, server: Session, count: int) -> AsyncIterator[None]:
    """Goals of one session that run on the server of another, with their results asked for."""

    async def handler(goal: ServerGoal[Any, Any]) -> None:
        await asyncio.Event().wait()

    action = server.serve_action(Fibonacci, "/held", handler, concurrency=count)
    tasks = [asyncio.create_task(session.act(Fibonacci, "/held")) for _ in range(count)]
    try:
        # On a loaded machine, some are asked for twice.
        await until(
            lambda: action.statistics().running == count <= action.statistics().asking, 6 * LIMIT
        )
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def check_beside_goals(call: Call, bound: Cost) -> None:
    """Check that a call beside goals that run enters no function for each of them.

    On a busy machine, requests for their results may be sent again for some seconds more.
    """
    # Sometimes a message for a goal arrives together with the response.
    bounds = bound.functions + 2, bound.c_functions + 2
    deadline = time.monotonic() + 2 * LIMIT
    while True:
        functions, c_functions = await _count_functions(call, CALLS)
        if functions <= bounds[0] and c_functions <= bounds[1]:
            return
        assert time.monotonic() < deadline, (functions, c_functions, bounds)
        await asyncio.sleep(TICK)


async def test_a_call_beside_goals_that_run(fake_graph: FakeGraph) -> None:
    fake_graph.serve(Echo, "/echo", lambda request: Echo.Response())
    request = Echo.Request()
    async with fake_graph.session() as server, fake_graph.session() as session:
        client = session.client(Echo, "/echo")
        async with goals_that_run(session, server, 100):
            await check_beside_goals(lambda: client.call(request), FAKE)


@pytest.mark.slow
async def test_a_call_beside_a_thousand_goals(session: Session, echo: str) -> None:
    request = request_of("x")
    client = session.client(ECHO, echo)
    await client.wait(LIMIT)
    async with Session("server") as server, goals_that_run(session, server, 1_000):
        await check_beside_goals(lambda: client.call(request), BOUNDS[session.bridge])
