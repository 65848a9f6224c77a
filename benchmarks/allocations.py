"""The memory use of a call and of a request: ``python -m benchmarks allocations``.

The study of rclcpp services asks where a service call allocates. In Python, everything allocates.
So this module measures how much memory an outstanding call holds, how much a call or a request
needs at its peak, and whether any of it stays allocated. Run as a program
(``python -m benchmarks.allocations KIND``), it is the measured process.
"""

from __future__ import annotations

import asyncio
import gc
import sys
import time
import tracemalloc
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from functools import partial
from typing import Any, Literal

from rich.progress import Progress

import rosasync
from benchmarks.contestants.base import spinning
from benchmarks.meter import resident_bytes
from benchmarks.results import Results, Turn
from benchmarks.runner import Scenario
from benchmarks.server import Server, WorkServer
from benchmarks.work import READY_TIMEOUT, Work, load_type, make_request
from tests.support.child import Child, serve_commands

__all__ = ["measure_allocations"]

OUT = 200
"""Number of outstanding calls while their memory is counted; each lasts ``SLOW`` seconds."""
SLOW = 2.0
PEAK_CALLS = 200
WARM = 10_000
CALLS, QUICK_CALLS = 100_000, 20_000
PATIENCE = 300.0

CLIENTS = ("direct", "executor", "call")
"""Their keys; ``call`` is `call_async` for calls at once."""
SERVED = ("rosasync", "rosasync-plain", "stock-async", "stock")

Row = dict[str, float]


class Caller(ABC):
    """Makes calls in the measured process."""

    @abstractmethod
    def call(self, calls: int) -> None:
        """Make this many calls, one at a time."""

    @abstractmethod
    def hold(self, calls: int, look: Callable[[], None]) -> None:
        """Make this many calls at once, call ``look`` meanwhile, and await the calls."""

    @abstractmethod
    def pending(self) -> int:
        """Return the number of requests that have an entry."""


class RosasyncCaller(Caller):
    def __init__(self, bridge: Literal["direct", "executor"], work: Work, stack: ExitStack) -> None:
        self._runner = stack.enter_context(asyncio.Runner())
        self._exits = AsyncExitStack()
        stack.callback(lambda: self._runner.run(self._exits.aclose()))
        self._request = make_request(work)
        self._runner.run(self._open(bridge, work))

    async def _open(self, bridge: Literal["direct", "executor"], work: Work) -> None:
        limits = rosasync.Limits(in_flight=OUT)
        self._session = await self._exits.enter_async_context(
            rosasync.Session("bench", bridge=bridge, limits=limits, timeout=READY_TIMEOUT)
        )
        srv_type = load_type(work.srv_type)
        self._clients = [self._session.client(srv_type, name) for name in work.names]
        for client in self._clients:
            await client.wait(READY_TIMEOUT)

    def call(self, calls: int) -> None:
        self._runner.run(self._call(calls))

    def hold(self, calls: int, look: Callable[[], None]) -> None:
        self._runner.run(self._hold(calls, look))

    def pending(self) -> int:
        node = self._session.node
        statistics = self._session.pool.statistics()
        mine = statistics.in_flight + statistics.abandoned
        return mine + sum(len(client._pending_requests) for client in node.clients)

    async def _call(self, calls: int) -> None:
        for _ in range(calls):
            await self._clients[0].call(self._request)

    async def _hold(self, calls: int, look: Callable[[], None]) -> None:
        out = [self._clients[1].start(self._request) for _ in range(calls)]
        await asyncio.sleep(0)
        assert self._session.pool.statistics().in_flight == calls
        look()
        await asyncio.gather(*out)


class StockCaller(Caller):
    def __init__(self, work: Work, stack: ExitStack) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import QoSProfile

        rclpy.init()
        node = rclpy.create_node("bench")
        srv_type, qos = load_type(work.srv_type), QoSProfile(depth=1000)
        self._clients = [node.create_client(srv_type, n, qos_profile=qos) for n in work.names]
        stack.enter_context(spinning(node, SingleThreadedExecutor()))
        for client in self._clients:
            client.wait_for_service(timeout_sec=READY_TIMEOUT)
        self._request = make_request(work)

    def call(self, calls: int) -> None:
        for _ in range(calls):
            self._clients[0].call(self._request, timeout_sec=READY_TIMEOUT)

    def hold(self, calls: int, look: Callable[[], None]) -> None:
        out = [self._clients[1].call_async(self._request) for _ in range(calls)]
        look()
        while not all(future.done() for future in out):
            time.sleep(SLOW / 10)

    def pending(self) -> int:
        return sum(len(client._pending_requests) for client in self._clients)


CALLERS: dict[str, Callable[[Work, ExitStack], Caller]] = {
    "direct": partial(RosasyncCaller, "direct"),
    "executor": partial(RosasyncCaller, "executor"),
    "call": StockCaller,
}


class Subject:
    """The measured process: a client, or a server that another process calls."""

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._stack = ExitStack()
        self._caller: Caller | None = None

    def setup(self, work: dict[str, Any]) -> None:
        if self._kind in CALLERS:
            self._caller = CALLERS[self._kind](Work.from_json(work), self._stack)
        else:
            server = Server()
            server.serve({**work, "server": self._kind})
            self._stack.callback(server.end)

    def call(self, calls: int) -> None:
        assert self._caller is not None
        self._caller.call(calls)

    def held(self, calls: int) -> Row:
        assert self._caller is not None
        found: Row = {}
        with tracing():
            self._caller.hold(calls, lambda: None)
            before = traced()

            def look() -> None:
                blocks, size = traced()
                found["blocks"] = (blocks - before[0]) / calls
                found["bytes"] = (size - before[1]) / calls

            self._caller.hold(calls, look)
        return found

    def peak_begin(self) -> None:
        tracemalloc.start()

    def peak_rest(self) -> None:
        gc.collect()
        gc.disable()
        self._resting = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()

    def peak_end(self) -> int:
        peak = tracemalloc.get_traced_memory()[1] - self._resting
        tracemalloc.stop()
        gc.enable()
        return peak

    def state(self) -> Row:
        resident = resident_bytes()
        return {
            "resident": resident,
            "blocks": sys.getallocatedblocks(),
            "pending": self._caller.pending() if self._caller else 0,
        }

    def close(self) -> None:
        self._stack.close()


@contextmanager
def tracing() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


def traced() -> tuple[int, int]:
    """Return the blocks and bytes that were allocated since tracing began and not freed."""
    gc.collect()
    traces = tracemalloc.take_snapshot().traces
    return len(traces), sum(trace.size for trace in traces)


def measure_allocations(results: Results, *, quick: bool, rounds: int, progress: Progress) -> None:
    """Measure every client and server, each in its own process, once in each round."""
    calls = QUICK_CALLS if quick else CALLS
    task = progress.add_task("", total=rounds * (len(CLIENTS) + len(SERVED)))
    for number in range(rounds):
        for part, kinds, measure in (
            ("clients", CLIENTS, _measure_client),
            ("servers", SERVED, _measure_server),
        ):
            key = f"allocations, {part}"
            scenario = Scenario(key, key, kinds, action="allocate", metric="peak")
            results.scenarios[key] = scenario.to_json()
            for kind in kinds:
                progress.update(task, description=f"{part}: {kind}")
                name = f"/{part}_{kind.replace('-', '_')}"
                work = Work(server="lean", services=2, delays=(0.0, SLOW), srv_name=name)
                found = measure(kind, work, calls)
                results.turns.append(Turn(key, kind, number, "ok", added=found))
                progress.advance(task)


def _measure_client(kind: str, work: Work, calls: int) -> Row:
    with WorkServer(work), Child("benchmarks.allocations", kind, quiet=True) as client:
        client.ask_now("setup", work=work.to_json())
        call = partial(client.ask_now, "call", patience=PATIENCE)
        held = client.ask_now("held", calls=OUT, patience=PATIENCE)
        return {**held, **_look(client, call, calls)}


def _measure_server(kind: str, work: Work, calls: int) -> Row:
    work = Work(srv_name=work.srv_name)
    with (
        Child("benchmarks.allocations", kind, quiet=True) as server,
        Child("benchmarks.worker", "floor", quiet=True) as one,
    ):
        server.ask_now("setup", work=work.to_json())
        one.ask_now("setup", work=work.to_json())
        call = partial(one.ask_now, "call", callers=1, seconds=PATIENCE, patience=2 * PATIENCE)
        found = _look(server, call, calls)
        one.ask_now("close")
        return found


def _look(subject: Child, call: Callable[..., Any], calls: int) -> Row:
    """Measure the peak of a call, then what stays allocated after many calls."""
    ask = partial(subject.ask_now, patience=PATIENCE)
    call(calls=PEAK_CALLS)
    ask("peak_begin")
    call(calls=PEAK_CALLS)
    ask("peak_rest")
    call(calls=PEAK_CALLS)
    peak: float = ask("peak_end")
    call(calls=WARM)
    before = ask("state")
    call(calls=calls - WARM)
    after = ask("state")
    return {
        "peak": peak,
        "kept_blocks": after["blocks"] - before["blocks"],
        "growth": (after["resident"] - before["resident"]) / 1e6,
        "pending": after["pending"],
    }


def main() -> None:
    subject = Subject(sys.argv[1])
    serve_commands(subject)
    subject.close()


if __name__ == "__main__":
    main()
