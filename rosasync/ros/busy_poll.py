"""Busy poll: the loop looks for a response for a while before it goes to sleep for it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosasync.ros.direct_bridge import DirectClient

__all__ = ["BusyPoll"]


class BusyPoll:
    """After Linux's SO_BUSY_POLL (socket(7)): trades CPU for latency, where that pays.

    After a send the loop looks for the response once in each of its turns, so that every other
    ready task has its own in between, for ``budget`` seconds at the most. It does so only for a
    client whose last answer came within the budget, and never while nothing is out. A client that
    is looked at does not signal: the middleware's thread has nobody to wake.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, budget: float) -> None:
        self._loop = loop
        self._budget = budget
        self._until: dict[DirectClient, float] = {}
        self._looking = False

    def sent(self, client: DirectClient) -> float:
        """Look for the response to a request that was just sent; the time of the sending."""
        now = self._loop.time()
        if client.quick:
            self._until[client] = now + self._budget
            if not self._looking:
                self._looking = True
                self._loop.call_soon(self._look)
        return now

    def answered(self, client: DirectClient, sent: float) -> None:
        """Learn from an answer."""
        client.quick = self._loop.time() - sent <= self._budget

    def leave(self, client: DirectClient) -> None:
        """Look at this client no more."""
        self._until.pop(client, None)

    def _look(self) -> None:
        now = self._loop.time()
        for client, until in tuple(self._until.items()):
            client.take_all()
            if not client.is_waiting:
                del self._until[client]
            elif now >= until:
                del self._until[client]
                client.quick = False
                client.start_signalling()
        self._looking = bool(self._until)
        if self._looking:
            self._loop.call_soon(self._look)
