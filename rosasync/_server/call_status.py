"""The reports to the caller of one call, and whether that caller has left."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable
from types import CoroutineType
from typing import Any

from rosasync._status.wire import Outcome

__all__ = ["CallStatus", "TellCaller"]

TellCaller = Callable[["CallStatus", Outcome, BaseException | None], None]
"""Tells the caller of a request why it gets no answer. From any thread."""


class CallStatus:
    """One call of a server that takes part.

    Attributes:
        client: the client that sent it.
        number: its sequence number.
        abandoned: whether its caller has left. Written by `ServerStatus`.
        task: the task of its handler, if there is one. Written by the `HandlerRunner`.
        pending: what the handler has returned for that task to await. Written by it too.
    """

    __slots__ = ("_report", "abandoned", "client", "number", "pending", "task")

    def __init__(self, client: bytes, number: int, report: TellCaller, abandoned: bool) -> None:
        self.client = client
        self.number = number
        self.abandoned = abandoned
        self.task: asyncio.Task[None] | None = None
        self.pending: Awaitable[Any] | None = None
        self._report = report

    @property
    def has_begun(self) -> bool:
        """Whether something of its handler has run: a coroutine begins a turn after its call."""
        handler = self.pending
        return not (
            isinstance(handler, CoroutineType)
            and inspect.getcoroutinestate(handler) == inspect.CORO_CREATED
        )

    def report(self, outcome: Outcome, error: BaseException | None = None) -> None:
        """Tell the caller that there will be no answer. From any thread; takes no lock."""
        self._report(self, outcome, error)
