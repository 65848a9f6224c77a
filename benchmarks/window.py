"""The window of one session as it moves: other clients come and go, and the server is killed."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure

from benchmarks.server import WorkServer
from benchmarks.work import Work, load_type
from rosasync import CallError, Limits, Session

__all__ = ["Moment", "Story", "draw", "follow"]

WORK = Work(srv_name="/bench/window", handling=0.001)
NAME = WORK.names[0]
CALLERS = 16
TIMEOUT = 1.0
EVERY = 0.02
"""Seconds between two samples."""


@dataclass(frozen=True)
class Moment:
    """One sample, `at` seconds from the start.

    Attributes:
        places: the places that are taken, by requests in flight and by abandoned ones.
        answered: calls answered since the start.
    """

    at: float
    window: int
    places: int
    answered: int


@dataclass
class Story:
    """The samples, and what happened when."""

    moments: list[Moment]
    events: list[tuple[float, str]]


async def follow(pause: float) -> Story:
    """Call a stock server while other clients come and go, and the server is killed and replaced.

    Args:
        pause: seconds between two events.
    """
    srv_type = load_type(WORK.srv_type)
    story = Story([], [])
    async with AsyncExitStack() as stack:
        server = WorkServer(WORK)
        stack.callback(lambda: server.close())
        session = await stack.enter_async_context(
            Session("bench_window", limits=Limits(grace=TIMEOUT))
        )
        await session.wait_for_service(srv_type, NAME, timeout=30.0)

        async def caller() -> None:
            while True:
                with suppress(CallError):
                    await session.call(srv_type, NAME, timeout=TIMEOUT)

        async def sample() -> None:
            while True:
                (found,) = session.pool.statistics().keys.values()
                places = found.in_flight + found.abandoned
                at = time.monotonic() - start
                story.moments.append(Moment(at, found.window, places, found.completed))
                await asyncio.sleep(EVERY)

        async def another(number: int) -> Session:
            other = Session(f"bench_window_{number}")
            await stack.enter_async_context(other)
            await other.pool.warm(srv_type, NAME)
            return other

        async def event(text: str, action: Callable[[], Awaitable[Any]]) -> Any:
            await asyncio.sleep(pause)
            story.events.append((time.monotonic() - start, text))
            return await action()

        start = time.monotonic()
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(work()) for work in (*[caller] * CALLERS, sample)]
            second = await event("a second client", lambda: another(2))
            others = await event(
                "four more", lambda: asyncio.gather(*(another(number) for number in range(3, 7)))
            )
            await event(
                "they leave", lambda: asyncio.gather(*(o.aclose() for o in (second, *others)))
            )
            await event("server killed", lambda: asyncio.to_thread(server.kill))
            server = await event("another starts", lambda: asyncio.to_thread(WorkServer, WORK))
            await asyncio.sleep(pause)
            for task in tasks:
                task.cancel()
    return story


def draw(story: Story) -> Figure:
    """Draw the window, what is taken of it, and the answers per second."""
    figure = Figure(figsize=(9, 4.5), layout="tight")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    at = [moment.at for moment in story.moments]
    above.step(at, [m.places for m in story.moments], where="post", color="C1", linewidth=0.7)
    above.step(at, [m.window for m in story.moments], where="post", color="C0", linewidth=2)
    above.annotate("window", (at[-1], story.moments[-1].window), color="C0", fontsize=9)
    above.annotate("places taken", (at[-1], story.moments[-1].places - 2), color="C1", fontsize=9)
    above.set_ylim(0, 12.5)
    above.set_ylabel("requests")
    span = round(0.2 / EVERY)
    rates = [
        (later.answered - earlier.answered) / (later.at - earlier.at)
        for earlier, later in zip(story.moments, story.moments[span:], strict=False)
    ]
    below.plot(at[span:], rates, color="C2")
    below.set_ylim(bottom=0)
    below.set_ylabel("answers/s")
    below.set_xlabel("seconds")
    for when, text in story.events:
        for axes in (above, below):
            axes.axvline(when, color="0.7", linewidth=0.8)
        above.annotate(text, (when, 11.3), fontsize=8, xytext=(3, 0), textcoords="offset points")
    return figure
