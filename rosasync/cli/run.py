"""Runs a command: its coroutine, its session, and how it ends."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, Literal

import typer

import rosasync
from rosasync.cli.errors import CliError, Code, code_of, line_of

__all__ = ["fail", "open_session", "run", "silence_stdout"]


def run(command: Coroutine[Any, Any, int | None]) -> None:
    """Run a command's coroutine to its end, and end the process with its exit code.

    Raises:
        typer.Exit: always, with the exit code.
    """
    try:
        code = asyncio.run(command) or Code.ANSWERED
        sys.stdout.flush()
    except KeyboardInterrupt:
        code = Code.INTERRUPTED
    except BrokenPipeError:
        silence_stdout()
        code = Code.PIPE_CLOSED
    except (CliError, rosasync.RosasyncError, ImportError) as error:
        fail(error)
        code = code_of(error)
    raise typer.Exit(int(code))


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


def silence_stdout() -> None:
    """Let what is still buffered go nowhere, because the reader has closed the pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
