"""Additions to asyncio: shared deadlines, tasks that start at once, waits that end in any case."""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import threading
import weakref
from collections.abc import Callable, Coroutine, Generator
from concurrent.futures import Future
from contextlib import suppress
from heapq import heapify, heappop, heappush
from typing import Any, TypeVar

import anyio
from anyio.lowlevel import checkpoint_if_cancelled

from rosasync.errors import RosasyncError

__all__ = ["Deadlines", "Expired", "LoopEnd", "call_in_thread", "start_task", "until_done"]

T = TypeVar("T")

SPARE = 64
"""The heap is swept when it holds twice the entries of the last sweep and this many more."""

Entry = list[Any]
"""A deadline, a unique number and the future. To cancel the deadline, set the future to None. The
entry is dropped later, because a heap cannot remove one from its middle."""


class Expired(Exception):
    """The deadline passed. The pool turns this into an error that names the phase."""


class Deadlines:
    """Fails futures with `Expired` at their deadlines. Confined to the loop's thread.

    A timer of the loop for each call is expensive, and rarely fires. So there is one timer, set to
    the earliest deadline. A call that is answered leaves it running, and it usually serves the next
    call as well.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._heap: list[Entry] = []
        self._numbers = itertools.count()
        self._limit = SPARE
        # Set to `_earliest`. Only an earlier deadline or `close` cancels it.
        self._timer: asyncio.TimerHandle | None = None
        self._earliest = math.inf

    def set(self, future: asyncio.Future[Any], deadline: float) -> Entry:
        """Fail a future at ``deadline``, in loop time, unless it is done or cancelled by then."""
        entry: Entry = [deadline, next(self._numbers), future]
        heap = self._heap
        heappush(heap, entry)
        if len(heap) > self._limit:
            self._sweep()
        if deadline < self._earliest:
            self._arm(deadline)
        return entry

    async def wait(self, future: asyncio.Future[Any], deadline: float | None) -> None:
        """Wait for a future until ``deadline``, in loop time; None for no deadline.

        Raises:
            Expired: the deadline passed.
        """
        entry = None if deadline is None else self.set(future, deadline)
        try:
            await future
        finally:
            if entry is not None:
                entry[-1] = None

    def close(self) -> None:
        """Drop all deadlines; idempotent."""
        self._heap.clear()
        self._earliest = math.inf
        if self._timer is not None:
            self._timer.cancel()

    def _sweep(self) -> None:
        self._heap = [entry for entry in self._heap if entry[-1] is not None]
        heapify(self._heap)
        self._limit = 2 * len(self._heap) + SPARE

    def _arm(self, deadline: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._earliest = deadline
        self._timer = self._loop.call_at(deadline, self._expire, deadline)

    def _expire(self, deadline: float) -> None:
        # The loop runs timers up to one clock resolution early.
        now = max(deadline, self._loop.time())
        self._earliest = math.inf
        heap = self._heap
        while heap and (heap[0][0] <= now or heap[0][-1] is None):
            future = heappop(heap)[-1]
            if future is not None and not future.done():
                future.set_exception(Expired())
        if heap:
            self._arm(heap[0][0])


class LoopEnd:
    """Calls a function when the running loop is closed, on the thread that closes it.

    asyncio has no hook for that. But a loop that is closed drops its readers, so an object to which
    only a reader refers ends with it. A loop without readers never calls the function.

    Args:
        on_end: the function. It must not raise, and must not take a lock.
    """

    def __init__(self, on_end: Callable[[], object]) -> None:
        self._loop = asyncio.get_running_loop()
        # Nothing is written into the pipe.
        self._pipe = os.pipe()
        reader = _Reader()
        self._reader: weakref.ref[_Reader] | None = weakref.ref(reader, lambda _: on_end())
        with suppress(NotImplementedError):
            self._loop.add_reader(self._pipe[0], reader)

    def close(self) -> None:
        """Forget the function; idempotent. From any thread once the loop is closed."""
        if self._reader is None:
            return
        self._reader = None
        with suppress(NotImplementedError, RuntimeError):
            self._loop.remove_reader(self._pipe[0])
        for descriptor in self._pipe:
            os.close(descriptor)


class _Reader:
    """A callback that is never called."""

    def __call__(self) -> None:
        raise AssertionError("the pipe is empty")


def start_task(
    loop: asyncio.AbstractEventLoop, coroutine: Coroutine[Any, Any, T]
) -> asyncio.Task[T]:
    """Run a coroutine up to its first suspension, and the rest as a task.

    Like ``asyncio.Task(…, eager_start=True)``, which Python 3.11 lacks, and which bypasses the task
    factory of the loop. Call it on the thread of the running loop. The coroutine must not use
    ``asyncio.current_task()`` before its first suspension.
    """
    return loop.create_task(_Started(coroutine))


class _Started(Coroutine[Any, Any, T]):
    """A coroutine that has already run up to its first suspension, or to its end.

    It is an object, and not a generator, so that a cancellation before the task's first step
    reaches the coroutine.
    """

    def __init__(self, coroutine: Coroutine[Any, Any, T]) -> None:
        self._coroutine = coroutine
        # asyncio shows this in the repr of a task.
        self.__qualname__ = getattr(coroutine, "__qualname__", repr(coroutine))
        self._awaited: Any = None
        self._outcome: BaseException | None = None
        self._resumed = False
        try:
            self._awaited = coroutine.send(None)
        except (Exception, asyncio.CancelledError) as outcome:
            self._outcome = outcome

    def send(self, value: Any) -> Any:
        """Return what the coroutine is already waiting for; from the second time on, resume it."""
        if self._resumed:
            return self._coroutine.send(value)
        self._resumed = True
        if self._outcome is not None:
            raise self._outcome
        return self._awaited

    def throw(self, *error: Any) -> Any:
        """Raise an exception in the coroutine, or its outcome if it has ended.

        If it ended by an error before the task began, a cancellation comes first: who has cancelled
        the task does not ask for the error, and asyncio would log that it was never retrieved.
        """
        first, self._resumed = not self._resumed, True
        if self._outcome is not None:
            if first and not isinstance(self._outcome, StopIteration):
                raise error[0]
            raise self._outcome
        if first and self._awaited is not None:
            # The task has not seen this future yet, so it cannot cancel it itself.
            self._awaited.cancel()
        return self._coroutine.throw(*error)

    def close(self) -> None:
        """Close the coroutine."""
        self._coroutine.close()

    def __await__(self) -> Generator[Any, Any, T]:
        raise RuntimeError("a started coroutine runs as a task, it cannot be awaited")


async def until_done(task: asyncio.Future[None]) -> None:
    """Wait until a task or future is done, and only then raise a cancellation of the caller.

    Raises:
        Exception: the task raised it.
        CancelledError: the caller was cancelled; the task is done nevertheless.
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


async def call_in_thread(function: Callable[[], T], name: str) -> T:
    """Call a function in a thread of its own, which has ended when this returns or raises.

    The threads of ``asyncio.to_thread`` stay until the loop ends, and may all be busy. A
    cancellation is raised when the function has returned, and its result is dropped.

    Args:
        function: the function. Its exceptions are raised here.
        name: the name of the thread.

    Raises:
        RosasyncError: the process is out of threads.
    """
    loop = asyncio.get_running_loop()
    ended: asyncio.Future[None] = loop.create_future()
    outcome: Future[T] = Future()

    def run() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)
        # The loop may have been closed in the meantime.
        with suppress(RuntimeError):
            loop.call_soon_threadsafe(ended.set_result, None)

    thread = threading.Thread(target=run, name=name)
    try:
        thread.start()
    except RuntimeError as error:
        raise RosasyncError(f"the process is out of threads: {error}") from error
    try:
        await until_done(ended)
    finally:
        # If the loop ends without waiting for its tasks, neither does this.
        if ended.done():
            thread.join()
    # A cancelled scope of anyio was held off by the shield.
    await checkpoint_if_cancelled()
    return outcome.result()
