"""``rosasync bench``: load on a service, with percentiles as it runs and a histogram at the end."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from typing import Annotated, Any

import typer

from rosasync._cli.graph import find_type, srv_class
from rosasync._cli.histogram import histogram
from rosasync._cli.load import Tally, make_calls
from rosasync._cli.options import AsJson, Name, OptionalType, OptionalYaml
from rosasync._cli.output import console, print_json, progress
from rosasync._cli.requests import message_from, split_type
from rosasync._cli.run import open_session, run

__all__ = ["bench"]

BAR = 40
"""The width of the longest bar."""
LATEST = 2000
"""Calls that the percentiles shown while it runs are of: sorting all would be measured too."""

DISCOVERY = 10.0
"""Seconds to wait for a server."""


def bench(
    name: Name,
    srv_type: OptionalType = None,
    request: OptionalYaml = None,
    callers: Annotated[
        int, typer.Option(min=1, help="Callers; each waits for its response before it calls again.")
    ] = 10,
    rate: Annotated[
        float | None,
        typer.Option(min=0.001, help="Calls per second at most, in all.", show_default=False),
    ] = None,
    duration: Annotated[float, typer.Option(min=0.0, help="Seconds to call.")] = 5.0,
    timeout: Annotated[
        float, typer.Option(min=0.0, help="Seconds after which a call counts as lost.")
    ] = 2.0,
    as_json: AsJson = False,
) -> None:
    """Put load on a service and measure it.

    Shows percentiles and losses while it runs, and a histogram at the end. It makes real calls:
    choose a request that may run often.

    \b
    Examples:
      $ rosasync bench /lamp/switch --duration 1
      $ rosasync bench /lamp/switch '{data: true}' --callers 2 --rate 100 --duration 1 --json
    """
    srv_type, request = split_type(srv_type, request)
    run(_bench(name, srv_type, request, callers, rate, duration, timeout, as_json))


async def _bench(
    name: str,
    srv_type: str | None,
    text: str | None,
    callers: int,
    rate: float | None,
    duration: float,
    timeout: float,
    as_json: bool,
) -> int:
    known = None if srv_type is None else srv_class(srv_type)
    tally = Tally()
    async with open_session(timeout) as session:
        found = known or srv_class(await find_type(session, name, DISCOVERY))
        request = message_from(found.Request, text)
        await session.wait_for_service(found, name, timeout=DISCOVERY)
        try:
            async with progress(lambda: _live(tally, duration)):
                await make_calls(
                    lambda request: session.call(found, name, request),
                    _repeat(request, duration),
                    tally,
                    callers=callers,
                    rate=rate,
                )
        finally:
            _print(tally, as_json)
    return tally.code


async def _repeat(request: Any, duration: float) -> AsyncIterator[Any]:
    end = time.monotonic() + duration
    while time.monotonic() < end:
        yield request


def _live(tally: Tally, duration: float) -> str:
    elapsed = time.perf_counter() - tally.started
    return "\n".join([f"{elapsed:.0f} of {duration:g} s", *tally.lines(LATEST)])


def _print(tally: Tally, as_json: bool) -> None:
    if as_json:
        print_json(tally.figures())
        return
    print("\n".join(tally.lines()))
    if tally.latencies:
        console().print(histogram({"": tally.latencies}, BAR))
