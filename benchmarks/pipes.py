"""Both ends of a child process that answers JSON lines."""

from __future__ import annotations

import json
import os
import queue
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any

__all__ = ["READY", "Child", "ChildError", "Hung", "answer_lines", "await_line", "describe"]

Message = dict[str, Any]

ROOT = Path(__file__).resolve().parent.parent

READY = b"ready\n"
"""What a server's process prints on stdout once it serves."""


def await_line(output: IO[bytes], line: bytes) -> bool:
    """Read up to this line, past what the middleware logs; False if the output ends without it."""
    return line in iter(output.readline, b"")


class ChildError(Exception):
    """The child answered with an error, or ended."""


class Hung(ChildError):
    """The child did not answer in time."""


class Child:
    """A Python module that runs as a child process and answers one request at a time.

    Args:
        module: the module, run with ``python -m`` and `args`.
        cores: the cores to which the process is bound.
        prefix: the start of the command, before the interpreter.
        environment: variables to add to this process's environment.
    """

    def __init__(
        self,
        module: str,
        *args: str,
        cores: set[int] | None = None,
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the child
        # Its own session: the parent handles Ctrl-C, and a kill reaches grandchildren.
        self._process = subprocess.Popen(
            [*prefix, sys.executable, "-m", module, *args],
            env={**os.environ, **(environment or {})},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            cwd=ROOT,
            start_new_session=True,
        )
        self._buffer = bytearray()
        if cores:
            os.sched_setaffinity(self._process.pid, cores)

    def ask(self, do: str, *, timeout: float, **message: Any) -> Message:
        """Send one message and return the answer.

        Raises:
            Hung: no answer within `timeout` seconds. Kill the child, which cannot be used again.
            ChildError: the answer is an error, or the child has ended.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": do, **message}).encode() + b"\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            raise ChildError(self._epitaph()) from None
        answer: Message = json.loads(self._line(time.monotonic() + timeout, do))
        if "error" in answer:
            raise ChildError(answer["error"])
        return answer

    def close(self, timeout: float = 10.0) -> None:
        """End the child by closing its input, or kill it if it does not end."""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout)
        self.kill()

    def kill(self) -> None:
        """Kill the child and every process it started."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._stderr):
            assert pipe is not None
            with suppress(BrokenPipeError):
                pipe.close()

    def __enter__(self) -> Child:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.close()

    def _line(self, deadline: float, do: str) -> bytes:
        assert self._process.stdout is not None
        fd = self._process.stdout.fileno()
        while (end := self._buffer.find(b"\n")) < 0:
            ready, _, _ = select.select([fd], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                raise Hung(f"no answer to {do!r} in time")
            chunk = os.read(fd, 1 << 20)
            if not chunk:
                raise ChildError(self._epitaph())
            self._buffer += chunk
        line = bytes(self._buffer[:end])
        del self._buffer[: end + 1]
        return line

    def _epitaph(self) -> str:
        code = self._process.wait()
        self._stderr.seek(0)
        last = self._stderr.read().decode(errors="replace").strip().splitlines()[-3:]
        return " / ".join([f"ended with code {code}", *last])


def answer_lines(answer: Callable[[Message], Message]) -> None:
    """Answer each line of standard input with a line on standard output, until the input ends.

    All other output of the process goes to standard error. If the input ends while `answer` is
    stuck, the process ends after 5 s.
    """
    requests, output = os.dup(0), os.dup(1)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    threading.Thread(target=_read_lines, args=(requests, lines), daemon=True).start()
    with os.fdopen(output, "wb") as answers:
        while (line := lines.get()) is not None:
            try:
                reply = answer(json.loads(line))
            except Exception as exc:
                traceback.print_exc()
                reply = {"error": describe(exc)}
            answers.write(json.dumps(reply, separators=(",", ":")).encode() + b"\n")
            answers.flush()


def describe(exc: BaseException) -> str:
    """Describe an exception in one line; for a group, its first exception that is not a group."""
    while isinstance(exc, BaseExceptionGroup):
        exc = exc.exceptions[0]
    return f"{type(exc).__name__}: {exc}"


def _read_lines(fd: int, lines: queue.SimpleQueue[bytes | None]) -> None:
    with os.fdopen(fd, "rb", buffering=0) as requests:
        for line in requests:
            lines.put(line)
    lines.put(None)
    time.sleep(5.0)
    os._exit(1)
