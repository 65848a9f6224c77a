"""BlockingReport: warns of handlers that block the event loop."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Coroutine, Generator
from time import monotonic
from types import CoroutineType
from typing import Any, TypeVar

__all__ = ["BLOCKING", "BlockingReport"]

T = TypeVar("T")

logger = logging.getLogger("rosasync")

BLOCKING = 0.1
"""Seconds for which a handler may block the loop unreported. asyncio's debug mode has the same."""


class BlockingReport:
    """Warns once if the handler of a server blocks the loop.

    Args:
        server_name: the name of the service or action.
        handler_name: the name of its handler.
    """

    def __init__(self, server_name: str, handler_name: str) -> None:
        self._server_name = server_name
        self._handler_name = handler_name
        self._reported = False

    def timed(self, pending: Awaitable[T]) -> Awaitable[T]:
        """Return what awaits a handler, and reports it if one of its steps blocks the loop."""
        if type(pending) is CoroutineType and not self._reported:
            return _TimedSteps(pending, self.report)
        return pending

    def report(self, seconds: float) -> None:
        """Report that the handler has blocked the loop for so long, unless that was reported."""
        if self._reported:
            return
        self._reported = True
        logger.warning(
            "%s: the handler %s has blocked the event loop for %.0f ms, in which nothing else ran: "
            "do slow work in `await asyncio.to_thread(…)`. This is reported once for each server",
            self._server_name,
            self._handler_name,
            seconds * 1000,
        )


class _TimedSteps:
    """Awaits a coroutine, and reports each of its steps that blocks the loop for too long.

    A step is what runs from one suspension to the next, so the time that an ``await`` takes does
    not count.
    """

    __slots__ = ("_coroutine", "_report")

    def __init__(
        self, coroutine: Coroutine[Any, Any, Any], report: Callable[[float], None]
    ) -> None:
        self._coroutine = coroutine
        self._report = report

    def __await__(self) -> Generator[Any, Any, Any]:
        coroutine = self._coroutine
        step: Callable[[Any], Any] = coroutine.send
        value: Any = None
        while True:
            began = monotonic()
            try:
                awaited = step(value)
            except StopIteration as end:
                return end.value
            finally:
                value = None  # An exception would refer to this frame, and the frame to it.
                if monotonic() - began > BLOCKING:
                    self._report(monotonic() - began)
            try:
                value = yield awaited
                step = coroutine.send
            except GeneratorExit:
                coroutine.close()
                raise
            except BaseException as error:
                step, value = coroutine.throw, error
