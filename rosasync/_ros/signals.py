"""Eventfds that the middleware writes to and the loop watches, shared by clients or services."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from typing import Generic, TypeVar

__all__ = ["PacedSignal", "Signal", "Signals"]

M = TypeVar("M")

MOST = 16
"""Maximum number of eventfds of one kind. More would locate members better, but use descriptors."""
PAUSE = 0.002
"""Seconds between two looks at a `PacedSignal` that is busy."""


class Signal(Generic[M]):
    """An eventfd, and the members that share it.

    Attributes:
        members: the members. Written by `Signals`.
        waiting: those that wait for something, the last to begin waiting last. Written by them.
        fd: the file descriptor.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, take: Callable[[Signal[M], int], None]
    ) -> None:
        self._loop = loop
        self._take = take
        self.members: dict[M, None] = {}
        self.waiting: dict[M, None] = {}
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        try:
            loop.add_reader(self.fd, self._look)
        except BaseException:
            os.close(self.fd)
            raise

    def close(self) -> None:
        """Close the eventfd. The middleware must have stopped writing to it."""
        if not self._loop.is_closed():
            self._loop.remove_reader(self.fd)
        os.close(self.fd)

    def _look(self) -> bool:
        """Take what was signalled; return whether anything was."""
        try:
            signalled = os.eventfd_read(self.fd)
        except BlockingIOError:
            return False
        self._take(self, signalled)
        return True


class PacedSignal(Signal[M]):
    """A signal that does not wake the loop more often than every `PAUSE` seconds.

    To wake the loop costs more than to take a message. So while signals come more often than that,
    the loop does not watch the eventfd, and a timer looks at it. A signal after a longer pause
    wakes the loop at once.
    """

    def __init__(
        self, loop: asyncio.AbstractEventLoop, take: Callable[[Signal[M], int], None]
    ) -> None:
        super().__init__(loop, take)
        self._busy_until = 0.0
        # Runs while the loop does not watch the eventfd.
        self._timer: asyncio.TimerHandle | None = None

    def close(self) -> None:
        """Close the eventfd."""
        if self._timer is not None:
            self._timer.cancel()
        super().close()

    # Both set the timer before they look, because what is taken may close the signal.

    def _look(self) -> bool:
        now = self._loop.time()
        if now < self._busy_until:
            self._loop.remove_reader(self.fd)
            self._timer = self._loop.call_later(PAUSE, self._look_again)
        self._busy_until = now + PAUSE
        return super()._look()

    def _look_again(self) -> None:
        self._timer = self._loop.call_later(PAUSE, self._look_again)
        if not super()._look():
            self._timer.cancel()
            self._loop.add_reader(self.fd, self._look)


class Signals(Generic[M]):
    """Gives each member a signal to share with as few others as possible.

    The first signal stays until `close`, so that the number of descriptors depends on how many
    members there are, not on how many there have been.

    Args:
        loop: the loop that watches.
        take: called on its thread with a signal and the number of events.
        kind: the class of the signals.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        take: Callable[[Signal[M], int], None],
        kind: type[Signal[M]] = Signal,
    ) -> None:
        self.loop = loop
        self._take = take
        self._kind = kind
        self._signals: list[Signal[M]] = []

    @property
    def members(self) -> list[M]:
        """Every member of every signal."""
        return [member for signal in self._signals for member in signal.members]

    def join(self, member: M) -> Signal[M]:
        """Return the signal for a new member.

        Raises:
            OSError: the process is out of file descriptors and there is no signal to share.
        """
        signal = min(self._signals, key=lambda signal: len(signal.members), default=None)
        if signal is None or (signal.members and len(self._signals) < MOST):
            signal = self._add(signal)
        signal.members[member] = None
        return signal

    def _add(self, shared: Signal[M] | None) -> Signal[M]:
        """Return a new signal, or ``shared`` if the process is out of file descriptors."""
        try:
            signal = self._kind(self.loop, self._take)
        except OSError:
            if shared is None:
                raise
            return shared
        self._signals.append(signal)
        return signal

    def leave(self, member: M, signal: Signal[M]) -> None:
        """Remove a member; idempotent. The middleware must have stopped signalling for it."""
        signal.members.pop(member, None)
        signal.waiting.pop(member, None)
        if not signal.members and len(self._signals) > 1 and signal in self._signals:
            self._signals.remove(signal)
            signal.close()

    def close(self) -> None:
        """Close the eventfds, after the members have left."""
        for signal in self._signals:
            signal.close()
        self._signals.clear()
