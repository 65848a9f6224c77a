"""SIGTERM and SIGHUP end a command as Ctrl-C does: what it has changed is set back first."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

__all__ = ["ended_by", "handle_signals", "interruptible"]

ENDING = (signal.SIGTERM, signal.SIGHUP)

_received: list[int] = []
_tasks: list[asyncio.Task[object]] = []


def handle_signals() -> None:
    """Handle the signals from now on, but those that the parent process has switched off."""
    for number in ENDING:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


def ended_by() -> int:
    """Return the number of the signal that ends this process; SIGINT if there was no other."""
    return _received[0] if _received else signal.SIGINT


@contextmanager
def interruptible() -> Iterator[None]:
    """Let a signal cancel the task that runs this block, instead of a KeyboardInterrupt."""
    task = asyncio.current_task()
    assert task is not None
    _tasks.append(task)
    try:
        yield
    finally:
        _tasks.remove(task)


def _end(number: int, frame: FrameType | None) -> None:
    """Do what `asyncio.run` does for the first SIGINT.

    Later ones are ignored: ``timeout`` and systemd may send two, and the end takes its time.
    """
    if _received:
        return
    _received.append(number)
    if not _tasks:
        raise KeyboardInterrupt
    for task in _tasks:
        task.cancel()
        # The loop may be asleep.
        task.get_loop().call_soon_threadsafe(lambda: None)
