"""Responses that are sent again, because the middleware has not discovered their clients yet."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync._core.ports import RequestHeader
    from rosasync._server.handler_tasks import Spawn
    from rosasync.tracing import ServerTrace

__all__ = ["RESEND", "RESEND_TIME", "Resender", "Unsent"]

RESEND = (0.05, 0.1, 0.2, 0.4, *[0.8] * 37)
"""Seconds to wait before each further attempt to send a response to a client that the middleware
has not discovered completely. It discovers it after 3, 6 or 9 s if packets of its discovery were
lost, and a stock client waits for ever."""
RESEND_TIME = 2 * sum(RESEND)
"""Seconds after which a response has been sent or given up, also on a machine with other work."""
MAX_UNSENT = 1000
"""Maximum number of responses of a server that wait to be sent again."""


@dataclass(slots=True, eq=False)
class Unsent:
    """A response that its client could not get yet.

    Attributes:
        header: the header of the request.
        response: a copy of the response.
        trace: the trace of the call.
        attempts: how often it was sent again.
        due: when to send it again, in loop time.
    """

    header: RequestHeader
    response: Any
    trace: ServerTrace | None
    attempts: int = 0
    due: float = 0.0


class Resender:
    """Repeats responses whose clients the middleware has not discovered completely.

    Confined to the loop's thread. One task serves all responses of a server, and ends when none is
    left. The delays grow, because an attempt may block the process for 0.1 s.

    Args:
        send: sends a response once more; returns False if its client cannot get it yet.
        give_up: counts and logs a response that cannot be delivered, with the reason.
        is_closed: whether the server has ended, so that nothing is sent any more.
        spawn: starts the task.
    """

    def __init__(
        self,
        send: Callable[[Unsent], bool],
        give_up: Callable[[Unsent, object], None],
        is_closed: Callable[[], bool],
        spawn: Spawn,
    ) -> None:
        self._send = send
        self._give_up = give_up
        self._is_closed = is_closed
        self._spawn = spawn
        self._loop = asyncio.get_running_loop()
        # In the order of their arrival. The task runs while there are any.
        self._unsent: dict[Unsent, None] = {}

    def add(self, unsent: Unsent) -> None:
        """Repeat a response for about thirty seconds. Beyond MAX_UNSENT, the oldest is given up.

        Raises:
            RuntimeError: the loop is closed.
        """
        if self._is_closed():
            return
        idle = not self._unsent
        if len(self._unsent) >= MAX_UNSENT:
            oldest = next(iter(self._unsent))
            del self._unsent[oldest]
            self._give_up(oldest, f"{MAX_UNSENT} later ones wait to be sent again")
        unsent.due = self._loop.time() + RESEND[0]
        self._unsent[unsent] = None
        if idle:
            # If the task is cancelled before it begins, it cannot abandon them itself.
            self._spawn(self._run(), self._abandon)

    def has(self, header: RequestHeader) -> bool:
        """Return whether the response to a request waits to be sent again."""
        return any(unsent.header is header for unsent in self._unsent)

    async def _run(self) -> None:
        try:
            while self._unsent:
                # The shortest delay, because a response that is added now is due after it.
                await asyncio.sleep(RESEND[0])
                now = self._loop.time()
                for unsent in [unsent for unsent in self._unsent if unsent.due <= now]:
                    if unsent in self._unsent and not self._settle(unsent):
                        return
                    await asyncio.sleep(0)
        finally:
            self._abandon()

    def _abandon(self) -> None:
        """Give up those that are left when the end of the server cancels the task."""
        for unsent in () if self._is_closed() else self._unsent:
            self._give_up(unsent, "the server closes, and its client was not discovered before")
        self._unsent.clear()

    def _settle(self, unsent: Unsent) -> bool:
        """Try once more to send a response; return whether the server is still open."""
        if self._is_closed():
            return False
        unsent.attempts += 1
        try:
            sent = self._send(unsent)
        except Exception as error:
            sent = True
            if self._is_closed():
                return False
            self._give_up(unsent, error)
        if not sent and unsent.attempts < len(RESEND):
            unsent.due = self._loop.time() + RESEND[unsent.attempts]
            return True
        del self._unsent[unsent]
        if not sent:
            self._give_up(unsent, "its client was not discovered in time")
        return True
