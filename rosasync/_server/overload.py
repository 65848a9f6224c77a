"""When a server is overloaded: how often, and a line in the log when it begins and when it ends."""

from __future__ import annotations

import asyncio
import logging

from rosasync._core.text import count

__all__ = ["OverloadLog"]

logger = logging.getLogger("rosasync")

CALM = 1.0
"""Seconds without overload after which it is over. A shorter time would fill the log."""


class OverloadLog:
    """Counts and logs the overloads of one server. Confined to the loop's thread.

    Args:
        name: the resolved service name.
        by_arrival: whether requests are served in the order of their arrival even then.

    Attributes:
        times: how many overloads have begun.
        active: whether one has begun and is not over.
    """

    def __init__(self, name: str, by_arrival: bool) -> None:
        self.times = 0
        self.active = False
        self._name = name
        self._order = (
            "requests are served in the order of their arrival"
            if by_arrival
            else "the clients take turns, and the newest request of each is served first"
        )
        self._loop = asyncio.get_running_loop()
        self._began = 0.0
        self._dropped = 0
        # Runs from the first calm moment of an overload; stopped by the next that is not, and by
        # `close`.
        self._timer: asyncio.TimerHandle | None = None

    def update(self, overloaded: bool, dropped: int, waiting: int, oldest_age: float) -> None:
        """Note the state of the backlog after it has changed.

        Args:
            overloaded: whether it is standing, or requests were dropped just now.
            dropped: how many.
            waiting: how many requests wait.
            oldest_age: for how many seconds the oldest has waited.
        """
        if overloaded:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            if not self.active:
                self._begin(waiting, oldest_age)
            self._dropped += dropped
        elif self.active and self._timer is None:
            self._timer = self._loop.call_later(CALM, self._end)

    def close(self) -> None:
        """Stop the timer; idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _begin(self, waiting: int, oldest_age: float) -> None:
        self.active = True
        self.times += 1
        self._began = self._loop.time()
        self._dropped = 0
        logger.warning(
            "%s: overloaded, with %s waiting, the oldest for %.1f s: %s. Raise "
            "concurrency, make the handler faster, or answer what is dropped with on_overload",
            self._name,
            count(waiting, "request"),
            oldest_age,
            self._order,
        )

    def _end(self) -> None:
        self._timer = None
        self.active = False
        logger.warning(
            "%s: no longer overloaded, after %.1f s, with %s dropped",
            self._name,
            self._loop.time() - self._began,
            count(self._dropped, "request"),
        )
