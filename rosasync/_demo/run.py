"""``rosasync demo``: rosasync compared with threaded ``client.call``, on a stock rclpy server."""

from __future__ import annotations

import asyncio
import io
import json
import math
import platform
import statistics
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING

from rich.bar import Bar
from rich.console import Console, Group
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import rosasync
from rosasync._demo.server import stock_server
from rosasync._ros.domain import isolate

if TYPE_CHECKING:
    from rosasync._demo.stock import ThreadedClient

__all__ = ["DemoError", "Figures", "Report", "run_demo"]

OURS, STOCK = "rosasync", "client.call"
SRV_NAMES = {OURS: "/rosasync_demo/ours", STOCK: "/rosasync_demo/stock"}
"""One name for each contestant: clients of the same name wake each other with their responses."""

AT_ONCE = (1, 10)
ROUNDS = 10
WARM_UP = 20
CALL_TIMEOUT = 3.0
GREETINGS, GREETING_TIMEOUT = 6, 0.5
"""The most attempts at a first call, and seconds for each attempt."""

START_LIMIT = 8.0
"""Seconds for the start."""


class DemoError(Exception):
    """The demo could not be completed; the message says why."""


@dataclass(frozen=True)
class Figures:
    """The measured figures of one contestant."""

    median_us: float
    p99_us: float
    calls_per_s: float
    cpu_us_per_call: float

    def ratios(self, other: Figures) -> dict[str, float]:
        """Return each figure divided by the other's."""
        return {
            "median": self.median_us / other.median_us,
            "p99": self.p99_us / other.p99_us,
            "calls_per_s": self.calls_per_s / other.calls_per_s,
            "cpu_per_call": self.cpu_us_per_call / other.cpu_us_per_call,
        }


@dataclass
class Samples:
    """The calls of one contestant, from all rounds.

    Attributes:
        latencies: seconds for each call.
        wall: seconds for all rounds.
        cpu: CPU seconds that this process used in the rounds, in all threads.
    """

    latencies: list[float] = field(default_factory=list)
    wall: float = 0.0
    cpu: float = 0.0

    @contextmanager
    def measure(self) -> Iterator[None]:
        """Add the time spent in the block to ``wall`` and ``cpu``."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu

    def figures(self) -> Figures:
        """Return the figures; at least one sample is required."""
        calls = len(self.latencies)
        ordered = sorted(self.latencies)
        return Figures(
            median_us=round(1e6 * statistics.median(ordered), 2),
            p99_us=round(1e6 * _percentile_99(ordered), 2),
            calls_per_s=round(calls / self.wall, 2),
            cpu_us_per_call=round(1e6 * self.cpu / calls, 2),
        )


@dataclass(frozen=True)
class Report:
    """The results of the demo, by contestant and number of calls at once."""

    bridge: str
    samples: dict[tuple[str, int], Samples]

    def as_json(self) -> str:
        """Return the figures and ratios as a JSON object."""
        contests = []
        for at_once in AT_ONCE:
            contest: dict[str, object] = {"at_once": at_once}
            for name in (OURS, STOCK):
                samples = self.samples[name, at_once]
                contest[name] = {"calls": len(samples.latencies), **asdict(samples.figures())}
            contests.append({**contest, "ratio": self._ratios(at_once)})
        machine = {"python": platform.python_version(), "platform": platform.platform()}
        return json.dumps({"bridge": self.bridge, **machine, "contests": contests}, indent=2)

    def as_text(self) -> Group:
        """Return the table and the histogram for a rich console."""
        return Group(self._table(), "", self._histogram(), self._legend())

    def _table(self) -> Table:
        table = Table(title="The same service calls, to the same stock rclpy server")
        table.add_column("calls at once", justify="right")
        table.add_column("made with")
        for heading in ("median", "99 %", "calls/s", "CPU per call"):
            table.add_column(heading, justify="right")
        for at_once in AT_ONCE:
            ours, stock = (self.samples[name, at_once].figures() for name in (OURS, STOCK))
            ratios = (f"{ratio:.2f}" for ratio in self._ratios(at_once).values())
            table.add_row(str(at_once), OURS, *_cells(ours), style="bold")
            table.add_row("", STOCK, *_cells(stock))
            table.add_row("", "ratio", *ratios, end_section=True)
        return table

    def _histogram(self) -> Table:
        ours, stock = (self.samples[name, 1].latencies for name in (OURS, STOCK))
        edges = _edges([*ours, *stock], bins=12)
        shares = [_shares(latencies, edges) for latencies in (ours, stock)]
        longest = max(max(column) for column in shares)
        table = Table(title="Latency, one call at a time", box=None)
        table.add_column("from", justify="right")
        for name in (OURS, STOCK):
            table.add_column(name, width=28)
        for edge, *row in zip(edges, *shares, strict=True):
            bars = (Bar(longest, 0, share, width=28) for share in row)
            table.add_row(f"{1e6 * edge:,.0f} µs", *bars)
        return table

    def _ratios(self, at_once: int) -> dict[str, float]:
        ours, stock = (self.samples[name, at_once].figures() for name in (OURS, STOCK))
        return ours.ratios(stock)

    def _legend(self) -> str:
        calls = sum(len(samples.latencies) for samples in self.samples.values())
        return (
            f"\n{calls:,} calls, each with the right response."
            f"\n{OURS}: one session, on the {self.bridge} bridge."
            f"\n{STOCK}: threads, with a SingleThreadedExecutor in another thread."
            "\nCPU: the time of the calling process, in all threads."
            f"\nratio: {OURS} / {STOCK}."
        )


def _cells(figures: Figures) -> tuple[str, ...]:
    return (
        f"{figures.median_us:,.0f} µs",
        f"{figures.p99_us:,.0f} µs",
        f"{figures.calls_per_s:,.0f}",
        f"{figures.cpu_us_per_call:,.0f} µs",
    )


def _percentile_99(ordered: list[float]) -> float:
    return ordered[math.ceil(0.99 * len(ordered)) - 1]


def _edges(latencies: list[float], bins: int) -> list[float]:
    """Return the lower edges of logarithmic bins, up to the 99th percentile."""
    ordered = sorted(latencies)
    low, high = ordered[0], _percentile_99(ordered)
    return [low * (high / low) ** (n / bins) for n in range(bins + 1)]


def _shares(latencies: list[float], edges: list[float]) -> list[float]:
    """Return the share of latencies in each bin; the last bin has no upper edge."""
    ends = [*edges[1:], math.inf]
    return [
        sum(low <= latency < high for latency in latencies) / len(latencies)
        for low, high in zip(edges, ends, strict=True)
    ]


async def run_demo(*, calls: int = 2000, seconds: float = 8.0, as_json: bool = False) -> None:
    """Run the demo and print the results to standard output; progress goes to standard error.

    It moves the process into an unused ROS domain.

    Args:
        calls: number of calls of each contestant one at a time, and again ten at once.
        seconds: seconds to measure at most; if they run out, fewer calls are made.
        as_json: print a JSON object instead of a table and a histogram.

    Raises:
        DemoError: the calls could not be made, or a response was wrong.
    """
    isolate()
    try:
        report = await _run(calls, seconds)
    except ImportError as error:
        raise DemoError(str(error)) from error
    except rosasync.RosasyncError as error:
        raise DemoError(f"{type(error).__name__}: {error}") from error
    except TimeoutError as error:
        raise DemoError(f"timed out: {error or 'the machine may be busy'}") from error
    if as_json:
        print(report.as_json())
        return
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # for terminals without Unicode
    Console(highlight=False).print(report.as_text())


async def _run(calls: int, seconds: float) -> Report:
    async with (
        asyncio.timeout(START_LIMIT + seconds),
        rosasync.Session("rosasync_demo", timeout=CALL_TIMEOUT) as session,
        stock_server(*SRV_NAMES.values()) as ready,
    ):
        if not ready:
            raise DemoError("the server process ended before it was ready")
        from rosasync._demo.stock import Echo

        with _stock_client() as client, ThreadPoolExecutor(max(AT_ONCE)) as threads:
            await session.wait_for_service(Echo, SRV_NAMES[OURS], timeout=START_LIMIT)
            if not await asyncio.to_thread(client.wait_for_service, START_LIMIT):
                raise DemoError(f"{STOCK} did not find the server")
            await _greet(session, client)
            contestants = _Contestants(session, client, threads)
            return Report(session.bridge, await _measure(contestants, calls, seconds))


async def _greet(session: rosasync.Session, client: ThreadedClient) -> None:
    """Make the first calls, with retries: the server may not have discovered the clients yet."""
    from rosasync._demo.stock import Echo, request_for

    greeting = request_for("hello")
    retry = rosasync.Retry(attempts=GREETINGS, after=GREETING_TIMEOUT, backoff=1.0)
    await session.call(Echo, SRV_NAMES[OURS], greeting, retry=retry, timeout=START_LIMIT)
    for _ in range(GREETINGS):
        with suppress(TimeoutError):
            await asyncio.to_thread(client.call, greeting, GREETING_TIMEOUT)
            return
    raise DemoError(f"{STOCK} got no response")


@contextmanager
def _stock_client() -> Iterator[ThreadedClient]:
    from rosasync._demo.stock import ThreadedClient

    client = ThreadedClient(SRV_NAMES[STOCK])
    try:
        yield client
    finally:
        client.close()


@dataclass(frozen=True)
class _Contestants:
    session: rosasync.Session
    client: ThreadedClient
    threads: ThreadPoolExecutor


async def _measure(
    contestants: _Contestants, calls: int, seconds: float
) -> dict[tuple[str, int], Samples]:
    """Alternate between the contestants; each turn gets an equal share of the remaining time."""
    samples = {(name, at_once): Samples() for at_once in AT_ONCE for name in (OURS, STOCK)}
    turns = [turn for _ in range(ROUNDS) for turn in samples]
    end = time.perf_counter() + seconds
    for name, at_once in samples:
        await _take_turn(contestants, name, at_once, WARM_UP, end, Samples())
    with _progress() as progress:
        task = progress.add_task("", total=len(turns))
        for done, (name, at_once) in enumerate(turns):
            progress.update(task, completed=done, description=f"{name}, {at_once} at once")
            progress.refresh()
            now = time.perf_counter()
            until = now + (end - now) / (len(turns) - done)
            await _take_turn(
                contestants, name, at_once, calls // ROUNDS, until, samples[name, at_once]
            )
    return samples


def _progress() -> Progress:
    # Refresh only between turns, because redrawing would be measured too.
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description:24}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        auto_refresh=False,
        transient=True,
        disable=not console.is_terminal,
    )


async def _take_turn(
    contestants: _Contestants, name: str, at_once: int, calls: int, until: float, into: Samples
) -> None:
    """Make the calls with ``at_once`` callers; stop at ``until``, even if calls are left."""
    calls = max(calls, at_once)
    shares = [range(caller, calls, at_once) for caller in range(at_once)]
    turn = _our_turn if name == OURS else _stock_turn
    with into.measure():
        await turn(contestants, shares, until, into.latencies)


async def _our_turn(
    contestants: _Contestants, shares: Iterable[range], until: float, latencies: list[float]
) -> None:
    from rosasync._demo.stock import Echo, answer_of, request_for

    async def caller(numbers: range) -> None:
        for number in numbers:
            start = time.perf_counter()
            request = request_for(str(number))
            response = await contestants.session.call(Echo, SRV_NAMES[OURS], request)
            now = time.perf_counter()
            latencies.append(now - start)
            _check(answer_of(response), str(number))
            if now > until:
                return

    try:
        async with asyncio.TaskGroup() as group:
            for numbers in shares:
                group.create_task(caller(numbers))
    except ExceptionGroup as errors:
        raise errors.exceptions[0] from None


async def _stock_turn(
    contestants: _Contestants, shares: Iterable[range], until: float, latencies: list[float]
) -> None:
    from rosasync._demo.stock import answer_of, request_for

    stop = threading.Event()

    def caller(numbers: range) -> None:
        for number in numbers:
            start = time.perf_counter()
            request = request_for(str(number))
            response = contestants.client.call(request, CALL_TIMEOUT)
            now = time.perf_counter()
            latencies.append(now - start)
            _check(answer_of(response), str(number))
            if now > until or stop.is_set():
                return

    loop = asyncio.get_running_loop()
    try:
        await asyncio.gather(
            *(loop.run_in_executor(contestants.threads, caller, numbers) for numbers in shares)
        )
    finally:
        stop.set()


def _check(answer: str, text: str) -> None:
    if answer != text:
        raise DemoError(f"expected the response {text!r}, got {answer!r}")
