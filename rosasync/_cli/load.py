"""Makes many calls, and counts how they end."""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import rosasync
from rosasync._cli.errors import Code, code_of, code_of_all
from rosasync._cli.histogram import percentile

__all__ = ["Tally", "make_calls", "milliseconds"]


@dataclass
class Tally:
    """How calls have ended.

    Attributes:
        latencies: seconds for each answered call.
        failures: the number of failed calls, by the name of the error.
        codes: the exit codes of the failed calls.
        started: when the first call started, by ``time.perf_counter``.
        ended: when the latest call ended.
    """

    latencies: list[float] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    codes: set[Code] = field(default_factory=set)
    started: float = 0.0
    ended: float = 0.0

    @property
    def answered(self) -> int:
        """The number of answered calls."""
        return len(self.latencies)

    @property
    def failed(self) -> int:
        """The number of failed calls."""
        return self.failures.total()

    @property
    def seconds(self) -> float:
        """Seconds from the first call's start to the latest end."""
        return self.ended - self.started

    @property
    def code(self) -> Code:
        """The exit code: that of the failures if they are all of one kind."""
        return code_of_all(self.codes)

    def start(self) -> None:
        """Start the clock."""
        self.started = self.ended = time.perf_counter()

    def add(self, seconds: float) -> None:
        """Count an answered call."""
        self.latencies.append(seconds)
        self.ended = time.perf_counter()

    def add_failure(self, error: Exception) -> None:
        """Count a failed call."""
        self.failures[type(error).__name__] += 1
        self.codes.add(code_of(error))
        self.ended = time.perf_counter()

    def figures(self, latest: int = 0) -> dict[str, Any]:
        """Return the counts and percentiles, for JSON.

        Args:
            latest: the number of calls that the percentiles are of, the latest ones; 0 for all.
        """
        ordered = sorted(self.latencies[-latest:])
        return {
            "answered": self.answered,
            "failed": dict(self.failures),
            "seconds": round(self.seconds, 3),
            "calls_per_s": round(self.answered / self.seconds, 1) if self.seconds else 0.0,
            "p50_ms": milliseconds(percentile(ordered, 50)),
            "p90_ms": milliseconds(percentile(ordered, 90)),
            "p99_ms": milliseconds(percentile(ordered, 99)),
            "max_ms": milliseconds(percentile(ordered, 100)),
        }

    def lines(self, latest: int = 0) -> list[str]:
        """Return the summary as lines of text; ``latest`` is as for `figures`."""
        shown = self.figures(latest)
        lines = [
            f"{self.answered} answered, {self.failed} failed in {shown['seconds']:g} s "
            f"({shown['calls_per_s']:g} calls/s)"
        ]
        if self.failures:
            kinds = ", ".join(f"{count} {kind}" for kind, count in self.failures.most_common())
            lines.append(f"failed: {kinds}")
        if self.latencies:
            names = ("p50", "p90", "p99", "max")
            lines.append(", ".join(f"{name} {shown[f'{name}_ms']:g} ms" for name in names))
        return lines


def milliseconds(seconds: float | None) -> float | None:
    """Return milliseconds to three places."""
    return None if seconds is None else round(1e3 * seconds, 3)


async def make_calls(
    call: Callable[[Any], Awaitable[Any]],
    requests: AsyncIterator[Any],
    tally: Tally,
    *,
    callers: int = 1,
    rate: float | None = None,
    on_response: Callable[[Any, float], None] = lambda response, seconds: None,
    on_failure: Callable[[Exception], None] = lambda error: None,
) -> None:
    """Call once for each request, until there are no more.

    Args:
        call: makes one call.
        requests: the requests, taken one after the other.
        tally: where to count.
        callers: how many calls run at the same time at most.
        rate: calls to start per second at most, all callers together.
        on_response: called with each response and its seconds.
        on_failure: called with the error of each failed call.
    """
    turn = asyncio.Lock()
    pace = _Pace(rate)

    async def next_request() -> Any:
        async with turn:
            request = await anext(requests)
            await pace.wait()
            return request

    async def caller() -> None:
        while True:
            try:
                request = await next_request()
            except StopAsyncIteration:
                return
            begin = time.perf_counter()
            try:
                response = await call(request)
            except rosasync.RosasyncError as error:
                tally.add_failure(error)
                on_failure(error)
                if isinstance(error, rosasync.SessionClosed | rosasync.ContextShutdown):
                    return
                continue
            seconds = time.perf_counter() - begin
            tally.add(seconds)
            on_response(response, seconds)

    tally.start()
    try:
        async with asyncio.TaskGroup() as group:
            for _ in range(callers):
                group.create_task(caller())
    except* Exception as errors:
        raise errors.exceptions[0] from None


class _Pace:
    """Lets at most ``rate`` requests a second pass, and does not catch up after a delay."""

    def __init__(self, rate: float | None) -> None:
        self._interval = 1 / rate if rate else 0.0
        self._next = 0.0

    async def wait(self) -> None:
        now = time.monotonic()
        if self._next > now:
            await asyncio.sleep(self._next - now)
        self._next = max(now, self._next) + self._interval
