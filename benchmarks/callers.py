"""Callers that come at their own times, answered or not: ``python -m benchmarks.callers KIND``.

A contestant of the other benchmarks waits for answers before it calls again, so it never offers
more than its server can do. These do.
"""

from __future__ import annotations

import asyncio
import itertools
import random
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from benchmarks.contestants.base import spinning
from benchmarks.work import READY_TIMEOUT, Work, load_type, make_request
from tests.support.child import serve_commands

__all__ = ["KINDS", "Callers"]

Timeouts = Sequence[float | None]
Phases = Sequence[tuple[float, float]]

PATIENCE = 2.0
"""Seconds for which calls without a deadline are awaited at the end."""
ANSWERED = "answered"


class Log:
    """What became of the calls of one run. Its methods may be called on any thread.

    Attributes:
        begin: the start of the run, on the monotonic clock.
    """

    def __init__(self, begin: float) -> None:
        self.begin = begin
        self._lock = threading.Lock()
        self._outcomes: Counter[str] = Counter()
        # When each call began, after `begin`, and its latency if it was answered in time.
        self._calls: list[tuple[float, float | None]] = []

    def note(self, began: float, timeout: float | None, outcome: str) -> None:
        """Note a call that ends now."""
        took = time.monotonic() - began
        in_time = outcome == ANSWERED and (timeout is None or took <= timeout)
        with self._lock:
            self._outcomes[outcome if in_time or outcome != ANSWERED else "late"] += 1
            self._calls.append((began - self.begin, took if in_time else None))

    def to_json(self) -> dict[str, Any]:
        return {"outcomes": dict(self._outcomes), "calls": self._calls}


def arrivals(phases: Phases, seed: int) -> Iterator[float]:
    """Yield the times of Poisson arrivals: phases of a rate and a number of seconds."""
    choose = random.Random(seed)
    start = 0.0
    for rate, seconds in phases:
        at = start + choose.expovariate(rate)
        while at < start + seconds:
            yield at
            at += choose.expovariate(rate)
        start += seconds


class Caller(ABC):
    """One way to call, and to keep to deadlines."""

    @abstractmethod
    def setup(self, work: Work) -> None:
        """Find the server."""

    @abstractmethod
    def offer(self, times: Iterator[float], timeouts: Timeouts, log: Log) -> None:
        """Call at these times, with these timeouts in turn, and wait for the ends of all."""

    @abstractmethod
    def keep(self, callers: int, seconds: float, timeout: float | None, log: Log) -> None:
        """Keep so many callers busy, each of which calls again after its answer or timeout."""

    @abstractmethod
    def close(self) -> None:
        """Destroy what `setup` created."""


class Stock(Caller):
    """Stock rclpy: ``call_async`` to offer, ``client.call`` in threads to keep."""

    def setup(self, work: Work) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        self._node = rclpy.create_node("bench_callers")
        self._client = self._node.create_client(load_type(work.srv_type), work.names[0])
        assert self._client.wait_for_service(READY_TIMEOUT)
        self._request = make_request(work)
        self._stack = ExitStack()
        self._stack.enter_context(spinning(self._node, SingleThreadedExecutor()))

    def offer(self, times: Iterator[float], timeouts: Timeouts, log: Log) -> None:
        pending: dict[Any, tuple[float, float | None]] = {}
        lasting = itertools.cycle(timeouts)
        for at in times:
            time.sleep(max(0.0, log.begin + at - time.monotonic()))
            self._expire(pending, log)
            self._send(pending, next(lasting), log)
        end = time.monotonic() + max(t if t is not None else PATIENCE for t in timeouts)
        while pending and time.monotonic() < end:
            time.sleep(0.01)
            self._expire(pending, log)
        self._expire(pending, log, at_end=True)

    def keep(self, callers: int, seconds: float, timeout: float | None, log: Log) -> None:
        def call() -> None:
            while (began := time.monotonic()) < log.begin + seconds:
                try:
                    answer = self._client.call(self._request, timeout_sec=timeout)
                except TimeoutError:
                    answer = None
                log.note(began, timeout, ANSWERED if answer is not None else "timeout")

        time.sleep(max(0.0, log.begin - time.monotonic()))
        with ThreadPoolExecutor(callers) as threads:
            for future in [threads.submit(call) for _ in range(callers)]:
                future.result()

    def close(self) -> None:
        import rclpy

        self._stack.close()
        rclpy.try_shutdown()

    def _send(
        self, pending: dict[Any, tuple[float, float | None]], timeout: float | None, log: Log
    ) -> None:
        began = time.monotonic()
        future = self._client.call_async(self._request)
        pending[future] = began, timeout

        def done(answered: Any) -> None:
            # On the executor's thread. The first to remove the call counts it.
            if pending.pop(answered, None) is not None:
                log.note(began, timeout, ANSWERED)

        future.add_done_callback(done)

    def _expire(
        self, pending: dict[Any, tuple[float, float | None]], log: Log, *, at_end: bool = False
    ) -> None:
        # The oldest first: `pending` is in the order of sending. With mixed timeouts a short one
        # may be noticed later, which changes nothing: `Log.note` knows its timeout.
        now = time.monotonic()
        for future, (began, timeout) in list(pending.items()):
            if not at_end and (timeout is None or now < began + timeout):
                if timeout is not None:
                    continue
                break
            if pending.pop(future, None) is not None:
                self._client.remove_pending_request(future)
                log.note(began, timeout, "timeout")


class Asyncio(Caller):
    """What the callers in a loop have in common."""

    def setup(self, work: Work) -> None:
        self._runner = asyncio.Runner()
        self._runner.run(self.open(work))

    def close(self) -> None:
        self._runner.run(self.shut())
        self._runner.close()

    def offer(self, times: Iterator[float], timeouts: Timeouts, log: Log) -> None:
        self._runner.run(self._offer(times, timeouts, log))

    def keep(self, callers: int, seconds: float, timeout: float | None, log: Log) -> None:
        self._runner.run(self._keep(callers, seconds, timeout, log))

    @abstractmethod
    async def open(self, work: Work) -> None:
        """Find the server."""

    @abstractmethod
    async def shut(self) -> None:
        """Destroy what `open` created."""

    @abstractmethod
    async def call(self, timeout: float | None) -> None:
        """Make one call; raise an exception if it is not answered."""

    async def _call(self, timeout: float | None, log: Log) -> None:
        began = time.monotonic()
        try:
            await self.call(timeout)
        except Exception as error:
            log.note(began, timeout, type(error).__name__)
        else:
            log.note(began, timeout, ANSWERED)

    async def _offer(self, times: Iterator[float], timeouts: Timeouts, log: Log) -> None:
        lasting = itertools.cycle(timeouts)
        tasks = set()
        for at in times:
            await asyncio.sleep(max(0.0, log.begin + at - time.monotonic()))
            task = asyncio.create_task(self._call(next(lasting), log))
            tasks.add(task)
            task.add_done_callback(tasks.discard)
        longest = max(t if t is not None else PATIENCE for t in timeouts)
        if tasks:
            await asyncio.wait(set(tasks), timeout=longest + PATIENCE)
        for task in set(tasks):
            task.cancel()

    async def _keep(self, callers: int, seconds: float, timeout: float | None, log: Log) -> None:
        async def calling() -> None:
            while time.monotonic() < log.begin + seconds:
                await self._call(timeout, log)

        await asyncio.sleep(max(0.0, log.begin - time.monotonic()))
        await asyncio.gather(*(calling() for _ in range(callers)))


class Rosasync(Asyncio):
    """A rosasync session."""

    async def open(self, work: Work) -> None:
        import rosasync

        self._session = rosasync.Session("bench_callers")
        await self._session.__aenter__()
        self._client = self._session.client(load_type(work.srv_type), work.names[0])
        self._request = make_request(work)
        await self._client.wait(READY_TIMEOUT)

    async def call(self, timeout: float | None) -> None:
        await self._client.call(self._request, timeout=timeout)

    async def shut(self) -> None:
        await self._session.aclose()


class Leaving(Rosasync):
    """The same, with callers that leave at their deadlines, which their session does not know."""

    async def call(self, timeout: float | None) -> None:
        async with asyncio.timeout(timeout):
            await self._client.call(self._request, timeout=None)


class AsyncioForRobotics(Asyncio):
    """asyncio-for-robotics, with the stock depth of ten."""

    async def open(self, work: Work) -> None:
        import asyncio_for_robotics.ros2 as afor

        self._stack = ExitStack()
        session = self._stack.enter_context(afor.auto_context(node="bench_callers"))
        self._client: Any = afor.Client(load_type(work.srv_type), work.names[0], session=session)
        self._request = make_request(work)
        await asyncio.wait_for(self._client.wait_for_service(), READY_TIMEOUT)

    async def call(self, timeout: float | None) -> None:
        await asyncio.wait_for(self._client.call(self._request), timeout)

    async def shut(self) -> None:
        self._stack.close()


KINDS: dict[str, type[Caller]] = {
    "stock": Stock,
    "rosasync": Rosasync,
    "rosasync-leaving": Leaving,
    "afor": AsyncioForRobotics,
}


class Callers:
    """Answers the parent's requests."""

    def __init__(self, kind: str) -> None:
        self._caller = KINDS[kind]()

    def setup(self, work: dict[str, Any]) -> None:
        self._caller.setup(Work.from_json(work))

    def offer(self, phases: Phases, timeouts: Timeouts, seed: int, begin: float) -> dict[str, Any]:
        log = Log(begin)
        self._caller.offer(arrivals(phases, seed), timeouts, log)
        return log.to_json()

    def keep(
        self, callers: int, seconds: float, limit: float | None, begin: float
    ) -> dict[str, Any]:
        log = Log(begin)
        self._caller.keep(callers, seconds, limit, log)
        return log.to_json()

    def close(self) -> None:
        self._caller.close()


if __name__ == "__main__":
    serve_commands(Callers(sys.argv[1]))
