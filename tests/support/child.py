"""A Python module as a child process that answers commands: both ends, for tests and benchmarks.

The parent holds a :class:`Child`; the child runs :func:`serve_commands`. Commands are JSON lines on
the child's stdin, answers on a pipe of their own. A child ends when its stdin does, so none
outlives its parent.
"""

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
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, Self

from tests.support.times import LIMIT

__all__ = ["ROOT", "Child", "ChildError", "Unanswered", "describe", "serve_commands"]

ROOT = Path(__file__).parents[2]
STDERR = 2

ANSWERS = "ROSASYNC_TEST_ANSWERS"
"""The environment variable with the descriptor on which a child writes its answers.

Its stdout is not used, because the middleware logs errors there."""


class ChildError(Exception):
    """A command raised, which a note has the traceback of, or the child has ended."""


class Unanswered(ChildError):
    """A child did not answer a command, and was ended."""


class Child:
    """A child process, which starts at once and answers one command at a time.

    It belongs to no loop: a fixture of a whole run may make it, for any test to use.

    Args:
        module: the module, run with ``python -m`` and ``args``.
        prefix: the beginning of its command line, such as one that enters a network namespace.
        environment: environment variables beside those of this process.
        cores: the cores that it may use; None for all.
        quiet: whether its output is kept from this process's stderr, and shown only in the error
            if it ends too early.
    """

    def __init__(
        self,
        module: str,
        *args: str,
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
        cores: set[int] | None = None,
        quiet: bool = False,
    ) -> None:
        self.module = module
        self._lock = threading.Lock()
        self._command = [*prefix, sys.executable, "-X", "faulthandler", "-m", module, *args]
        self._environment = dict(environment or {})
        self._cores = cores
        self._log = tempfile.TemporaryFile() if quiet else None  # noqa: SIM115 - lives with it
        self._start({})

    def _start(self, variables: Mapping[str, str]) -> None:
        reading, writing = os.pipe()
        self._answers = os.fdopen(reading, "rb")
        output = STDERR if self._log is None else self._log
        try:
            # Its own session: the parent handles Ctrl-C, and a kill reaches grandchildren.
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                pass_fds=(writing,),
                cwd=ROOT,
                env=os.environ | variables | {ANSWERS: str(writing)} | self._environment,
                start_new_session=True,
            )
        finally:
            os.close(writing)
        if self._cores:
            os.sched_setaffinity(self.pid, self._cores)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    def ask_now(self, command: str, *, patience: float = 4 * LIMIT, **arguments: Any) -> Any:
        """Send a command and block until the child has answered it.

        A child that does not answer is ended, and its threads' stacks go to its stderr, or to the
        error's notes if it is quiet.

        Args:
            command: the name of the command. ``ready`` does nothing.
            patience: seconds to wait for its answer.
            arguments: those of the command.

        Raises:
            Unanswered: the child did not answer.
            ChildError: the command raised, or the child has ended.
        """
        with self._lock:
            try:
                self._stdin.write(json.dumps({"do": command, "with": arguments}).encode() + b"\n")
                self._stdin.flush()
            except BrokenPipeError:
                raise self._ended() from None
            ready, _, _ = select.select([self._answers], [], [], patience)
            if not ready:
                late = Unanswered(f"{self.module} did not answer {command!r} in {patience:g} s")
                late.add_note("\n".join(self.kill(stacks=True)))
                raise late
            line = self._answers.readline()
        if not line:
            raise self._ended()
        answer = json.loads(line)
        if "error" in answer:
            error = ChildError(answer["error"])
            error.add_note(answer["traceback"])
            raise error
        return answer["value"]

    def signal(self, number: int) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def kill(self, *, stacks: bool = False) -> list[str]:
        """End it as a crash does (SIGKILL), with every process that it started.

        Args:
            stacks: write its threads' stacks to its stderr before.

        Returns:
            The lines that it has written, if it is quiet and was not ended before.
        """
        if stacks:
            self.signal(signal.SIGABRT)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LIMIT / 4)
        lines = []
        if self._log is not None and not self._log.closed:
            self._log.seek(0)
            lines = self._log.read().decode(errors="replace").strip().splitlines()
        self._reap()
        return lines

    def interrupt(self) -> None:
        """End it as Ctrl-C does (SIGINT)."""
        self.signal(signal.SIGINT)
        self.close()

    def close(self) -> None:
        """Ask it to end by closing its stdin, and wait for that; kill it if it does not end."""
        with suppress(BrokenPipeError):
            self._stdin.close()
        try:
            self._process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self._hangs()
        self._reap()

    def _hangs(self) -> None:
        """Called by `close` if the child does not end."""
        self.kill(stacks=True)

    def _reap(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()
        self._answers.close()
        if self._log is not None:
            self._log.close()
        with suppress(BrokenPipeError):
            self._stdin.close()

    def _ended(self) -> ChildError:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(LIMIT)
        code = self._process.poll()
        last = self.kill()[-3:]
        return ChildError(" / ".join((f"{self.module} ended with code {code}", *last)))

    @property
    def _stdin(self) -> IO[bytes]:
        assert self._process.stdin is not None
        return self._process.stdin

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self.alive:
            self.close()
        else:
            self._reap()


def serve_commands(commands: object) -> None:
    """Answer the parent's commands one by one, until it closes the pipe or ends.

    If it ends while a command is stuck, this process ends some time later.

    Args:
        commands: a mapping with the function for each command, or an object whose methods they
            are. They are called with the command's arguments by keyword, and their return values
            are sent to the parent as JSON.
    """
    find: Callable[[str], Callable[..., Any]] = (
        commands.__getitem__ if isinstance(commands, Mapping) else partial(getattr, commands)
    )
    # A process that is forked from this one closes its stdin, which a thread may be reading here.
    requests = os.dup(0)
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    over = threading.Event()
    threading.Thread(target=_read_lines, args=(requests, lines, over), daemon=True).start()
    answers = os.fdopen(int(os.environ[ANSWERS]), "w")
    try:
        while (line := lines.get()) is not None:
            answers.write(json.dumps(_answer(find, json.loads(line)), separators=(",", ":")) + "\n")
            answers.flush()
    except BrokenPipeError:
        return
    finally:
        over.set()


def describe(error: BaseException) -> str:
    """Describe an exception in one line; for a group, its first exception that is not a group."""
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    return f"{type(error).__name__}: {error}"


def _answer(
    find: Callable[[str], Callable[..., Any]], message: Mapping[str, Any]
) -> dict[str, Any]:
    if message["do"] == "ready":
        return {"value": None}
    try:
        return {"value": find(message["do"])(**message["with"])}
    except Exception as error:
        return {"error": describe(error), "traceback": traceback.format_exc()}


def _read_lines(
    descriptor: int, lines: queue.SimpleQueue[bytes | None], over: threading.Event
) -> None:
    with os.fdopen(descriptor, "rb", buffering=0) as requests:
        for line in requests:
            lines.put(line)
    lines.put(None)
    # Longer than the parent waits before it looks at the threads' stacks.
    if not over.wait(2 * LIMIT):
        os._exit(1)
