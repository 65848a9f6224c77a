"""The ``rosasync`` command as a user runs it: in a pipe, or on a terminal."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pexpect
import pyte

from tests.support.process import ROOT, own

__all__ = [
    "DISCOVERY",
    "LAMP",
    "LAMP_TYPE",
    "LIMIT",
    "LOOK",
    "Terminal",
    "json_lines",
    "rosasync",
    "terminal",
]

LAMP, LAMP_TYPE = "/lamp/switch", "std_srvs/srv/SetBool"
LIMIT = 120.0
DISCOVERY = "10"
"""Seconds for ``--timeout`` or ``--wait``, in which a command surely discovers every server.

A process announces itself every 3 s, and a busy machine may lose that or let it wait.
"""
LOOK = ("--wait", DISCOVERY)
"""Options with which a command surely discovers the nodes; by itself it looks for 3.5 s at most."""
PATIENCE = 10.0
"""Seconds in which a command that is ended may clean up."""
COLUMNS, LINES = 100, 30


def rosasync(*arguments: str, stdin: str = "", **environ: str) -> subprocess.CompletedProcess[str]:
    """Run the command in pipes, to its end."""
    done = subprocess.run(
        (sys.executable, "-m", "rosasync", *arguments),
        capture_output=True,
        text=True,
        input=stdin,
        timeout=LIMIT,
        env={**os.environ, **environ},
        cwd=ROOT,
        check=False,
    )
    done.stderr = own(done.stderr)
    return done


def json_lines(text: str) -> list[Any]:
    """Parse an output that should be one JSON object a line and nothing else."""
    found = [json.loads(line) for line in text.splitlines()]
    assert all(isinstance(item, dict) for item in found)
    return found


class Terminal:
    """A command on a pseudo-terminal."""

    def __init__(self, arguments: tuple[str, ...], environ: dict[str, str], into: str) -> None:
        command = shlex.join((sys.executable, "-m", "rosasync", *arguments))
        self._process: Any = pexpect.spawn(
            "bash",
            ["-c", f"exec {command} {into}"],
            timeout=LIMIT,
            dimensions=(LINES, COLUMNS),
            env={**os.environ, "TERM": "xterm", **environ},
            cwd=str(ROOT),
        )
        self._raw = b""

    def wait_for(self, text: str) -> None:
        """Wait until the command has printed what this regular expression matches."""
        self._process.expect(text.encode())
        self._raw += self._process.before + self._process.after

    def interrupt(self) -> None:
        """Press Ctrl-C."""
        self._process.sendintr()

    def kill(self) -> None:
        """End the command if it still runs.

        pexpect gives it a tenth of a second for each signal, also for SIGKILL, and then raises.
        """
        process = self._process
        process.kill(signal.SIGTERM)
        end = time.monotonic() + PATIENCE
        while process.isalive():
            if time.monotonic() > end:
                process.kill(signal.SIGKILL)
            time.sleep(0.01)
        process.close()

    def end(self) -> int:
        """Wait for the end, and return the exit code."""
        self._process.expect(pexpect.EOF)
        self._raw += self._process.before
        self._process.close()
        assert self._process.signalstatus is None
        return int(self._process.exitstatus)

    @property
    def raw(self) -> bytes:
        """What the command has written to the terminal."""
        return own(self._raw.decode(errors="surrogateescape")).encode(errors="surrogateescape")

    @property
    def screen(self) -> str:
        """What the terminal shows."""
        screen = pyte.Screen(COLUMNS, LINES)
        pyte.ByteStream(screen).feed(self.raw)
        return "\n".join(line.rstrip() for line in screen.display).strip()


@contextmanager
def terminal(*arguments: str, into: str = "", **environ: str) -> Iterator[Terminal]:
    """Start the command on a pseudo-terminal, and end it with the block, as SIGTERM does.

    Args:
        arguments: what follows ``rosasync``.
        into: where the shell redirects its output.
        environ: variables to set.
    """
    started = Terminal(arguments, environ, into)
    try:
        yield started
    finally:
        started.kill()
