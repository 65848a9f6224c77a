"""``rosasync demo``: rosasync compared with threaded ``client.call``, on two stock servers."""

from __future__ import annotations

import asyncio
import io
import json
import platform
import statistics
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console, Group
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

import rosasync
from rosasync._cli.histogram import histogram, percentile
from rosasync._demo.server import stock_server
from rosasync._ros.domain import isolate

if TYPE_CHECKING:
    from rosasync._demo.stock import ThreadedClient

__all__ = ["DemoError", "Figures", "Report", "run_demo"]

OURS, STOCK = "rosasync", "client.call"
EXECUTOR, BARE = "executor", "bare loop"
"""The servers: rclpy's executor calls a callback for each request; or a loop around one wait set,
whose server is not the limit."""
AT_ONCE = (1, 10)
ROUNDS = 10
WARM_UP = 20
CALL_TIMEOUT = 10.0
GREETINGS, GREETING_TIMEOUT = 30, 0.5
"""The most attempts at a first call, and seconds for each attempt."""

START_LIMIT = 60.0
"""Seconds for the start, on a busy machine."""


class Turn(NamedTuple):
    """What is measured together: the calls of one contestant to one server."""

    server: str
    at_once: int
    contestant: str

    @property
    def srv_name(self) -> str:
        """The service. Clients of the same name would wake each other with their responses."""
        server = "bare" if self.server == BARE else "stock"
        return f"/rosasync_demo/{server}/{'ours' if self.contestant == OURS else 'threads'}"


TURNS = [
    Turn(server, at_once, contestant)
    for server in (EXECUTOR, BARE)
    for at_once in AT_ONCE
    for contestant in (OURS, STOCK)
]


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
            p99_us=round(1e6 * (percentile(ordered, 99) or 0.0), 2),
            calls_per_s=round(calls / self.wall, 2),
            cpu_us_per_call=round(1e6 * self.cpu / calls, 2),
        )


@dataclass(frozen=True)
class Report:
    """The results of the demo, by server, number of calls at once, and contestant."""

    bridge: str
    samples: dict[Turn, Samples]

    def as_json(self) -> str:
        """Return the figures and ratios as a JSON object."""
        machine = {"python": platform.python_version(), "platform": platform.platform()}
        contests = {"contests": self._contests(EXECUTOR), "bare_server": self._contests(BARE)}
        return json.dumps({"bridge": self.bridge, **machine, **contests}, indent=2)

    def as_text(self) -> Group:
        """Return the table and the histogram for a rich console."""
        latencies = {
            name: self.samples[Turn(EXECUTOR, 1, name)].latencies for name in (OURS, STOCK)
        }
        title = "\nLatency of one call at a time, with the executor as server"
        return Group(self._table(), title, histogram(latencies, 24), self._legend())

    def _contests(self, server: str) -> list[dict[str, object]]:
        contests = []
        for at_once in AT_ONCE:
            contest: dict[str, object] = {"at_once": at_once}
            for name in (OURS, STOCK):
                samples = self.samples[Turn(server, at_once, name)]
                contest[name] = {"calls": len(samples.latencies), **asdict(samples.figures())}
            contests.append({**contest, "ratio": self._ratios(server, at_once)})
        return contests

    def _table(self) -> Table:
        table = Table(title="The same service calls, to the same stock rclpy servers")
        table.add_column("server", no_wrap=True)
        table.add_column("at once", justify="right")
        table.add_column("made with", no_wrap=True)
        for heading in ("median", "99 %", "calls/s", "CPU/call"):
            table.add_column(heading, justify="right", no_wrap=True)
        for server in (EXECUTOR, BARE):
            for at_once in AT_ONCE:
                ours, stock = (
                    self.samples[Turn(server, at_once, name)].figures() for name in (OURS, STOCK)
                )
                ratios = (f"{ratio:.2f}" for ratio in self._ratios(server, at_once).values())
                table.add_row(server, str(at_once), OURS, *_cells(ours), style="bold")
                table.add_row("", "", STOCK, *_cells(stock))
                table.add_row("", "", "ratio", *ratios, end_section=True)
        return table

    def _ratios(self, server: str, at_once: int) -> dict[str, float]:
        ours, stock = (
            self.samples[Turn(server, at_once, name)].figures() for name in (OURS, STOCK)
        )
        return ours.ratios(stock)

    def _legend(self) -> str:
        calls = sum(len(samples.latencies) for samples in self.samples.values())
        return (
            f"\n{calls:,} calls, each with the right response."
            f"\n{OURS}: one session, on the {self.bridge} bridge."
            f"\n{STOCK}: threads, with a SingleThreadedExecutor in another thread."
            f"\n{EXECUTOR}: a stock server, with a SingleThreadedExecutor, which is soon the limit."
            f"\n{BARE}: a server that does the least, so that the client is the limit."
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


async def run_demo(*, calls: int = 2000, seconds: float = 8.0, as_json: bool = False) -> None:
    """Run the demo and print the results to standard output; progress goes to standard error.

    It moves the process into an unused ROS domain.

    Args:
        calls: number of calls of each contestant to each server, one at a time and again ten at
            once.
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
        raise DemoError(f"timed out: {str(error) or 'the machine may be busy'}") from error
    if as_json:
        print(report.as_json())
        return
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # for terminals without Unicode
    Console(highlight=False).print(report.as_text())


async def _run(calls: int, seconds: float) -> Report:
    stock_names, bare_names = (
        sorted({turn.srv_name for turn in TURNS if turn.server == server})
        for server in (EXECUTOR, BARE)
    )
    async with (
        asyncio.timeout(START_LIMIT + seconds),
        rosasync.Session("rosasync_demo", timeout=CALL_TIMEOUT) as session,
        AsyncExitStack() as stack,
    ):
        servers = stock_server(*stock_names), stock_server(*bare_names, bare=True)
        # At once, because each takes a second to start.
        if not all(await asyncio.gather(*map(stack.enter_async_context, servers))):
            raise DemoError("the server process ended before it was ready")
        with _Contestants(session) as contestants:
            await contestants.find_servers()
            return Report(session.bridge, await _measure(contestants, calls, seconds))


class _Contestants:
    """The session, and a stock client with its threads for each server."""

    def __init__(self, session: rosasync.Session) -> None:
        self._session = session
        self._threads = ThreadPoolExecutor(max(AT_ONCE))
        self._clients: dict[str, ThreadedClient] = {}

    def __enter__(self) -> _Contestants:
        from rosasync._demo.stock import ThreadedClient

        try:
            for turn in TURNS:
                if turn.contestant == STOCK and turn.srv_name not in self._clients:
                    self._clients[turn.srv_name] = ThreadedClient(turn.srv_name)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self._threads.shutdown()
        for client in self._clients.values():
            client.close()

    async def find_servers(self) -> None:
        """Make the first calls, with retries: a server may not have discovered its clients yet."""
        from rosasync._demo.stock import Echo, request_for

        greeting = request_for("hello")
        retry = rosasync.Retry(attempts=GREETINGS, after=GREETING_TIMEOUT, backoff=1.0)
        for name in {turn.srv_name for turn in TURNS if turn.contestant == OURS}:
            await self._session.call(Echo, name, greeting, retry=retry, timeout=START_LIMIT)
        for client in self._clients.values():
            if not await asyncio.to_thread(client.wait_for_service, START_LIMIT):
                raise DemoError(f"{STOCK} did not find the server")
            await self._greet(client)

    async def _greet(self, client: ThreadedClient) -> None:
        from rosasync._demo.stock import request_for

        for _ in range(GREETINGS):
            with suppress(TimeoutError):
                await asyncio.to_thread(client.call, request_for("hello"), GREETING_TIMEOUT)
                return
        raise DemoError(f"{STOCK} got no response")

    async def call_ours(
        self, turn: Turn, shares: Iterable[range], until: float, latencies: list[float]
    ) -> None:
        """Make the calls of a turn with a task for each share."""
        from rosasync._demo.stock import Echo, answer_of, request_for

        async def caller(numbers: range) -> None:
            for number in numbers:
                start = time.perf_counter()
                request = request_for(str(number))
                response = await self._session.call(Echo, turn.srv_name, request)
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

    async def call_stock(
        self, turn: Turn, shares: Iterable[range], until: float, latencies: list[float]
    ) -> None:
        """Make the calls of a turn with a thread for each share."""
        from rosasync._demo.stock import answer_of, request_for

        client = self._clients[turn.srv_name]
        stop = threading.Event()

        def caller(numbers: range) -> None:
            for number in numbers:
                start = time.perf_counter()
                request = request_for(str(number))
                response = client.call(request, CALL_TIMEOUT)
                now = time.perf_counter()
                latencies.append(now - start)
                _check(answer_of(response), str(number))
                if now > until or stop.is_set():
                    return

        loop = asyncio.get_running_loop()
        try:
            await asyncio.gather(
                *(loop.run_in_executor(self._threads, caller, numbers) for numbers in shares)
            )
        finally:
            stop.set()


async def _measure(contestants: _Contestants, calls: int, seconds: float) -> dict[Turn, Samples]:
    """Alternate between the contestants; each turn gets an equal share of the remaining time."""
    samples = {turn: Samples() for turn in TURNS}
    turns = [turn for _ in range(ROUNDS) for turn in TURNS]
    end = time.perf_counter() + seconds
    for turn in TURNS:
        await _take_turn(contestants, turn, WARM_UP, end, Samples())
    with _progress() as progress:
        task = progress.add_task("", total=len(turns))
        for done, turn in enumerate(turns):
            shown = f"{turn.contestant}, {turn.server}, {turn.at_once} at once"
            progress.update(task, completed=done, description=shown)
            progress.refresh()
            now = time.perf_counter()
            until = now + (end - now) / (len(turns) - done)
            await _take_turn(contestants, turn, calls // ROUNDS, until, samples[turn])
    return samples


def _progress() -> Progress:
    # Refresh only between turns, because redrawing would be measured too.
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description:36}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=console,
        auto_refresh=False,
        transient=True,
        disable=not console.is_terminal,
    )


async def _take_turn(
    contestants: _Contestants, turn: Turn, calls: int, until: float, into: Samples
) -> None:
    """Make the calls, ``turn.at_once`` at once; stop at ``until``, even if calls are left."""
    calls = max(calls, turn.at_once)
    shares = [range(caller, calls, turn.at_once) for caller in range(turn.at_once)]
    call = contestants.call_ours if turn.contestant == OURS else contestants.call_stock
    with into.measure():
        await call(turn, shares, until, into.latencies)


def _check(answer: str, text: str) -> None:
    if answer != text:
        raise DemoError(f"expected the response {text!r}, got {answer!r}")
