"""The deadlines of all calls of a session, under one timer of the loop."""

from __future__ import annotations

import asyncio
import itertools
import math
from heapq import heapify, heappop, heappush
from typing import Any

__all__ = ["Deadlines", "Expired"]

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
