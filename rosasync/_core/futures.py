"""rclpy futures as asyncio futures."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

from rosasync.errors import UsageError

__all__ = ["wrap_future"]


def wrap_future(future: Any) -> asyncio.Future[Any]:
    """Wrap an rclpy future in an asyncio future, as ``asyncio.wrap_future`` does for threads.

    Cancelling either future cancels the other. Call it on the thread of a running loop; the result
    belongs to that loop. Do not await an rclpy future itself: in asyncio that busy-loops, or raises
    ``Task got bad yield`` (rclpy issue 1588).

    Args:
        future: an ``rclpy.task.Future``, from ``call_async``, an action client, or an executor's
            ``create_task``. An executor has to spin the node that completes it.

    Raises:
        TypeError: ``future`` is not an rclpy future.
        UsageError: there is no running loop.
    """
    if not (hasattr(future, "add_done_callback") and hasattr(future, "cancelled")) or isinstance(
        future, asyncio.Future
    ):
        raise TypeError(f"expected an rclpy.task.Future, got {type(future).__name__}")
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        raise UsageError("wrap_future needs a running event loop: call it in a coroutine") from None
    wrapped: asyncio.Future[Any] = loop.create_future()

    def arrive() -> None:
        if wrapped.done():
            return
        if future.cancelled():
            wrapped.cancel()
        elif (error := future.exception()) is not None:
            wrapped.set_exception(error)
        else:
            wrapped.set_result(future.result())

    def on_done(_: Any) -> None:
        # If the loop is closed, nothing waits for the result any more.
        with contextlib.suppress(RuntimeError):
            loop.call_soon_threadsafe(arrive)

    def on_wrapped_done(_: asyncio.Future[Any]) -> None:
        if wrapped.cancelled() and not future.done() and not future.cancelled():
            future.cancel()

    wrapped.add_done_callback(on_wrapped_done)
    future.add_done_callback(on_done)
    return wrapped
