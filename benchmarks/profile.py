"""Measures how the time of one call is spent, with timestamps along its path."""

from __future__ import annotations

import asyncio
import os
import selectors
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import Context
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeVar, TypeVarTuple

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

import rosasync
from benchmarks.pages import replace_section
from benchmarks.server import WorkServer
from benchmarks.work import CALL_TIMEOUT, READY_TIMEOUT, Work, load_type, make_request

__all__ = ["STAGES", "Profile", "Stage", "profile", "table", "updated"]

T = TypeVar("T")
Args = TypeVarTuple("Args")

WARM_UP = 500
ROUND = 250
"""Calls with and without timestamps alternate in rounds of this many calls."""


@dataclass(frozen=True)
class Stage:
    """What happens between two timestamps, and which part of the system spends the time."""

    whose: str
    what: str


OURS, ASYNCIO, MIDDLEWARE, KERNEL, ASLEEP = "rosasync", "asyncio", "middleware", "kernel", "asleep"

STAGES = {
    ("await", "send"): Stage(OURS, "checks, deadline, lease, future"),
    ("send", "sent"): Stage(MIDDLEWARE, "`send_request`: converts and writes the request"),
    ("sent", "timer"): Stage(OURS, "registers the sequence number"),
    ("timer", "armed"): Stage(ASYNCIO, "the deadline's timer"),
    ("armed", "select"): Stage(ASYNCIO, "the task suspends, the loop checks its timers"),
    ("sent", "select"): Stage(
        ASYNCIO, "the number is registered, the task suspends, the loop checks its timers"
    ),
    ("select", "selected"): Stage(
        ASLEEP, "the server receives, works and responds; the loop wakes up"
    ),
    ("selected", "read"): Stage(ASYNCIO, "the loop calls the reader"),
    ("read", "counted"): Stage(KERNEL, "reads the eventfd"),
    ("counted", "take"): Stage(OURS, "finds the waiting client"),
    ("take", "taken"): Stage(MIDDLEWARE, "`take_response`: takes and converts the response"),
    ("taken", "deliver"): Stage(OURS, "finds the answered request"),
    ("deliver", "delivered"): Stage(OURS, "completes the future, frees the place"),
    ("delivered", "again"): Stage(ASYNCIO, "the reader returns, the loop starts its next turn"),
    ("again", "polled"): Stage(KERNEL, "the loop polls for other events"),
    ("polled", "answer"): Stage(ASYNCIO, "the task wakes up, counts and returns"),
}
"""The stages in order, by the names of the timestamps at both ends."""


@dataclass
class Profile:
    """Medians in µs.

    Attributes:
        stages: the median of each stage, in order.
        stamped: the median of calls with timestamps.
        plain: the median of calls without timestamps.
        calls: number of calls on the most common path.
        off_path: number of calls on other paths, which are ignored.
    """

    stages: dict[Stage, float]
    stamped: float
    plain: float
    calls: int
    off_path: int

    def shares(self) -> dict[str, float]:
        """Return the total time of each part of the system."""
        shares: defaultdict[str, float] = defaultdict(float)
        for stage, median in self.stages.items():
            shares[stage.whose] += median
        return dict(shares)

    @property
    def summary(self) -> str:
        """The totals, in two sentences."""
        shares = ", ".join(f"{whose} {us:.1f} µs" for whose, us in self.shares().items())
        return (
            f"Together: {shares}. A whole call took {self.plain:.1f} µs, and {self.stamped:.1f} "
            f"with the stamps; medians of {self.calls:,} calls."
        )


def table(found: Profile) -> Table:
    """Return the stages as a table for the terminal."""
    table = Table(caption=found.summary, caption_justify="left", box=SIMPLE)
    for column in ("", "whose", "µs"):
        table.add_column(column, justify="right" if column == "µs" else "left")
    for stage, median in found.stages.items():
        table.add_row(stage.what.replace("`", ""), stage.whose, f"{median:.1f}")
    return table


def updated(page: str, found: Profile, machine: dict[str, Any]) -> str:
    """Return a Markdown page with the stages between its marks.

    Raises:
        ValueError: the page does not have the marks.
    """
    rows = "\n".join(f"| {s.what} | {s.whose} | {us:.1f} |" for s, us in found.stages.items())
    where = f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}"
    text = (
        f"| what happens | whose time | µs |\n|---|---|---:|\n{rows}\n\n{found.summary} {where}.\n"
    )
    return replace_section(page, "profile", text)


class Stamps:
    """Records the names and times of the timestamps of a call, in ns, at a small cost."""

    def __init__(self) -> None:
        self.on = False
        self.taken: list[tuple[str, int]] = []

    def add(self, name: str) -> None:
        if self.on:
            self.taken.append((name, time.perf_counter_ns()))

    def around(self, function: Callable[..., T], before: str, after: str) -> Callable[..., T]:
        """Return the function with a timestamp before and after it."""

        def stamped(*args: Any) -> T:
            self.add(before)
            result = function(*args)
            self.add(after)
            return result

        return stamped


class StampedSelector(selectors.EpollSelector):
    """Distinguishes sleeping from polling: after a delivered response, the loop does not sleep."""

    def __init__(self, stamps: Stamps) -> None:
        super().__init__()
        self._stamps = stamps

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        sleeps = timeout is None or timeout > 0
        self._stamps.add("select" if sleeps else "again")
        events = super().select(timeout)
        self._stamps.add("selected" if sleeps else "polled")
        return events


@dataclass
class StampedLoop:
    """Creates loops with timestamps in their selector and timers; not every call sets a timer."""

    stamps: Stamps = field(default_factory=Stamps)

    def __call__(self) -> asyncio.AbstractEventLoop:
        stamps = self.stamps

        class Loop(asyncio.SelectorEventLoop):
            def call_at(
                self,
                when: float,
                callback: Callable[[*Args], object],
                *args: *Args,
                context: Context | None = None,
            ) -> asyncio.TimerHandle:
                stamps.add("timer")
                timer = super().call_at(when, callback, *args, context=context)
                stamps.add("armed")
                return timer

        return Loop(StampedSelector(stamps))


def profile(calls: int) -> Profile:
    """Measure calls, one at a time, on asyncio and the direct bridge, to a bare server."""
    work = Work(server="lean", srv_name="/bench/profile")
    loop_factory = StampedLoop()
    with WorkServer(work), asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(_measure(work, calls, loop_factory.stamps))


async def _measure(work: Work, calls: int, stamps: Stamps) -> Profile:
    plain: list[int] = []
    stamped: list[Sequence[tuple[str, int]]] = []
    request = make_request(work)
    async with rosasync.Session("profile", bridge="direct", timeout=CALL_TIMEOUT) as session:
        client = session.client(load_type(work.srv_type), work.names[0])
        await client.wait(READY_TIMEOUT)
        for _ in range(WARM_UP):
            await client.call(request)
        for number in range(2 * calls):
            if number // ROUND % 2:
                with _stamping(session, stamps):
                    stamps.add("await")
                    await client.call(request)
                    stamps.add("answer")
                stamped.append(tuple(stamps.taken))
                stamps.taken.clear()
            else:
                begin = time.perf_counter_ns()
                await client.call(request)
                plain.append(time.perf_counter_ns() - begin)
    return _summary(stamped, plain)


@contextmanager
def _stamping(session: rosasync.Session, stamps: Stamps) -> Iterator[None]:
    """Add timestamps to the session's one client and its middleware calls, for one call."""
    pool: Any = session.pool
    (service,) = pool._services.values()
    (client,) = service.clients
    port: Any = client._port
    kept = (port.send_request, port._take, port._deliver, os.eventfd_read)
    port.send_request = stamps.around(port.send_request, "send", "sent")
    port._take = stamps.around(port._take, "take", "taken")
    port._deliver = stamps.around(port._deliver, "deliver", "delivered")
    os.eventfd_read = stamps.around(os.eventfd_read, "read", "counted")
    stamps.on = True
    try:
        yield
    finally:
        stamps.on = False
        port.send_request, port._take, port._deliver, os.eventfd_read = kept


def _summary(stamped: list[Sequence[tuple[str, int]]], plain: list[int]) -> Profile:
    """Return the profile of the most common path."""
    paths = Counter(tuple(name for name, _ in stamps) for stamps in stamped)
    path, calls = paths.most_common(1)[0]
    if unknown := set(pairwise(path)) - set(STAGES):
        raise RuntimeError(f"unknown stages {unknown}: update STAGES")
    usual = [stamps for stamps in stamped if tuple(name for name, _ in stamps) == path]
    rows = np.array([[ns for _, ns in stamps] for stamps in usual])
    medians = np.median(np.diff(rows), axis=0) / 1e3
    return Profile(
        {STAGES[pair]: float(us) for pair, us in zip(pairwise(path), medians, strict=True)},
        float(np.median(rows[:, -1] - rows[:, 0])) / 1e3,
        float(np.median(plain)) / 1e3,
        calls,
        len(stamped) - calls,
    )
