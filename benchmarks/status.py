"""How soon a caller learns that the handler has raised, beside the time of an ordinary answer.

``python -m benchmarks.status`` serves, as a child process of the command.
"""

from __future__ import annotations

import asyncio
import statistics
import time
from collections.abc import Iterable
from typing import Any

from std_srvs.srv import SetBool

import rosasync
from tests.support.child import Child, serve_commands

__all__ = ["TARGET", "measure", "rows"]

NAME = "/status_bench"
TARGET = 0.01
"""Seconds from the raise to the error, at most, by the median."""
PATIENCE = 10.0


def measure(calls: int) -> dict[str, list[float]]:
    """Make calls whose handler raises and calls that are answered, in turn.

    Returns:
        For each kind, the seconds from the handler's end to the caller's resumption.
    """
    with Child("benchmarks.status", quiet=True):
        return asyncio.run(_call(calls))


def rows(found: dict[str, list[float]]) -> Iterable[list[str]]:
    """Yield a row for each kind: median and 99th percentile in ms, and the ratio to an answer."""
    answer = statistics.median(found["answered"])
    for kind, seconds in found.items():
        median, high = statistics.median(seconds), sorted(seconds)[int(0.99 * len(seconds))]
        ratio = f"{median / answer:.2f}"
        yield [kind, f"{len(seconds)}", f"{1e3 * median:.3f}", f"{1e3 * high:.3f}", ratio]


async def _call(calls: int) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {"failed": [], "answered": []}
    async with rosasync.Session("status_bench_client") as session:
        await session.wait_for_service(SetBool, NAME, timeout=PATIENCE)
        # The first reports may come before both sides have found each other's topics.
        await _warm_up(session)
        for _ in range(calls):
            try:
                await session.call(SetBool, NAME, {"data": False}, timeout=PATIENCE)
            except rosasync.HandlerFailed as error:
                found["failed"].append(time.monotonic() - float(error.error_message))
            response = await session.call(SetBool, NAME, {"data": True}, timeout=PATIENCE)
            found["answered"].append(time.monotonic() - float(response.message))
    return found


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
