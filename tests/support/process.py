"""Processes of nodes for the tests, and the ends of programs."""

from __future__ import annotations

import asyncio
import os
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, AnyStr, Self

from tests.support.child import ROOT, Child, Unanswered
from tests.support.times import LIMIT

__all__ = ["ROOT", "NodeProcess", "ended", "first_line", "own", "profile"]

SHARED_MEMORY = Path("/dev/shm")
PORTS = ("fastrtps_port", "fastdds_port")

_LOGGED = re.compile(r"^\S*\d{4}-\d\d-\d\d [\d:.]+ .*\[.*(RTPS|DDS|SHM).*-> Function ")

_PROFILE_VARIABLE = (
    "FASTRTPS_DEFAULT_PROFILES_FILE"
    if version("rclpy").startswith("7.")
    else "FASTDDS_DEFAULT_PROFILES_FILE"
)

# A response waits up to 3 s for its client to be matched: if a discovery packet is lost, the usual
# 0.1 s is not enough.
_PROFILE = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="child" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>{lease}</sec></leaseDuration>
    <leaseAnnouncement><sec>{seconds}</sec><nanosec>{nanoseconds}</nanosec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
  <publisher profile_name="service"><qos><reliability>
    <max_blocking_time><sec>3</sec></max_blocking_time>
  </reliability></qos></publisher>
</profiles>
"""


LEASE = 600
"""Seconds after which others notice that a child was killed, unless its test wants it sooner. Not
the usual 20: Fast DDS looks at each other process whenever a lease of it has passed, and deadlocks
if it is removing an endpoint at that moment, as it does when a test ends its session
(https://github.com/eProsima/Fast-DDS/issues/6502). The stacks of a stock process that answered no
more, in one of nine runs of its module beside load, showed that.
"""
ANNOUNCEMENT = 3 * 10**9
"""Nanoseconds between two announcements of a child, as usual. At each there is the same deadlock: a
stock server that announced itself twice a second was found in it.
"""


@contextmanager
def profile(lease: int = LEASE) -> Iterator[dict[str, str]]:
    """Write the middleware's profile for a child; yield the variable that names it."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "profile.xml"
        seconds, nanoseconds = divmod(min(lease * 10**9 // 5, ANNOUNCEMENT), 10**9)
        file.write_text(_PROFILE.format(lease=lease, seconds=seconds, nanoseconds=nanoseconds))
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


class NodeProcess(Child):
    """A child process that runs one of the modules beside this one.

    Args:
        lease: seconds after which other processes notice that this one was killed.
        options: those of `Child`.
    """

    module: str
    stock = True
    """Whether it runs stock rclpy only, which may hang in the middleware when the process ends."""

    def __init__(self, *args: str, lease: int = LEASE, **options: Any) -> None:
        self._lease = lease
        super().__init__(self.module, *args, **options)

    def _start(self, variables: Mapping[str, str]) -> None:
        with profile(self._lease) as written:
            super()._start({**variables, **written})
            try:
                self.ask_now("ready")
            except BaseException:
                self.kill()
                raise

    @property
    def cpu_seconds(self) -> float:
        """User and system time the child has used so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

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
        self._start({})

    def ask_first(self, command: str, *, patience: float = 4 * LIMIT, **arguments: Any) -> Any:
        """Give it the first command of a test, once more to a new process if it is `Unanswered`.

        Args:
            command: the name of the command.
            patience: seconds to wait for the first answer.
            arguments: those of the command.
        """
        try:
            return self.ask_now(command, patience=patience, **arguments)
        except Unanswered:
            self.restart()
            return self.ask_now(command, **arguments)

    def kill(self, *, stacks: bool = False) -> list[str]:
        """End it as a crash does (SIGKILL), and remove the shared memory it leaves behind.

        Args:
            stacks: write its threads' stacks to stderr before.

        Returns:
            The lines that it has written, if it is quiet and was not ended before.
        """
        leftovers = self._shared_memory()
        lines = super().kill(stacks=stacks)
        for file in leftovers:
            file.unlink(missing_ok=True)
        return lines

    def _hangs(self) -> None:
        super()._hangs()
        if not self.stock:
            raise AssertionError(f"{self.module} did not end")

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

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await asyncio.to_thread(self.__exit__, *exc)
