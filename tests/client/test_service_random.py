"""One service in the pool, on fake ports: random operations, and what must hold after them."""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rosasync import Limits, Retry, RosasyncError, Session
from rosasync._client import patience, response_times
from rosasync._client.service import ServicePool
from rosasync._core.ports import PortDestroyed
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.places import check_places
from tests.support.times import TICK, until

SHORT = TICK / 10
"""Seconds: many deadlines pass in a run, and as many are met."""


class Echo:
    """A service of plain Python."""

    class Request:
        def __init__(self, value: int | None = None) -> None:
            self.value = value

    class Response:
        def __init__(self, value: int | None = None) -> None:
            self.value = value


class Run:
    """A session, its service's callers and servers, and one step after another."""

    def __init__(self, choose: random.Random) -> None:
        self.choose = choose
        self.limits = Limits(
            clients=choose.choice([1, 1, 2, 8]),
            in_flight=choose.choice([1, 1, 2, 10]),
            waiting=choose.choice([0, 3, 50, 10_000]),
            idle=choose.choice([0.0, SHORT, 4 * SHORT, 300.0]),
            grace=choose.choice([0.0, SHORT, 6 * SHORT, 40 * SHORT]),
            server_depth=choose.choice([1, 10, None]),
        )
        self.graph = FakeGraph(graph_events=choose.random() < 0.6)
        self.faults = contextlib.ExitStack()
        self.servers: list[FakeServer] = []
        self.tasks: dict[asyncio.Task[Any], int] = {}
        self.in_line: set[int] = set()
        self.open_leases = 0
        self.session: Session
        self.service: ServicePool

    def __repr__(self) -> str:
        statistics = self.service.statistics()
        return f"{self.limits}, events: {self.graph.graph_events}, {statistics}, {self.tasks}"

    async def step(self, number: int) -> None:
        """Do one thing at random."""
        choose = self.choose
        kinds = {
            self.start: 45,
            self.call: 10,
            self.lease: 7,
            self.wait: 3,
            self.warm: 1,
            self.cancel: 10,
            self.break_something: 3,
            self.mend: 7,
            self.leave: 2,
            self.come: 2,
            self.destroy: 1,
        }
        (kind,) = choose.choices(list(kinds), list(kinds.values()))
        work = kind(number)
        if work is not None:
            self.tasks[work] = number
        if choose.random() < 0.1:
            await asyncio.sleep(choose.choice([0.0, 0.0, 0.0, SHORT / 5, SHORT, 3 * SHORT]))
        self.check()

    def seconds(self) -> float | None:
        return self.choose.choice([None, 0.0, SHORT / 2, 4 * SHORT])

    def retry(self, often: float) -> Retry | None:
        choose = self.choose
        if choose.random() >= often:
            return None
        attempts, after = choose.choice([1, 2, 3, 10]), choose.choice([0.0, SHORT, 1000.0])
        return Retry(attempts, after, 1.5, choose.choice([0.0, 0.2, math.inf]))

    def start(self, number: int) -> asyncio.Task[Any]:
        wait = self.choose.random() < 0.8
        timeout = self.seconds()
        # Others are passed over if they would be answered too late.
        if wait and timeout is None:
            self.in_line.add(number)
        return self.session.start(
            Echo,
            "/echo",
            Echo.Request(number),
            timeout=timeout,
            wait=wait,
            retry=self.retry(0.3),
        )

    def call(self, number: int) -> asyncio.Task[Any]:
        call = self.session.call(Echo, "/echo", Echo.Request(number), timeout=self.seconds())
        return asyncio.create_task(call)

    def lease(self, number: int) -> asyncio.Task[Any]:
        async def use() -> Any:
            async with self.session.pool.lease(Echo, "/echo", timeout=self.seconds()) as leased:
                self.open_leases += 1
                try:
                    for _ in range(3):
                        await asyncio.sleep(0)
                        response = await leased.call(
                            Echo.Request(number), timeout=4 * SHORT, retry=self.retry(0.5)
                        )
                    # One that outlives the lease, or is cancelled before it ends.
                    late = asyncio.create_task(leased.call(Echo.Request(number), timeout=SHORT))
                    self.tasks[late] = number
                    await asyncio.sleep(0)
                finally:
                    self.open_leases -= 1
            return response

        return asyncio.create_task(use())

    def wait(self, number: int) -> asyncio.Task[Any]:
        wait = self.session.wait_for_service(Echo, "/echo", timeout=self.seconds())
        return asyncio.create_task(wait)

    def warm(self, number: int) -> asyncio.Task[Any]:
        clients = self.choose.randint(1, self.limits.clients)
        return asyncio.create_task(self.session.pool.warm(Echo, "/echo", clients))

    def cancel(self, number: int) -> None:
        if self.tasks:
            self.choose.choice(list(self.tasks)).cancel()

    def break_something(self, number: int) -> None:
        self.faults.close()
        faults = [
            self.graph.drop_requests(),
            self.graph.drop_responses(),
            self.graph.hold_requests(),
            self.graph.delay_responses(SHORT),
        ]
        self.faults.enter_context(self.choose.choice(faults))

    def mend(self, number: int) -> None:
        self.faults.close()

    def leave(self, number: int) -> None:
        if self.servers:
            self.servers.pop(self.choose.randrange(len(self.servers))).close()

    def come(self, number: int) -> None:
        if not self.servers:
            answer: Callable[[Any], Any] = lambda request: Echo.Response(request.value)  # noqa: E731
            self.servers.append(self.graph.serve(Echo, "/echo", answer))

    def destroy(self, number: int) -> None:
        """Destroy a client by other means than the pool's."""
        clients = [client for node in self.graph.nodes for client in node.clients]
        if clients:
            broken: Any = self.choose.choice(clients)
            broken.ready = broken.send = raise_destroyed

    def check(self) -> None:
        """Check what holds at any time, and how tasks have ended."""
        check_places(self.service, self.limits, self.open_leases)
        for task in [task for task in self.tasks if task.done()]:
            number = self.tasks.pop(task)
            if task.cancelled():
                continue
            error = task.exception()
            assert error is None or isinstance(error, RosasyncError)
            response = None if error else task.result()
            # True is the result of a wait for the service.
            assert response in (None, True) or response.value == number

    async def end(self) -> None:
        """Have every call end, and check that nothing is left."""
        self.faults.close()
        self.come(0)

        def ended() -> bool:
            self.check()
            # Lost requests of calls without a deadline; the servers hold nothing back any more.
            for client in self.service.clients:
                for sent in client.window.sent.values():
                    if sent.call is not None:
                        sent.call.future.cancel()
            return not self.tasks and not self.service.is_busy

        await until(ended)
        for client in self.service.clients:
            assert client.window.leases == client.window.taken == 0
        statistics = self.service.statistics()
        assert (statistics.in_flight, statistics.abandoned, statistics.waiting) == (0, 0, 0)


def raise_destroyed(*_: object) -> Any:
    raise PortDestroyed("destroyed")


@contextlib.asynccontextmanager
async def running(seed: int) -> AsyncIterator[Run]:
    run = Run(random.Random(seed))
    async with run.graph.session(limits=run.limits, timeout=None) as run.session:
        run.service = run.session.pool.service(Echo, "/echo", None)
        run.come(0)
        yield run


@pytest.fixture
async def timers(monkeypatch: pytest.MonkeyPatch) -> Callable[[], set[str]]:
    """The names of the callbacks of the timers that run."""
    loop = asyncio.get_running_loop()
    call_at = loop.call_at
    handles: dict[asyncio.TimerHandle, str] = {}

    def spy(when: float, callback: Any, *args: Any, **options: Any) -> asyncio.TimerHandle:
        def run(*args: Any) -> None:
            del handles[handle]
            callback(*args)

        handle = call_at(when, run, *args, **options)
        handles[handle] = callback.__qualname__
        return handle

    def pending() -> set[str]:
        return {name for handle, name in handles.items() if not handle.cancelled()}

    monkeypatch.setattr(loop, "call_at", spy)
    return pending


@pytest.mark.parametrize(
    ("seeds", "steps"),
    [
        *((range(n, n + 2), 400) for n in range(0, 6, 2)),
        *(
            pytest.param(range(n, n + 10), 3000, marks=pytest.mark.soak)
            for n in range(100, 150, 10)
        ),
    ],
)
async def test_random_operations_leave_nothing_behind(
    seeds: range,
    steps: int,
    timers: Callable[[], set[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: dict[int, None] = {}
    send = MemoryClient.send

    def record(client: MemoryClient, request: Echo.Request) -> int:
        assert request.value is not None
        sent.setdefault(request.value)
        return send(client, request)

    monkeypatch.setattr(MemoryClient, "send", record)
    monkeypatch.setattr(response_times, "PATIENCE_INITIAL", 2 * SHORT)
    monkeypatch.setattr(response_times, "PATIENCE_MIN", SHORT)
    for seed in seeds:
        # Callers that leave again and again change the order: see test_dispatch_random.
        in_turn = seed % 2 == 0
        monkeypatch.setattr(patience, "INTERVAL", math.inf if in_turn else 0.0)
        sent.clear()
        async with running(seed) as run:
            for number in range(steps):
                await run.step(number)
            await run.end()
            # Nothing polls while nothing is pending; a deadline that was met may still run out.
            await until(lambda: timers() <= {"Clients._evict", "Deadlines._expire"})
        # First come, first served: those who gave up before their turn are not among them.
        in_order = [number for number in sent if number in run.in_line]
        assert not in_turn or in_order == sorted(in_order), seed
        await until(lambda: not timers())
