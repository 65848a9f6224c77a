"""How soon a caller learns that the handler has raised, beside the time of an ordinary answer.

``python -m benchmarks.status`` serves, as a child process of the command.
"""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from std_srvs.srv import SetBool

import rosasync
from benchmarks.pages import markdown_table
from benchmarks.trials import GOALS, Goal, Trials, check
from tests.support.child import Child, serve_commands

__all__ = ["COMMAND", "TARGET", "Times", "goals", "heading", "measure", "rows", "section"]

COMMAND = "status"
NAME = "/status_bench"
TARGET = 0.01
"""Seconds from the raise to the error, at most, by the median."""
PATIENCE = 10.0


@dataclass(frozen=True)
class Times:
    """The calls of one kind.

    Attributes:
        kind: how the handler ended: ``failed`` or ``answered``.
        seconds: for each call, from the handler's end to the caller's resumption.
    """

    kind: str
    seconds: list[float] = field(default_factory=list)

    @property
    def median(self) -> float:
        """The median, in seconds."""
        return statistics.median(self.seconds)


def measure(calls: int, on_times: Callable[[Times], object] = lambda times: None) -> list[Times]:
    """Make calls whose handler raises and calls that are answered, in turn."""
    with Child("benchmarks.status", quiet=True):
        found = asyncio.run(_call(calls))
    for times in found:
        on_times(times)
    return found


heading = ["handler", "calls", "median ms", "99 % ms", "÷ answered"]


def rows(found: Sequence[Times]) -> Iterable[list[str]]:
    """Yield a row for each kind: median and 99th percentile in ms, and the ratio to an answer."""
    (answer,) = (times.median for times in found if times.kind == "answered")
    for times in found:
        high = sorted(times.seconds)[int(0.99 * len(times.seconds))]
        figures = (f"{1e3 * times.median:.3f}", f"{1e3 * high:.3f}", f"{times.median / answer:.2f}")
        yield [times.kind, f"{len(times.seconds):,}", *figures]


def goals(found: Sequence[Times]) -> list[Goal]:
    """Compare the median of the failures with the goal of the documentation."""
    (failed,) = (times.median for times in found if times.kind == "failed")
    return [check("seconds from the raise to the error, median", failed, "<=", TARGET)]


def section(trials: Trials) -> str:
    """Return the section of the documentation's page."""
    found = [Times(**times) for times in trials.rows]
    return "\n".join(
        (
            f"`python -m benchmarks status`. {trials.conditions} One call at a time to a server in "
            "another process, by turns one whose handler raises and one that is answered. The "
            "times are from the end of the handler to the caller's resumption.\n",
            markdown_table(GOALS, [goal.row() for goal in goals(found)]),
            markdown_table(heading, list(rows(found))),
        )
    )


async def _call(calls: int) -> list[Times]:
    failed, answered = Times("failed"), Times("answered")
    async with rosasync.Session("status_bench_client") as session:
        await session.wait_for_service(SetBool, NAME, timeout=PATIENCE)
        # The first reports may come before both sides have found each other's topics.
        await _warm_up(session)
        for _ in range(calls):
            try:
                await session.call(SetBool, NAME, {"data": False}, timeout=PATIENCE)
            except rosasync.HandlerFailed as error:
                failed.seconds.append(time.monotonic() - float(error.error_message))
            response = await session.call(SetBool, NAME, {"data": True}, timeout=PATIENCE)
            answered.seconds.append(time.monotonic() - float(response.message))
    return [failed, answered]


async def _warm_up(session: rosasync.Session) -> None:
    for _ in range(100):
        try:
            await session.call(SetBool, NAME, {"data": False}, timeout=0.1)
        except rosasync.HandlerFailed:
            return
        except rosasync.ResponseTimeout:
            continue


async def _serve() -> None:
    async def handler(call: Any) -> SetBool.Response:
        if call.request.data:
            return SetBool.Response(message=repr(time.monotonic()))
        raise ValueError(time.monotonic())

    async with rosasync.Session("status_bench_server") as session:
        session.serve(SetBool, NAME, handler, status=True)
        await asyncio.to_thread(serve_commands, {})


if __name__ == "__main__":
    asyncio.run(_serve())
