"""Busy polling: the loop polls for a response for a while before it sleeps."""

from __future__ import annotations

import asyncio
from typing import Protocol

__all__ = ["BusyPoll", "Pollable"]


class Pollable(Protocol):
    """A client that can be polled for responses, or signal them."""

    quick: bool
    """Whether its last response came within the budget. Written by `BusyPoll`."""

    @property
    def is_waiting(self) -> bool:
        """Whether a response is expected."""

    def take_all(self) -> None:
        """Take the responses that have arrived."""

    def start_signalling(self) -> None:
        """Let responses wake the loop."""


class BusyPoll:
    """Trades CPU for latency, like Linux's SO_BUSY_POLL (socket(7)) does.

    After a send, the loop polls for the response once in each turn, for up to ``budget`` seconds.
    Other ready tasks run in between. It polls only for a client whose last response came within the
    budget, and only while a request is pending. A client that is polled does not signal, which
    saves the middleware's thread a system call.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, budget: float) -> None:
        self._loop = loop
        self._budget = budget
        self._until: dict[Pollable, float] = {}
        self._polling = False

    def sent(self, client: Pollable) -> float:
        """Poll for the response to a request that was just sent, and return the current time."""
        now = self._loop.time()
        if client.quick:
            self._until[client] = now + self._budget
            if not self._polling:
                self._polling = True
                self._loop.call_soon(self._poll)
        return now

    def answered(self, client: Pollable, sent: float) -> None:
        """Record whether the response to a request sent at this loop time was quick."""
        client.quick = self._loop.time() - sent <= self._budget

    def leave(self, client: Pollable) -> None:
        """Stop polling for this client."""
        self._until.pop(client, None)

    def _poll(self) -> None:
        now = self._loop.time()
        for client, until in tuple(self._until.items()):
            client.take_all()
            if not client.is_waiting:
                self._until.pop(client, None)
            elif now >= until:
                self._until.pop(client, None)
                client.quick = False
                client.start_signalling()
        self._polling = bool(self._until)
        if self._polling:
            self._loop.call_soon(self._poll)
