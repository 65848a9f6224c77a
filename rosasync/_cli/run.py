"""Runs a command: its coroutine, its session, and how it ends."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Literal

import typer

import rosasync
from rosasync._cli.errors import CliError, Code, code_of, line_of
from rosasync._cli.signals import ended_by, interruptible
from rosasync._cli.streams import OutputError

__all__ = ["fail", "interrupted", "open_session", "run"]


def run(command: Coroutine[Any, Any, int | None]) -> None:
    """Run a command's coroutine to its end, and end the process with its exit code.

    Raises:
        typer.Exit: always, with the exit code.
    """
    try:
        code = asyncio.run(_woken_by_signals(command)) or Code.ANSWERED
        sys.stdout.flush()
    except (KeyboardInterrupt, asyncio.CancelledError):
        raise typer.Exit(interrupted()) from None
    except OutputError:
        raise
    except (CliError, rosasync.RosasyncError, ImportError) as error:
        fail(error)
        code = code_of(error)
    raise typer.Exit(int(code))


def interrupted() -> int:
    """Return the exit code of a command that a signal has ended: as a shell reports it."""
    return 128 + ended_by()


async def _woken_by_signals(command: Coroutine[Any, Any, int | None]) -> int | None:
    """Await a command, and wake the loop at every signal.

    `asyncio.run` handles Ctrl-C in Python code. An idle loop runs none until its next event, if the
    signal comes just before it sleeps, or on a thread of the middleware.
    """
    loop = asyncio.get_running_loop()
    reader, writer = socket.socketpair()
    with reader, writer:
        reader.setblocking(False)
        writer.setblocking(False)
        loop.add_reader(reader, reader.recv, 4096)
        previous = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            with interruptible():
                return await command
        finally:
            signal.set_wakeup_fd(previous)
            loop.remove_reader(reader)


def open_session(
    timeout: float | None = None, introspection: Literal["off", "contents"] = "off"
) -> rosasync.Session:
    """Return a session to open, on a node that is hidden from listings."""
    return rosasync.Session(
        f"_rosasync_{os.getpid()}", timeout=timeout, introspection=introspection
    )


def fail(error: BaseException | str) -> None:
    """Print an error as one line to standard error."""
    text = error if isinstance(error, str) else line_of(error)
    with suppress(OSError):
        print(f"rosasync: {text}", file=sys.stderr, flush=True)
