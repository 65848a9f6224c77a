"""The way into a session's loop from other threads."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import weakref
from collections.abc import Callable
from typing import Any, Protocol

from rosasync.errors import SessionClosed

__all__ = ["LoopGateway", "Pending"]


class Pending(Protocol):
    """An operation that another thread has requested and the loop has not finished."""

    def fail(self, error: Exception) -> None:
        """End with an error, unless it has ended already. From any thread."""


class _Batch(list[tuple[Callable[..., object], tuple[Any, ...]]]):
    """Callbacks that wait for their turn of the loop.

    Only the loop refers to a batch. So when the loop ends without that turn, the callbacks are
    dropped with it, and cannot keep a dropped session alive.
    """

    __slots__ = ("__weakref__",)


NO_BATCH = weakref.ref(_Batch())
"""A reference to nothing."""


class LoopGateway:
    """Runs callbacks on the loop's thread, with one wake-up for each batch.

    Created on the loop's thread; every method may be called from any thread. Operations that are
    registered and unfinished when the session ends fail with `SessionClosed`, including those whose
    callbacks have not run yet.
    """

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        # Reentrant, because the garbage collector may run a __del__ that posts inside `post`.
        self._lock = threading.RLock()
        self._batch = NO_BATCH
        # Needs no lock: each change is a single operation, which is atomic.
        self._pending: dict[Pending, None] = {}
        self._closed = False

    @property
    def on_loop(self) -> bool:
        """Whether the caller runs on the loop's thread, inside the loop."""
        return asyncio._get_running_loop() is self.loop

    @property
    def on_thread(self) -> bool:
        """Whether the caller runs on the thread that opened the session."""
        return threading.get_ident() == self._thread

    @property
    def closed(self) -> bool:
        """Whether the gateway, or the loop, is closed."""
        return self._closed or self.loop.is_closed()

    @property
    def pending(self) -> int:
        """The number of operations that are registered and not finished."""
        return len(self._pending)

    def check_open(self) -> None:
        """Raise `SessionClosed` if the gateway, or the loop, is closed."""
        if self.closed:
            raise SessionClosed("the session is closed: open a new one")

    def post(self, callback: Callable[..., object], *args: Any) -> None:
        """Call ``callback(*args)`` on the loop's thread, in a later turn.

        Raises:
            SessionClosed: the gateway, or the loop, is closed.
        """
        with self._lock:
            self.check_open()
            batch = self._batch()
            if batch is not None:
                batch.append((callback, args))
            else:
                batch = _Batch([(callback, args)])
                self._batch = weakref.ref(batch)
                try:
                    self.loop.call_soon_threadsafe(self._drain, batch)
                except RuntimeError:
                    # The loop was closed, on its own thread, since the check.
                    self._batch = NO_BATCH
            self.check_open()

    def post_if_open(self, callback: Callable[..., object], *args: Any) -> None:
        """Call ``callback(*args)`` as `post` does, or do nothing if the gateway is closed."""
        with contextlib.suppress(SessionClosed):
            self.post(callback, *args)

    def call(self, callback: Callable[..., object], *args: Any) -> None:
        """Call ``callback(*args)`` at once if this is the loop's thread; otherwise `post` it."""
        if self.on_loop:
            self.check_open()
            callback(*args)
        else:
            self.post(callback, *args)

    def register(self, operation: Pending) -> None:
        """Fail this operation if the session ends before it is discarded."""
        self._pending[operation] = None

    def discard(self, operation: Pending) -> None:
        """Mark an operation as finished; idempotent."""
        self._pending.pop(operation, None)

    def close(self) -> None:
        """Drop the callbacks that have not run, and fail the operations; idempotent."""
        with self._lock:
            self._closed = True
            if (batch := self._batch()) is not None:
                batch.clear()
        for operation in tuple(self._pending):
            operation.fail(SessionClosed("the session is closed: open a new one"))
        self._pending.clear()

    def _drain(self, batch: _Batch) -> None:
        with self._lock:
            if self._batch() is batch:
                self._batch = NO_BATCH
        for callback, args in batch:
            try:
                callback(*args)
            except Exception as error:
                self.loop.call_exception_handler(
                    {"message": f"{callback!r} failed", "exception": error}
                )
