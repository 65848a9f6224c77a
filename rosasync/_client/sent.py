"""One request that was sent."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import asyncio

    from rosasync._core.ports import Servers
    from rosasync._status.wire import Report

__all__ = ["Caller", "Sent"]


class Caller(Protocol):
    """The call that waits for a request: what its client needs of it. `Call` implements it."""

    future: asyncio.Future[Any]
    request: Any

    @property
    def newest(self) -> Sent | None:
        """The newest attempt that is outstanding."""

    @property
    def lease(self) -> object | None:
        """The leased client whose place the call uses, if it is made on a lease."""

    def on_later_answer(self, number: int) -> None:
        """React to the answer to another request of the client."""

    def lose(self, lost: Sent, error: Callable[[], Exception]) -> None:
        """React to an attempt that no server has any more."""

    def refuse(self, refused: Sent, report: Report) -> None:
        """React to an attempt that its servers have reported not to answer."""

    def end(self, now: float) -> None:
        """Return what the call holds."""


class Sent:
    """One attempt of a call, from its send until its response arrives or is no longer expected.

    Its window changes ``place``, ``leased``, ``out`` and ``lost``; `Client.send` sets ``out`` too.

    Attributes:
        number: its sequence number.
        servers: the servers that may have it; empty if the graph did not show any.
        at: the loop time at which it was sent.
        call: the call that waits for it; None once its caller has left.
        leased: whether it uses the place of its call's lease. The lease holds that place whether
            or not a request is outstanding, so such a request takes none of its own.
        place: whether it takes a place of its own in the window.
        out: how many places were taken when it was sent, with its own.
        lost: whether it is presumed lost because no answer came at all, so that the next attempt
            of its call may be sent in its place.
    """

    __slots__ = ("_report", "at", "call", "leased", "lost", "number", "out", "place", "servers")

    def __init__(
        self, number: int, servers: Servers, at: float, call: Caller | None, leased: bool = False
    ) -> None:
        self.number = number
        self.servers = servers
        self.at = at
        self.call = call
        self.leased = leased
        self.place = not leased
        self.out = 1
        self.lost = False

    @property
    def report(self) -> Report | None:
        """What a server has last reported of it; None if none has."""
        # Not set in the constructor, because every call comes there.
        return getattr(self, "_report", None)

    def remove_server(self, report: Report) -> None:
        """Record that a server has reported not to answer it."""
        self.servers -= {report.server}
        self._report = report

    def __repr__(self) -> str:
        caller = "waited for" if self.call is not None else "abandoned"
        place = "a place" if self.place else "its lease's place" if self.leased else "no place"
        return f"<Sent #{self.number} {caller}, {place}>"
