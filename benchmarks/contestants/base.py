"""The interface of every contestant, and the loops that time its calls."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from benchmarks.work import READY_TIMEOUT, Work, load_type, make_handler, make_qos
from tests.support.child import describe

__all__ = [
    "ANSWERED",
    "BREATH",
    "Asynchronous",
    "Blocking",
    "Contestant",
    "LoggedCall",
    "Logging",
    "Mixing",
    "Soaking",
    "Tally",
    "Windowed",
    "answered",
    "make_clients",
    "spinning",
]

now = time.perf_counter_ns

ANSWERED = "answered"

BREATH = 0.005
"""Seconds for calls between two busy periods."""


class LoggedCall(NamedTuple):
    """One call: its begin and end on the monotonic clock, and ``answered`` or its error's name."""

    begin: float
    end: float
    outcome: str


@dataclass
class Tally:
    """The result of a run of calls: times in ns, and the numbers of unanswered calls."""

    samples: list[int] = field(default_factory=list)
    elapsed: int = 0
    lost: int = 0
    failed: int = 0
    error: str = ""
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def miss(self, exc: BaseException) -> None:
        """Count a call that ended with `exc`: as lost if it is a timeout, otherwise as failed."""
        with self._lock:
            if isinstance(exc, TimeoutError):
                self.lost += 1
            else:
                self.failed += 1
                self.error = self.error or describe(exc)

    @contextmanager
    def timed(self) -> Iterator[None]:
        begin = now()
        yield
        self.elapsed = now() - begin


class Contestant(Protocol):
    """One way to call services, in its own process.

    A run ends after `calls` calls, or after `seconds`. Then no new calls are made, but outstanding
    ones are awaited.
    """

    def setup(self, work: Work) -> None:
        """Create the clients for `work`, and return when their servers were found."""

    def one_at_a_time(self, calls: int, seconds: float) -> Tally:
        """Make each call after the previous one is answered."""

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        """Keep as many calls outstanding as there are callers."""

    def rest(self, seconds: float) -> None:
        """Stay ready without calling."""

    def close(self) -> None:
        """Destroy what `setup` created."""


class Soaking(Contestant, Protocol):
    """A contestant that can be checked for leaks."""

    def soak(self, calls: int) -> Tally:
        """Make calls: a third is answered, a third times out, and a third is cancelled."""


class Logging(Contestant, Protocol):
    """A contestant that can tell how every call went."""

    def logged(self, callers: int, seconds: float) -> list[LoggedCall]:
        """Keep calls outstanding as `at_once` does, and return every call that was made."""


class Mixing(Contestant, Protocol):
    """A contestant that can make calls with and without retries in one process."""

    def beside(self, plain: int, retried: int) -> list[tuple[bool, bool]]:
        """Make calls at once; return for each whether it was retried and whether answered."""


class Blocking(ABC):
    """A contestant whose callers are threads, each blocked until its call is answered."""

    services = 1

    @abstractmethod
    def call(self, service: int) -> None:
        """Make one call; raise TimeoutError if there is no answer."""

    def one_at_a_time(self, calls: int, seconds: float) -> Tally:
        tally = Tally()
        with tally.timed():
            self._caller(range(calls), _until(seconds), tally)
        return tally

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        tally = Tally()
        until = _until(seconds)
        threads = [
            threading.Thread(target=self._caller, args=(range(i, calls, callers), until, tally))
            for i in range(callers)
        ]
        with tally.timed():
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        return tally

    def rest(self, seconds: float) -> None:
        time.sleep(seconds)

    def _caller(self, calls: range, until: int, tally: Tally) -> None:
        for i in calls:
            begin = now()
            if begin > until:
                return
            try:
                self.call(i % self.services)
            except Exception as exc:
                tally.miss(exc)
            else:
                tally.samples.append(now() - begin)


class Windowed(ABC):
    """A contestant that starts calls and is notified when they end."""

    services = 1

    @abstractmethod
    def start(self, service: int, over: Callable[[Exception | None], None]) -> None:
        """Start one call, and call `over` from any thread when it has ended."""

    def one_at_a_time(self, calls: int, seconds: float) -> Tally:
        return self.at_once(1, calls, seconds)

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        tally = Tally()
        until = _until(seconds)
        ended: queue.SimpleQueue[tuple[int, Exception | None]] = queue.SimpleQueue()
        started = out = 0
        with tally.timed():
            while True:
                while out < callers and started < calls and (begin := now()) < until:
                    self.start(started % self.services, _report(ended, begin))
                    started += 1
                    out += 1
                if not out:
                    return tally
                begin, exc = ended.get()
                out -= 1
                if exc is None:
                    tally.samples.append(now() - begin)
                else:
                    tally.miss(exc)

    def rest(self, seconds: float) -> None:
        time.sleep(seconds)


class Asynchronous(ABC):
    """A contestant whose callers are asyncio tasks."""

    services = 1
    busy = 0.0
    loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None

    @abstractmethod
    async def open(self, work: Work) -> None: ...

    @abstractmethod
    async def call(self, service: int) -> None:
        """Make one call; raise TimeoutError if there is no answer."""

    @abstractmethod
    async def shut(self) -> None: ...

    def setup(self, work: Work) -> None:
        self.services, self.busy = work.services, work.busy
        self.runner = asyncio.Runner(loop_factory=self.loop_factory)
        self.runner.run(self.open(work))

    def one_at_a_time(self, calls: int, seconds: float) -> Tally:
        return self.runner.run(self._tasks(1, calls, seconds))

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        return self.runner.run(self._tasks(callers, calls, seconds))

    def rest(self, seconds: float) -> None:
        self.runner.run(asyncio.sleep(seconds))

    def close(self) -> None:
        with self.runner:
            self.runner.run(self.shut())

    def logged(self, callers: int, seconds: float) -> list[LoggedCall]:
        return self.runner.run(self._logged(callers, seconds))

    async def _logged(self, callers: int, seconds: float) -> list[LoggedCall]:
        log: list[LoggedCall] = []
        until = time.monotonic() + seconds
        async with asyncio.TaskGroup() as group:
            for _ in range(callers):
                group.create_task(self._log(until, log))
        return log

    async def _log(self, until: float, log: list[LoggedCall]) -> None:
        while (begin := time.monotonic()) < until:
            outcome = ANSWERED
            try:
                await self.call(0)
            except Exception as exc:
                outcome = type(exc).__name__
            log.append(LoggedCall(begin, time.monotonic(), outcome))

    async def _tasks(self, callers: int, calls: int, seconds: float) -> Tally:
        tally = Tally()
        until = _until(seconds)
        with tally.timed():
            other = asyncio.create_task(self._other_work())
            async with asyncio.TaskGroup() as group:
                for i in range(callers):
                    group.create_task(self._caller(range(i, calls, callers), until, tally))
            other.cancel()
        return tally

    async def _other_work(self) -> None:
        """Block the loop, if the work says that it is busy."""
        while self.busy:
            time.sleep(self.busy)  # noqa: ASYNC251
            await asyncio.sleep(BREATH)

    async def _caller(self, calls: range, until: int, tally: Tally) -> None:
        for i in calls:
            begin = now()
            if begin > until:
                return
            try:
                await self.call(i % self.services)
            except Exception as exc:
                tally.miss(exc)
            else:
                tally.samples.append(now() - begin)


def answered(response: object) -> None:
    """Raise TimeoutError if the response is None, as after a timeout of Jazzy's ``client.call``."""
    if response is None:
        raise TimeoutError("no response")


def make_clients(node: Any, work: Work, callback_group: Any = None) -> list[Any]:
    """Create the stock clients and idle clients for `work`, and wait for their servers.

    If the server is ``inside``, it is created on the same node.
    """
    srv_type, qos = load_type(work.srv_type), make_qos(work.depth)
    options = {"qos_profile": qos, "callback_group": callback_group}
    if work.server == "inside":
        for name in work.names:
            node.create_service(srv_type, name, make_handler(work), **options)
    clients = [node.create_client(srv_type, name, **options) for name in work.names]
    for name in work.idle_names:
        node.create_client(srv_type, name, **options)
    for client in clients:
        if not client.wait_for_service(timeout_sec=READY_TIMEOUT):
            raise RuntimeError(f"no server for {client.srv_name}")
    return clients


@contextmanager
def spinning(node: Any, executor: Any) -> Iterator[None]:
    """Spin `node` in a thread; at the end, shut rclpy down and end node and thread."""
    import rclpy

    thread = threading.Thread(target=_spin, args=(executor,), daemon=True)
    executor.add_node(node)
    thread.start()
    try:
        yield
    finally:
        from rosasync._ros import fastdds

        # Otherwise it hung below, twice in about 300 times that four processes ended together.
        fastdds.end_discovery(node)
        rclpy.try_shutdown()
        thread.join()
        executor.shutdown()
        node.destroy_node()


def _spin(executor: Any) -> None:
    from rclpy.executors import ExternalShutdownException

    with suppress(ExternalShutdownException):
        executor.spin()


def _until(seconds: float) -> int:
    return now() + round(seconds * 1e9)


def _report(
    ended: queue.SimpleQueue[tuple[int, Exception | None]], begin: int
) -> Callable[[Exception | None], None]:
    return lambda exc: ended.put((begin, exc))
