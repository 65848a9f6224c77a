"""Child processes of the tests, driven by JSON lines on their stdin and answered on a pipe.

The parent holds a :class:`Child`; the child runs :func:`serve_commands`. A child ends when its
stdin does, so none outlives the tests.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, AnyStr, Self

from tests.support.times import LIMIT

__all__ = [
    "Child",
    "ChildError",
    "Unanswered",
    "ended",
    "first_line",
    "own",
    "profile",
    "serve_commands",
]

ROOT = Path(__file__).parents[2]
SHARED_MEMORY = Path("/dev/shm")
PORTS = ("fastrtps_port", "fastdds_port")
STDERR = 2

_LOGGED = re.compile(r"^\S*\d{4}-\d\d-\d\d [\d:.]+ .*\[.*(RTPS|DDS|SHM).*-> Function ")

ANSWERS = "ROSASYNC_TEST_ANSWERS"
"""The environment variable with the descriptor on which a child writes its answers.

Its stdout is not used, because the middleware logs errors there."""

_PROFILE_VARIABLE = (
    "FASTRTPS_DEFAULT_PROFILES_FILE"
    if version("rclpy").startswith("7.")
    else "FASTDDS_DEFAULT_PROFILES_FILE"
)

# Every test opens new sessions. A process that announces itself twice a second instead of every
# 3 s is found at once, even by a session that replaces another. Not more often: Fast DDS can
# deadlock if an announcement is due while a peer's endpoint is removed
# (https://github.com/eProsima/Fast-DDS/issues/6502). A response waits up to 3 s for its client to
# be matched: if a discovery packet is lost, the usual 0.1 s is not enough.
_PROFILE = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="child" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>{seconds}</sec></leaseDuration>
    <leaseAnnouncement><sec>0</sec><nanosec>{announcement}</nanosec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
  <publisher profile_name="service"><qos><reliability>
    <max_blocking_time><sec>3</sec></max_blocking_time>
  </reliability></qos></publisher>
</profiles>
"""


@contextmanager
def profile(lease: int = 20) -> Iterator[dict[str, str]]:
    """Write the middleware's profile for a child; yield the variable that names it."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "profile.xml"
        announcement = min(lease * 200_000_000, 500_000_000)
        file.write_text(_PROFILE.format(seconds=lease, announcement=announcement))
        yield {_PROFILE_VARIABLE: str(file)}


def own(output: str) -> str:
    """Leave out the lines that Fast DDS logs, on stdout unless a profile says otherwise.

    On a busy machine a port in shared memory may be gone while its process still holds the lock.
    Then every new participant of the machine logs that it cannot lock the port, and takes another
    (https://github.com/eProsima/Fast-DDS/issues/5737).
    """
    return "".join(line for line in output.splitlines(True) if not _LOGGED.search(line))


def first_line(output: Iterable[str]) -> str:
    """Read up to the first line that is the program's own; empty if there is none."""
    return next((line for line in output if own(line)), "")


@contextmanager
def ended(process: subprocess.Popen[AnyStr]) -> Iterator[subprocess.Popen[AnyStr]]:
    """Terminate a process at the end of the block, also if the block raises."""
    with process:
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(LIMIT / 4)
            except subprocess.TimeoutExpired:
                # rclpy's signal handler shuts the context down, but does not always wake its spin.
                process.kill()


class ChildError(Exception):
    """An exception in the child, with its traceback."""


class Unanswered(AssertionError):
    """A child did not answer a command, and was ended."""


class Child:
    """A child process that runs one of the modules beside this one.

    It belongs to no loop: a fixture of the whole run may make it, for any test to use.

    Args:
        lease: seconds after which other processes notice that this one was killed.
        prefix: the beginning of its command line, such as one that enters a network namespace.
        environment: environment variables beside those of this process.
    """

    module: str
    stock = True
    """Whether it runs stock rclpy only, which may hang in the middleware when the process ends."""

    def __init__(
        self,
        *args: str,
        lease: int = 20,
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._lock = threading.Lock()
        self._command = [*prefix, sys.executable, "-X", "faulthandler", "-m", self.module, *args]
        self._lease = lease
        self._environment = dict(environment or {})
        self._start()

    def _start(self) -> None:
        with profile(self._lease) as variables:
            reading, writing = os.pipe()
            self._answers = os.fdopen(reading, "rb")
            try:
                self._process = subprocess.Popen(
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=STDERR,
                    pass_fds=(writing,),
                    cwd=ROOT,
                    env=os.environ | variables | {ANSWERS: str(writing)} | self._environment,
                )
            finally:
                os.close(writing)
            try:
                self.ask_now("ready")
            except BaseException:
                self.kill()
                raise

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    @property
    def cpu_seconds(self) -> float:
        """User and system time the child has used so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def ask_now(self, command: str, *, patience: float = 4 * LIMIT, **arguments: Any) -> Any:
        """Send a command and block until the child has answered it.

        A child that does not answer is ended, and its threads' stacks go to stderr: the next test
        gets another.

        Args:
            command: the name of the command.
            patience: seconds to wait for its answer.
            arguments: those of the command.

        Raises:
            Unanswered: the child did not answer.
            ChildError: the command raised.
        """
        with self._lock:
            self._stdin.write(json.dumps({"do": command, "with": arguments}).encode() + b"\n")
            self._stdin.flush()
            ready, _, _ = select.select([self._answers], [], [], patience)
            if not ready:
                self.kill(stacks=True)
                raise Unanswered(f"{self.module} did not answer {command!r}")
            line = self._answers.readline()
        if not line:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LIMIT)
            code = self._process.poll()
            self.kill()
            raise AssertionError(f"{self.module} ended with code {code}")
        answer = json.loads(line)
        if "error" in answer:
            raise ChildError(answer["error"])
        return answer["value"]

    async def ask(self, command: str, **arguments: Any) -> Any:
        """Send a command and wait for the answer without blocking the loop."""
        return await asyncio.to_thread(self.ask_now, command, **arguments)

    def restart(self) -> None:
        """Start it again after it was `Unanswered`.

        For the first command that a test gives a stock process. Fast DDS may wait forever for a
        port in shared memory whose creator was killed, or for itself
        (https://github.com/eProsima/Fast-DDS/issues/3878 and 6502).
        """
        assert self.stock
        self._start()

    def kill(self, *, stacks: bool = False) -> None:
        """End it as a crash does (SIGKILL), and remove the shared memory it leaves behind.

        Args:
            stacks: write its threads' stacks to stderr before.
        """
        leftovers = self._shared_memory()
        if stacks:
            self._process.send_signal(signal.SIGABRT)
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LIMIT / 4)
        self._process.kill()
        self._reap()
        for file in leftovers:
            file.unlink(missing_ok=True)

    def interrupt(self) -> None:
        """End it as Ctrl-C does (SIGINT), which rclpy's signal handlers do not see here."""
        self._process.send_signal(signal.SIGINT)
        self.close()

    def close(self) -> None:
        """Ask it to end by closing its stdin, and wait for that; kill it if it does not end."""
        with suppress(BrokenPipeError):
            self._stdin.close()
        try:
            self._process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self.kill(stacks=True)
            if not self.stock:
                raise
        self._reap()

    def _reap(self) -> None:
        self._process.wait()
        self._answers.close()
        with suppress(BrokenPipeError):
            self._stdin.close()

    @property
    def _stdin(self) -> IO[bytes]:
        assert self._process.stdin is not None
        return self._process.stdin

    def _shared_memory(self) -> list[Path]:
        """The Fast DDS segments of this process: it holds the lock file ``…_el`` of each.

        Not its ports: their numbers are shared by all domains of the machine, and another process
        may have taken one over by the time it is removed.
        """
        files: list[Path] = []
        for descriptor in Path(f"/proc/{self.pid}/fd").glob("*"):
            with suppress(OSError):
                lock = descriptor.readlink()
                is_port = lock.name.startswith(PORTS)
                if lock.parent == SHARED_MEMORY and lock.name.endswith("_el") and not is_port:
                    files += [lock, lock.with_name(lock.name.removesuffix("_el"))]
        return files

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self.alive:
            self.close()
        else:
            self._reap()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await asyncio.to_thread(self.__exit__, *exc)


def serve_commands(commands: Mapping[str, Callable[..., Any]]) -> None:
    """Answer the parent's commands one by one, until it closes the pipe or ends.

    Args:
        commands: the function for each command. It is called with the command's arguments by
            keyword, and its return value is sent to the parent as JSON.
    """
    commands = {"ready": lambda: None, **commands}
    answers = os.fdopen(int(os.environ[ANSWERS]), "w")
    for line in sys.stdin.buffer:
        message = json.loads(line)
        try:
            answer = {"value": commands[message["do"]](**message["with"])}
        except Exception:
            answer = {"error": traceback.format_exc()}
        try:
            answers.write(json.dumps(answer) + "\n")
            answers.flush()
        except BrokenPipeError:
            return
