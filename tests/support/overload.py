"""A server in memory that works on one request after another, and callers that ask for too much.

In virtual time, so that the figures do not depend on the machine. `tests.support.overload_table`
prints a table of them.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import random
import selectors
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from typing import Any

from rosasync import CallError, PoolFull, Session
from rosasync.testing._memory.graph import MemoryNode
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.plain import Echo, echo

__all__ = [
    "Case",
    "Outcome",
    "Result",
    "SerialServer",
    "StockCaller",
    "VirtualLoop",
    "keep_calling",
    "offer",
    "simulate",
    "simulate_best",
]

Timeouts = Sequence[float | None]

DELAY = 0.0004
"""Seconds for a request and its response on the way, on one machine."""


class VirtualSelector(selectors.DefaultSelector):
    """Waits for nothing: where a loop would sleep, its clock moves instead."""

    now = 0.0

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0)
        if not ready and timeout:
            self.now += timeout
        return ready


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop in virtual time."""

    def __init__(self) -> None:
        self.clock = VirtualSelector()
        super().__init__(self.clock)

    def time(self) -> float:
        return self.clock.now


class Worker:
    """The work of a server on its requests.

    Attributes:
        work: seconds for each request. With ``spread``, they are distributed exponentially.
        served: the number of requests served.
        busy: seconds of work on them.
    """

    def __init__(self, work: float, spread: random.Random | None = None) -> None:
        self.work = work
        self.spread = spread
        self.served = 0
        self.busy = 0.0

    def begin(self) -> float:
        """Return the seconds for which the next request is worked on."""
        return self.work if self.spread is None else self.spread.expovariate(1 / self.work)

    def end(self, seconds: float) -> None:
        """Count a request that was worked on for so long."""
        self.served += 1
        self.busy += seconds


class SerialServer(FakeServer):
    """Works on one request after another, and queues ten: the next one pushes out the oldest.

    Attributes:
        work: see `Worker`, as for ``served``.
    """

    def __init__(
        self, graph: FakeGraph, work: float, *, spread: random.Random | None = None
    ) -> None:
        super().__init__(graph, Echo, "/echo", echo)
        self.worker = Worker(work, spread)
        self._working = False
        self.enter()

    @property
    def work(self) -> float:
        return self.worker.work

    @work.setter
    def work(self, seconds: float) -> None:
        self.worker.work = seconds

    @property
    def served(self) -> int:
        return self.worker.served

    def receive(self, client: MemoryClient, number: int, request: Any) -> None:
        self._queue.append((client, number, request))
        if len(self._queue) > self.depth:
            self._queue.popleft()
            self.lost += 1
        self._begin()

    def _begin(self) -> None:
        if self._queue and not self._working:
            self._working = True
            seconds = self.worker.begin()
            item = self._queue.popleft()
            asyncio.get_running_loop().call_later(seconds, self._end, seconds, item)

    def _end(self, seconds: float, item: tuple[MemoryClient, int, Any]) -> None:
        client, number, request = item
        self.worker.end(seconds)
        self._working = False
        self.graph.carry_response(client, number, echo(request))
        self._begin()


@dataclass
class Outcome:
    """How calls ended.

    Attributes:
        seconds: how long they were made.
        answered: how many were answered in time.
        errors: how many ended with each error.
    """

    seconds: float = 0.0
    answered: int = 0
    errors: Counter[type[Exception]] = field(default_factory=Counter)

    async def call(self, session: Session, **options: Any) -> None:
        """Make a call and count how it ends."""
        try:
            await session.call(Echo, "/echo", Echo.Request(1), **options)
            self.answered += 1
        except (CallError, PoolFull) as error:
            self.errors[type(error)] += 1


async def keep_calling(session: Session, callers: int, seconds: float, **options: Any) -> Outcome:
    """Have callers that make one call after another for some time."""
    loop = asyncio.get_running_loop()
    outcome, ends = Outcome(seconds), loop.time() + seconds

    async def caller() -> None:
        while loop.time() < ends:
            await outcome.call(session, **options)

    await asyncio.gather(*(caller() for _ in range(callers)))
    return outcome


async def offer(session: Session, rate: float, seconds: float, **options: Any) -> Outcome:
    """Make so many calls a second, whatever becomes of them."""
    outcome, tasks = Outcome(seconds), []
    for _ in range(round(rate * seconds)):
        tasks.append(asyncio.create_task(outcome.call(session, **options)))
        await asyncio.sleep(1 / rate)
    await asyncio.gather(*tasks)
    return outcome


class StockCaller:
    """A stock client: sends every call at once, and forgets it at its deadline."""

    def __init__(self, graph: FakeGraph, outcome: Outcome, value: int = 1) -> None:
        self._value = value
        node = MemoryNode(graph)
        self._loop = asyncio.get_running_loop()
        self._port = node.open_client(node.describe(Echo, "/echo", None), self._deliver)
        self._deadlines: dict[int, float] = {}
        self._outcome = outcome

    async def call(self, timeout: float | None) -> None:
        number = self._port.send(Echo.Request(self._value))
        if timeout is not None:
            self._deadlines[number] = self._loop.time() + timeout

    def _deliver(self, number: int, response: Any) -> None:
        self._outcome.answered += self._loop.time() <= self._deadlines.pop(
            number, self._loop.time()
        )


@dataclass(frozen=True)
class Case:
    """Callers at random times, and a server that works on one request after another.

    Attributes:
        client: ``rosasync``, ``rosasync-leaving`` or ``stock``. Callers that leave do so at their
            timeouts, which their session does not know.
        server: ``rosasync``, ``rosasync-status`` or ``stock``.
        work: seconds for which the server works on a request.
        exponential: whether that is distributed exponentially, and not constant.
        load: of what the server can do, that is offered.
        timeouts: of the calls, in turn.
        processes: how many client processes share the load.
    """

    client: str = "rosasync"
    server: str = "stock"
    work: float = 0.01
    exponential: bool = False
    load: float = 1.5
    timeouts: Timeouts = (0.5,)
    processes: int = 1

    @property
    def seconds(self) -> float:
        """For how long calls are made: for 500 requests, and three of the longest timeouts."""
        return max(500 * self.work, 3 * max(timeout or 0.0 for timeout in self.timeouts))


@dataclass(frozen=True)
class Result:
    """What a case came to, until the last call was made.

    Attributes:
        goodput: the calls answered in time, of what the server could have answered.
        late: the part of the requests that it worked on for callers that had left.
        lost: the requests that were pushed out of its queue.
    """

    goodput: float
    late: float
    lost: int


def simulate(case: Case, *, seed: int = 1, **options: Any) -> Result:
    """Run a case in virtual time; the options are those of the sessions."""
    loop = VirtualLoop()
    try:
        return loop.run_until_complete(_simulate(case, random.Random(seed), options))
    finally:
        loop.close()


async def _simulate(case: Case, choose: random.Random, options: dict[str, Any]) -> Result:
    loop = asyncio.get_running_loop()
    graph = FakeGraph()
    spread = random.Random(choose.random()) if case.exponential else None
    outcome = Outcome(case.seconds)
    async with AsyncExitStack() as stack:
        graph.delay = DELAY
        if case.server == "stock":
            server = SerialServer(graph, case.work, spread=spread)
            worker = server.worker
        else:
            worker = Worker(case.work, spread)
            serving = await stack.enter_async_context(graph.session())
            status = case.server == "rosasync-status"
            serving.serve(Echo, "/echo", _working(worker), concurrency=1, status=status)
        callers: list[Callable[[float | None], Coroutine[Any, Any, None]]] = []
        for _ in range(case.processes):
            if case.client == "stock":
                callers.append(StockCaller(graph, outcome).call)
                continue
            session = await stack.enter_async_context(graph.session(**options))
            await session.wait_for_service(Echo, "/echo")
            leaving = case.client == "rosasync-leaving"
            callers.append((_leaving_caller if leaving else _caller)(session, outcome))
        ends, number, tasks = loop.time() + case.seconds, 0, set()
        while True:
            await asyncio.sleep(choose.expovariate(case.load / case.work))
            if loop.time() >= ends:
                break
            call = callers[number % len(callers)]
            timeout = case.timeouts[number // len(callers) % len(case.timeouts)]
            task = asyncio.create_task(call(timeout))
            tasks.add(task)
            task.add_done_callback(tasks.discard)
            number += 1
        answered = outcome.answered
        for task in tasks:
            task.cancel()
    share = answered / max(1, worker.served)
    return Result(
        goodput=share * worker.busy / case.seconds,
        late=1.0 - share,
        lost=server.lost if case.server == "stock" else 0,
    )


def _caller(session: Session, outcome: Outcome) -> Callable[[float | None], Any]:
    return lambda timeout: outcome.call(session, timeout=timeout)


def _leaving_caller(session: Session, outcome: Outcome) -> Callable[[float | None], Any]:
    async def call(patience: float | None) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(patience):
                await outcome.call(session, timeout=None)

    return call


def simulate_best(case: Case, *, seed: int = 1) -> Result:
    """Run a case with a server that knows its callers, and works for the one with the most time.

    It is a mark to compare with, not a bound: it works for the newest, and a client that waits can
    answer a few more of those that came before.
    """
    choose = random.Random(seed)
    worker = Worker(case.work, random.Random(choose.random()) if case.exponential else None)
    # The deadlines of those that wait, the longest first; None has the most time.
    waiting: list[float] = []
    arrival, number, answered, now = 0.0, 0, 0, 0.0
    while now < case.seconds:
        if not waiting:
            now = max(now, arrival)
        while arrival <= now:
            timeout = case.timeouts[number // case.processes % len(case.timeouts)]
            heapq.heappush(waiting, -math.inf if timeout is None else -(arrival + timeout))
            arrival += choose.expovariate(case.load / case.work)
            number += 1
        deadline = -heapq.heappop(waiting)
        if deadline <= now:
            # The others have even less time.
            waiting.clear()
            continue
        seconds = worker.begin()
        now += seconds
        worker.end(seconds)
        answered += now <= deadline
    share = answered / max(1, worker.served)
    return Result(goodput=share * worker.busy / now, late=1.0 - share, lost=0)


def _working(worker: Worker) -> Any:
    async def handler(request: Any, response: Any) -> Any:
        seconds = worker.begin()
        await asyncio.sleep(seconds)
        worker.end(seconds)
        return Echo.Response(request.value)

    return handler
