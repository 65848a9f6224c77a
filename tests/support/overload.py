"""A server in memory that works on one request after another, and callers that ask for too much.

In virtual time, so that the figures do not depend on the machine.
"""

from __future__ import annotations

import asyncio
import random
import selectors
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from rosasync import CallError, Session
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.plain import Echo, echo

__all__ = ["Outcome", "SerialServer", "VirtualLoop", "keep_calling", "offer"]


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


class SerialServer(FakeServer):
    """Works on one request after another, and queues ten: the next one pushes out the oldest.

    Attributes:
        work: seconds for each request. With ``spread``, they are distributed exponentially.
        served: the number of requests served.
    """

    def __init__(
        self, graph: FakeGraph, work: float, *, spread: random.Random | None = None
    ) -> None:
        super().__init__(graph, Echo, "/echo", echo)
        self.work = work
        self.served = 0
        self.spread = spread
        self._working = False
        self.enter()

    def receive(self, client: MemoryClient, number: int, request: Any) -> None:
        self._queue.append((client, number, request))
        if len(self._queue) > self.depth:
            self._queue.popleft()
            self.lost += 1
        self._begin()

    def _begin(self) -> None:
        if self._queue and not self._working:
            self._working = True
            seconds = self.work
            if self.spread is not None:
                seconds = self.spread.expovariate(1 / seconds)
            asyncio.get_running_loop().call_later(seconds, self._end, self._queue.popleft())

    def _end(self, item: tuple[MemoryClient, int, Any]) -> None:
        client, number, request = item
        self.served += 1
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
        except CallError as error:
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
