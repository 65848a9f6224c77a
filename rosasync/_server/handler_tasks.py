"""The tasks of a server's handlers, and who waits for them."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable, Coroutine
from contextvars import Context, ContextVar
from typing import Any, Protocol

__all__ = ["HandlerTasks", "Spawn"]


class Spawn(Protocol):
    """`HandlerTasks.spawn`, for what needs nothing else of it."""

    def __call__(
        self, work: Coroutine[Any, Any, None], on_cancelled: Callable[[], object], /
    ) -> object:
        """Run a coroutine in a task."""


_handler_task: ContextVar[asyncio.Task[Any] | None] = ContextVar("handler_task", default=None)
"""The task of the handler, or hook, in whose context the code runs. Tasks that a handler starts
inherit it."""


class HandlerTasks:
    """The tasks of a server's handlers, which its end waits for. Confined to the loop's thread.

    A handler that waits for the end itself, by closing its server or its session, is neither waited
    for nor cancelled: it would deadlock.

    Attributes:
        cancelled: whether the end of the server has cancelled those that were left.
    """

    def __init__(self) -> None:
        self.cancelled = False
        self._loop = asyncio.get_running_loop()
        self._tasks: set[asyncio.Task[None]] = set()
        self._closers: set[asyncio.Task[Any]] = set()
        # Wakes `wait` when `_closers` grows, because it must not wait for a closer.
        self._closer_added: asyncio.Future[None] | None = None

    def __len__(self) -> int:
        return len(self._pending())

    def spawn(
        self,
        work: Coroutine[Any, Any, None],
        on_cancelled: Callable[[], object] = lambda: None,
        context: Context | None = None,
    ) -> asyncio.Task[None]:
        """Run a coroutine in a task, and return it.

        Args:
            work: the coroutine. It sees to its own cancellation once it has begun.
            on_cancelled: called if the task is cancelled before it begins.
            context: the coroutine runs in a copy of this context, or of the current one.
        """
        # Not with the argument `context`, because not every task factory takes it.
        create = self._loop.create_task
        run = self._run(work)
        task = create(run) if context is None else context.run(create, run)
        if not task.done():
            self._tasks.add(task)
            # A task that is cancelled before its first step does not enter `_run`.
            task.add_done_callback(functools.partial(self._check_begun, work, on_cancelled))
        return task

    def exclude_caller(self) -> None:
        """Do not wait for the handler whose task calls this, or started the task that does."""
        task = _handler_task.get()
        if task in self._tasks:
            self._closers.add(task)
            if self._closer_added is not None and not self._closer_added.done():
                self._closer_added.set_result(None)

    async def wait(self, deadline: float | None) -> None:
        """Wait until every task is done, or until ``deadline`` in loop time (None: no deadline)."""
        while tasks := self._pending():
            left = None if deadline is None else deadline - self._loop.time()
            if left is not None and left <= 0:
                return
            self._closer_added = self._loop.create_future()
            await asyncio.wait(
                {*tasks, self._closer_added},
                timeout=left,
                return_when=asyncio.FIRST_COMPLETED,
            )

    def cancel(self) -> None:
        """Cancel every task, in the next turn."""
        self.cancelled = True
        for task in self._pending():
            # Not at once: a task that has not begun would end without running its handler's
            # `finally`, or ours.
            self._loop.call_soon(task.cancel)

    def _pending(self) -> set[asyncio.Task[None]]:
        return {task for task in self._tasks - self._closers if not task.done()}

    def _check_begun(
        self,
        work: Coroutine[Any, Any, None],
        on_cancelled: Callable[[], object],
        task: asyncio.Task[None],
    ) -> None:
        # `_run` removes the task when it ends.
        if task in self._tasks:
            self._tasks.discard(task)
            # Otherwise Python warns that it was never awaited.
            work.close()
            on_cancelled()

    async def _run(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.current_task()
        assert task is not None
        # `spawn` is too late for this if the task starts eagerly.
        self._tasks.add(task)
        _handler_task.set(task)
        try:
            await work
        except (KeyboardInterrupt, SystemExit):
            # The loop raises it. Retrieve it, so that the task does not log it as well.
            task.add_done_callback(asyncio.Task.exception)
            raise
        finally:
            # Otherwise the task and its context keep each other alive.
            _handler_task.set(None)
            self._tasks.discard(task)
            self._closers.discard(task)
