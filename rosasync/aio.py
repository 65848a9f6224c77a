"""What asyncio lacks: shared deadlines, tasks that start at once, uncancellable waits."""

from __future__ import annotations

import asyncio
import itertools
import math
import sys
import types
from collections.abc import Coroutine, Generator
from heapq import heapify, heappop, heappush
from typing import Any

import anyio

__all__ = ["Deadlines", "Expired", "begin", "until_done"]

SPARE = 64
"""Deadlines that were met and may stay in the heap, beside as many as there are others."""

Entry = list[Any]
"""A deadline, a number that no other has, and the future; put None there when it is met."""


class Expired(Exception):
    """The deadline passed: for the pool to turn into an error that tells the phase."""


class Deadlines:
    """Fails futures with `Expired` at their deadlines. Confined to the loop's thread.

    A timer of the loop for each call is dear, and hardly any call lives to see it run out. So there
    is one, set to the first deadline; a call that is answered leaves it as it is, and the next
    call most often finds it early enough.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._heap: list[Entry] = []
        self._numbers = itertools.count()
        self._most = SPARE
        self._timer: asyncio.TimerHandle | None = None
        self._first = math.inf

    def set(self, future: asyncio.Future[Any], deadline: float) -> Entry:
        """Fail a future at a time of the loop's, unless it is done, or gone from the entry."""
        entry: Entry = [deadline, next(self._numbers), future]
        heap = self._heap
        heappush(heap, entry)
        if len(heap) > self._most:
            self._sweep()
        if deadline < self._first:
            self._arm(deadline)
        return entry

    def close(self) -> None:
        """Forget every future; idempotent."""
        self._heap.clear()
        self._first = math.inf
        if self._timer is not None:
            self._timer.cancel()

    def _sweep(self) -> None:
        self._heap = [entry for entry in self._heap if entry[-1] is not None]
        heapify(self._heap)
        self._most = 2 * len(self._heap) + SPARE

    def _arm(self, deadline: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._first = deadline
        self._timer = self._loop.call_at(deadline, self._expire, deadline)

    def _expire(self, deadline: float) -> None:
        # The loop may call a little early: its clock is coarser than its times.
        now = max(deadline, self._loop.time())
        self._first = math.inf
        heap = self._heap
        while heap and (heap[0][0] <= now or heap[0][-1] is None):
            future = heappop(heap)[-1]
            if future is not None and not future.done():
                future.set_exception(Expired())
        if heap:
            self._arm(heap[0][0])


Work = Coroutine[Any, Any, None]


def begin(loop: asyncio.AbstractEventLoop, work: Work) -> asyncio.Task[None] | None:
    """Run a coroutine up to its first suspension, and the rest of it as a task.

    To be called on the thread of a running loop. To cancel the task, call its ``cancel`` in a
    later turn (``loop.call_soon``): before Python 3.12 it could not be heard in this one.

    Returns:
        The task, or None where there was nothing to wait for.
    """
    if sys.version_info >= (3, 12):
        task = asyncio.Task(work, loop=loop, eager_start=True)
        return None if task.done() else task
    try:
        awaited = work.send(None)
    except StopIteration:
        return None
    return loop.create_task(_resume(work, awaited))


@types.coroutine
def _resume(work: Work, awaited: Any) -> Generator[Any, Any, None]:
    """Go on with a coroutine that waits for what it has yielded already."""
    try:
        while True:
            try:
                value = yield awaited
            except BaseException as error:
                awaited = work.throw(error)
            else:
                awaited = work.send(value)
    except StopIteration:
        return


async def until_done(task: asyncio.Task[None]) -> None:
    """Wait for a task, whatever cancellation comes meanwhile, and pass that on afterwards.

    Raises:
        Exception: what the task raised.
        CancelledError: the caller was cancelled; the task is done all the same.
    """
    cancelled = None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.wait({task})
            except asyncio.CancelledError as error:
                cancelled = error
    if cancelled is not None:
        raise cancelled
    task.result()
