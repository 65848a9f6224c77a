"""The standard streams: always open, for the command's own output alone, with errors of its own."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Any

from rosasync._cli.errors import CliError, Code

__all__ = ["OutputError", "prepare_streams", "silence_stdout"]


class OutputError(CliError):
    """Standard output cannot be written: its reader has left, or the disk is full."""

    def __init__(self, error: OSError) -> None:
        closed = isinstance(error, BrokenPipeError)
        super().__init__(
            f"standard output cannot be written: {error.strerror}",
            Code.PIPE_CLOSED if closed else Code.FAILED,
        )


class _Output(io.FileIO):
    """Standard output, whose errors are not taken for those of a file or a socket."""

    def write(self, data: Any, /) -> Any:
        try:
            return super().write(data)
        except OSError as error:
            raise OutputError(error) from None


def prepare_streams() -> None:
    """Make the streams safe to use, before anything else opens a file.

    Standard output is for results alone: Fast DDS prints its messages there, from C++. They go to
    standard error instead.
    """
    if sys.stdout is not sys.__stdout__:
        return
    _open_missing()
    encoding = "utf-8" if sys.stdout is None else sys.stdout.encoding
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(_Output(os.dup(1), "w")),
        encoding=encoding,
        errors="replace",  # for terminals without Unicode
        line_buffering=True,
    )
    os.dup2(2, 1)


def silence_stdout() -> None:
    """Let what is still buffered go nowhere, because it cannot be written."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _open_missing() -> None:
    """Open the descriptors that the shell has closed, which the next file or socket would get.

    Writing results to a closed standard output is still an error. What would go to a closed
    standard error goes nowhere.
    """
    for number, flags in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            # The lowest free number, so this one.
            os.open(os.devnull, flags)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115 - until the process ends
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115 - until the process ends
