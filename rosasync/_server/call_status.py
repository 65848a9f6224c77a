"""The reports to the caller of one call, and whether that caller has left."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

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
    """

    __slots__ = ("_report", "abandoned", "client", "number", "task")

    def __init__(self, client: bytes, number: int, report: TellCaller, abandoned: bool) -> None:
        self.client = client
        self.number = number
        self.abandoned = abandoned
        self.task: asyncio.Task[None] | None = None
        self._report = report

    def report(self, outcome: Outcome, error: BaseException | None = None) -> None:
        """Tell the caller that there will be no answer. From any thread; takes no lock."""
        self._report(self, outcome, error)
