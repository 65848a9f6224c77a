"""A trial: calls made under a fault, what became of each, and what was left of them."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import itertools
import os
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from rosasync import Limits, Retry, RosasyncError, Session
from tests.faults.table import MARGIN, Row
from tests.support.checks import count_descriptors, count_threads
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.process import SHARED_MEMORY
from tests.support.times import LIMIT, TICK, until

__all__ = ["PATIENT", "QUICK", "Trial", "resident_megabytes"]

PATIENT = Retry(attempts=1_000, after=4 * TICK, backoff=1)
"""Sends a request again until its deadline."""
QUICK = Limits(grace=2 * TICK)
"""Limits under which the places of abandoned requests come back soon."""

MEGABYTE = 1_000_000


class Trial:
    """Counts the calls that are made through it, and compares the process before and after.

    Args:
        fault: the fault, as the table names it.
        bridge: the bridge of its sessions.

    Attributes:
        growth: the number of megabytes by which the process may grow. Threads of the middleware
            and the allocator's arenas keep some; a leak by each call needs many calls to be seen.
    """

    def __init__(self, fault: str, bridge: Any) -> None:
        self.row = Row(fault, bridge)
        self.bridge = bridge
        self.growth = 50.0
        self.last_error: BaseException | None = None
        self._failed: Counter[str] = Counter()
        self._places = 0
        self._numbers = itertools.count()
        self._out: dict[int, float] = {}
        self._before = _measure()

    @property
    def failed(self) -> Counter[str]:
        """The calls that raised, by the name of the error."""
        return self._failed

    @asynccontextmanager
    async def session(self, **options: Any) -> AsyncIterator[Session]:
        """Open a session; at the end wait until it has nothing outstanding, and count the rest."""
        options = {"bridge": self.bridge, "limits": QUICK, "timeout": LIMIT} | options
        async with Session("trial", **options) as session:
            yield session
            self._places += await _places_left(session)

    async def call(
        self, session: Any, name: str, text: str | None = None, *, timeout: float, **options: Any
    ) -> str:
        """Make one call, and return ``answered`` or the name of the error."""
        number = next(self._numbers)
        text = f"call {number}" if text is None else text
        return await self.count(
            session.call(ECHO, name, request_of(text), timeout=timeout, **options),
            timeout,
            lambda response: answer_to(response) == text,
        )

    async def count(
        self, call: Any, timeout: float, right: Callable[[Any], bool] = lambda _: True
    ) -> str:
        """Await one call and count how it ends."""
        number = next(self._numbers)
        started = time.monotonic()
        self.row.made += 1
        self._out[number] = started + timeout
        try:
            response = await call
        except (RosasyncError, asyncio.CancelledError) as error:
            kind = type(error).__name__
            self._failed[kind] += 1
            self.last_error = error
            if isinstance(error, asyncio.CancelledError):
                raise
            return kind
        finally:
            over = time.monotonic() - self._out.pop(number)
            self.row.late = max(self.row.late, over)
        self.row.answered += right(response)
        self.row.wrong += not right(response)
        return "answered"

    async def calls(self, session: Any, name: str, count: int, **options: Any) -> None:
        """Make calls, all at once."""
        async with asyncio.TaskGroup() as group:
            for _ in range(count):
                group.create_task(self.call(session, name, **options))

    @asynccontextmanager
    async def callers(
        self, session: Any, name: str, count: int, **options: Any
    ) -> AsyncIterator[None]:
        """Have callers make one call after the other in this block."""
        enough = asyncio.Event()

        async def caller() -> None:
            while not enough.is_set():
                if await self.call(session, name, **options) == "ServerGone":
                    # There may be no server for a while.
                    await asyncio.sleep(TICK)

        async with asyncio.TaskGroup() as group:
            for _ in range(count):
                group.create_task(caller())
            try:
                yield
            finally:
                enough.set()

    def answered_since(self, before: int, count: int) -> Callable[[], bool]:
        """Return a condition: so many calls were answered since ``before``."""
        return lambda: self.row.answered - before >= count

    async def more_answers(self, count: int) -> None:
        """Wait until ``count`` more calls are answered."""
        await until(self.answered_since(self.row.answered, count), 2 * LIMIT)

    async def finish(self) -> Row:
        """Wait until the process is as before, as far as it will be, and fill in the row."""
        row = self.row
        row.failed = dict(self._failed)
        try:
            await until(lambda: not self._out, MARGIN)
        except AssertionError:
            row.hung = len(self._out)
        await _settle(self._before)
        after = _measure()
        row.leaked |= {
            kind: max(0, after[kind] - self._before[kind]) for kind in after if kind != "MB"
        }
        row.leaked["places"] = self._places
        if row.leaked["threads"]:
            row.notes.append("threads: " + ", ".join(sorted(_thread_names())))
        if (grown := after["MB"] - self._before["MB"]) > self.growth:
            row.leaked["MB"] = round(grown)
        return row


async def _places_left(session: Session) -> int:
    def left() -> int:
        now = session.pool.statistics()
        return now.in_flight + now.waiting + now.abandoned

    if not session.closed:
        try:
            await until(lambda: not left(), LIMIT)
        except AssertionError:
            return left()
    return 0


async def _settle(before: dict[str, float]) -> None:
    """Wait until what was opened is closed: threads of the middleware end a moment later."""

    def settled() -> bool:
        now = _measure()
        return all(now[kind] <= before[kind] for kind in now if kind != "MB")

    try:
        await until(settled, MARGIN)
    except AssertionError:
        return


def _measure() -> dict[str, float]:
    """Count what a process can leak.

    The threads of the loop's own executor belong to the test. Fast DDS starts that of its log with
    its first message, and keeps it.
    """
    gc.collect()
    own = sum(thread.name.startswith(("asyncio_", "uvloop_")) for thread in threading.enumerate())
    return {
        "threads": count_threads() - own - ("dds.log" in _thread_names()),
        "descriptors": count_descriptors(),
        "tasks": len(asyncio.all_tasks()),
        "shared memory": _shared_memory(),
        "MB": resident_megabytes(),
    }


def _thread_names() -> list[str]:
    """Return the names of this process's threads, as the middleware and Python gave them."""
    python = [thread.name for thread in threading.enumerate()]
    return [*python, *(path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm"))]


def _shared_memory() -> int:
    """Count the shared memory files that this process holds open."""
    links = (os.path.realpath(link) for link in Path("/proc/self/fd").iterdir())
    return sum(link.startswith(str(SHARED_MEMORY)) for link in links)


def resident_megabytes() -> float:
    """Return the memory of this process, without what the allocator could give back."""
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MEGABYTE
