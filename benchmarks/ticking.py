"""Trees whose leaves call services, and the measures of their ticks."""

from __future__ import annotations

import asyncio
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from benchmarks.contestants.base import Tally
from benchmarks.work import CALL_TIMEOUT, Work

__all__ = [
    "Leaf",
    "Stamps",
    "TickTally",
    "Ticked",
    "Ticking",
    "Ticks",
    "call_timeout",
    "drive_in_loop",
    "watch_rclpy",
]

now = time.perf_counter_ns

Ticks: TypeAlias = Iterator[float]
"""Yields after each tick the seconds until the next one."""

PERIOD = 0.001
"""Seconds between two ticks."""

PENDING_TIMEOUT = 120.0
"""Seconds for which a call to a server that does not answer stays pending."""

STOPPED_TIMEOUT = 0.05
"""Seconds for a call to a server that has stopped."""

BATCH = 100
"""Reads of a state for one sample: a single read takes less time than reading the clock."""


class Leaf(Protocol):
    """One leaf of a tree, with one call at a time."""

    def start(self) -> None:
        """Start a call."""

    def look(self) -> bool:
        """Return whether the call was answered; raise its error if it failed."""

    def state(self) -> object:
        """Return the state that `look` reads."""


class Ticking(Protocol):
    """A contestant whose calls are made by the leaves of a tree."""

    def tick(self, measure: str, leaves: int, calls: int, seconds: float) -> TickTally:
        """Take one of the measures of `Ticked`."""


def call_timeout(work: Work) -> float:
    """Return the timeout of a call; calls to a slow server must stay pending."""
    if work.server == "stopped":
        return STOPPED_TIMEOUT
    return PENDING_TIMEOUT if any(work.delays) else CALL_TIMEOUT


@dataclass
class TickTally(Tally):
    """The result of a run of ticks.

    Attributes:
        added: threads and descriptors in use, minus those before the leaves were created.
    """

    added: dict[str, int] = field(default_factory=dict)


@dataclass
class Stamps:
    """When the last request was passed to the middleware, and the last response taken from it."""

    sent: int = 0
    taken: int = 0


def watch_rclpy() -> Stamps:
    """Let every client of this process record when it sends and takes."""
    stamps = Stamps()
    send, take = _rclpy.Client.send_request, _rclpy.Client.take_response

    def send_request(self: Any, request: Any) -> Any:
        number = send(self, request)
        stamps.sent = now()
        return number

    def take_response(self: Any, response_type: Any) -> Any:
        taken = take(self, response_type)
        if taken[0] is not None:
            stamps.taken = now()
        return taken

    _rclpy.Client.send_request = send_request
    _rclpy.Client.take_response = take_response
    return stamps


class Ticked(ABC):
    """The measures, each a generator that yields after each tick.

    - ``tick``: the duration of a tick in which every leaf checks a pending call.
    - ``again``: the duration of a tick in which every leaf checks its call, and starts the next one
      if it has ended.
    - ``state``: the duration of one read of a pending call's state.
    - ``decide``: from a leaf's decision until the middleware has the request.
    - ``see``: from taking the response out of the middleware until a tick sees it, without pauses
      between the ticks.
    - ``rate``: calls of all leaves, each of which starts its next call in the tick that sees the
      response.
    - ``added``: threads and descriptors in use with a pending call in every leaf.
    """

    stamps: Stamps

    @abstractmethod
    def setup(self, work: Work) -> None:
        """Prepare for `work`, and return when its server was found."""

    @abstractmethod
    def leaf(self) -> Leaf:
        """Create a leaf."""

    @abstractmethod
    def close(self) -> None:
        """Destroy everything that `setup` and the leaves created."""

    def tick(self, measure: str, leaves: int, calls: int, seconds: float) -> TickTally:
        return self._run(measure, leaves, calls, seconds, TickTally())

    def pending(self, leaves: Sequence[Leaf]) -> Callable[[], object]:
        """Return a function that ticks these leaves once; each has a pending call."""

        def tick() -> None:
            for leaf in leaves:
                leaf.look()

        return tick

    def drive(self, ticks: Ticks) -> None:
        """Run the ticks on this thread, and sleep in between."""
        for seconds in ticks:
            time.sleep(seconds)

    def _run(
        self, measure: str, leaves: int, calls: int, seconds: float, tally: TickTally
    ) -> TickTally:
        ticks: Ticks = getattr(self, f"_measure_{measure}")(leaves, calls, seconds, tally)
        with tally.timed():
            self.drive(ticks)
        return tally

    def _measure_tick(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        tree = yield from self._all_pending(leaves)
        tick = self.pending(tree)
        until = _until(seconds)
        for _ in range(calls):
            begin = now()
            tick()
            tally.samples.append((end := now()) - begin)
            if end > until:
                return
            yield 0.0

    def _measure_again(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        tree = [self.leaf() for _ in range(leaves)]
        for leaf in tree:
            leaf.start()
        until = _until(seconds)
        for _ in range(calls):
            yield PERIOD
            begin = now()
            for leaf in tree:
                try:
                    ended = leaf.look()
                except Exception:
                    ended = True
                if ended:
                    leaf.start()
            tally.samples.append((end := now()) - begin)
            if end > until:
                return

    def _measure_state(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        (leaf,) = yield from self._all_pending(1)
        look = leaf.state
        until = _until(seconds)
        for _ in range(calls):
            begin = now()
            for _ in range(BATCH):
                look()
            tally.samples.append(((end := now()) - begin) // BATCH)
            if end > until:
                return
            yield 0.0

    def _measure_decide(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        leaf = self.leaf()
        until = _until(seconds)
        for _ in range(calls):
            if (decided := now()) > until:
                return
            leaf.start()
            yield PERIOD
            if (yield from self._ended(leaf, PERIOD, tally)):
                tally.samples.append(self.stamps.sent - decided)

    def _measure_see(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        leaf = self.leaf()
        until = _until(seconds)
        for _ in range(calls):
            if now() > until:
                return
            leaf.start()
            yield 0.0
            if (yield from self._ended(leaf, 0.0, tally)):
                tally.samples.append(now() - self.stamps.taken)

    def _measure_rate(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        until = _until(seconds)
        tree = [self.leaf() for _ in range(leaves)]
        out: dict[Leaf, int] = {}
        started = 0
        while True:
            for leaf in tree:
                if leaf in out:
                    if (ended := _look(leaf, tally)) is None:
                        continue
                    begin = out.pop(leaf)
                    if ended:
                        tally.samples.append(now() - begin)
                if started < calls and (begin := now()) < until:
                    out[leaf] = begin
                    started += 1
                    leaf.start()
            if not out:
                return
            yield PERIOD

    def _measure_added(self, leaves: int, calls: int, seconds: float, tally: TickTally) -> Ticks:
        before = _used()
        yield from self._all_pending(leaves)
        until = _until(seconds)
        most = before
        while now() < until:
            most = tuple(max(pair) for pair in zip(most, _used(), strict=True))
            yield 10 * PERIOD
        threads, descriptors = (m - b for m, b in zip(most, before, strict=True))
        tally.added = {"threads": threads, "descriptors": descriptors}

    def _all_pending(self, leaves: int) -> Generator[float, None, list[Leaf]]:
        tree = [self.leaf() for _ in range(leaves)]
        for leaf in tree:
            leaf.start()
        for _ in range(100):
            yield PERIOD
        if any(leaf.look() for leaf in tree):
            raise RuntimeError("a call that should stay pending was answered")
        return tree

    def _ended(self, leaf: Leaf, period: float, tally: TickTally) -> Generator[float, None, bool]:
        while (ended := _look(leaf, tally)) is None:
            yield period
        return ended


async def drive_in_loop(ticks: Ticks) -> None:
    """Run the ticks, and let the loop run in between."""
    for seconds in ticks:
        await asyncio.sleep(seconds)


def _look(leaf: Leaf, tally: TickTally) -> bool | None:
    """Return whether the call was answered; None while it is pending."""
    try:
        return leaf.look() or None
    except Exception as exc:
        tally.miss(exc)
        return False


def _until(seconds: float) -> int:
    return now() + round(seconds * 1e9)


def _used() -> tuple[int, ...]:
    """Return the numbers of threads and descriptors of this process."""
    return len(os.listdir("/proc/self/task")), len(os.listdir("/proc/self/fd"))
