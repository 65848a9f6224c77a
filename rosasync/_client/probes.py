"""When a client of an overloaded server may find out again how quick the server is."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosasync._client.clients import Clients

__all__ = ["Probes", "next_pause"]

TARGET = 0.8
"""A probe should be answered in this part of the time that its caller has."""
LONGEST = 0.5
"""Maximum pause, in the same unit. A server that has become quick again is found out after it."""


class Probes:
    """The probes of a session, and the pauses between them. Confined to the loop's thread.

    A probe is a request that is sent because nothing else is out, although its caller has hardly
    time enough. If each of several sessions sends the next one as soon as the last is answered, all
    of them are out all the time, and take longer than any caller has. So each session pauses for as
    long as its probes take too long, and shorter again after each one that does not.

    Args:
        clients: the clients of the service.
        schedule: schedules an assignment, because the next probe is due.
    """

    def __init__(self, clients: Clients, schedule: Callable[[], object]) -> None:
        self._loop = asyncio.get_running_loop()
        self._clients = clients
        self._schedule = schedule
        # When the probe was sent that is out, and how many seconds its caller had.
        self._out: tuple[float, float] | None = None
        self._pause = 0.0
        self._due = 0.0
        # Started by callers that are passed over before the next probe is due. Stopped by `close`.
        self._timer: asyncio.TimerHandle | None = None

    def send(self, now: float, left: float) -> None:
        """Record that a probe is sent, whose caller has so many seconds left."""
        self._out = now, left

    def update(self, now: float, overloaded: bool) -> None:
        """Find out how long the last probe took, or forget it if the overload is over.

        Before anything else is sent, because later answers would be taken for that of the probe.
        """
        if self._out is None:
            return
        sent_at, left = self._out
        if not overloaded:
            self._pause = self._due = 0.0
            self._out = None
        elif self._clients.nothing_out:
            answered_at = max((each.window.answered_at for each in self._clients), default=0.0)
            # An answer before the probe is none to it: that is lost.
            end = answered_at if answered_at >= sent_at else now
            self._pause = next_pause(self._pause, end - sent_at, left, self._clients.others)
            self._due = end + self._pause
            self._out = None

    def may_send(self, now: float) -> bool:
        """Return whether the next probe is due; if not, have it scheduled."""
        if now >= self._due:
            return True
        if self._timer is None:
            self._timer = self._loop.call_at(self._due, self._on_due)
        return False

    def close(self) -> None:
        """Stop the timer; idempotent."""
        if self._timer is not None:
            self._timer.cancel()

    def _on_due(self) -> None:
        self._timer = None
        self._schedule()


def next_pause(pause: float, took: float, left: float, others: int) -> float:
    """Return the pause after a probe, in seconds.

    Args:
        pause: the pause before it.
        took: how long its answer took.
        left: how long its caller had.
        others: the number of clients in other sessions. The pause is not longer than the requests
            of all of them would take, one of each. So a client that is alone never pauses.
    """
    pause = max(0.0, pause + took - TARGET * left)
    return min(pause, others * took, LONGEST * left)
