"""From the start of a process that replaces a killed one to its first answer.

The other side is stock and stays. As its predecessor was killed, each process is reached late if it
takes the port in shared memory that was left behind.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.pages import markdown_table
from benchmarks.server import WorkServer
from benchmarks.sharing import BEFORE, older
from benchmarks.trials import Trials
from benchmarks.work import Work
from tests.support.child import ROOT

__all__ = [
    "COMMAND",
    "CONTESTANTS",
    "Restart",
    "check_contestants",
    "heading",
    "measure",
    "rows",
    "section",
]

COMMAND = "crash"
WORK = Work(srv_name="/bench/crash")
NAME = WORK.names[0]
STOCK, RUN, OURS = "stock", "stock with rosasync run", "rosasync"
CONTESTANTS = (STOCK, BEFORE, OURS, RUN)
PATIENCE = 60.0
"""Seconds after which an answer counts as missing."""
SLOW = 1.0
CLIENT, SERVER = "client", "server"

STOCK_CLIENT = f"""\
import rclpy, time
from std_srvs.srv import Empty
print("standby", flush=True)
input()
rclpy.init()
node = rclpy.create_node("mortal")
client = node.create_client(Empty, "{NAME}")
begin = time.monotonic()
client.wait_for_service()
rclpy.spin_until_future_complete(node, client.call_async(Empty.Request()))
print("answered", begin, time.monotonic(), flush=True)
time.sleep(60)
"""
OUR_CLIENT = f"""\
import asyncio, rclpy, rosasync, time
from std_srvs.srv import Empty
print("standby", flush=True)
input()
async def main():
    async with rosasync.Session("mortal", timeout=None) as session:
        begin = time.monotonic()
        await session.call(Empty, "{NAME}")
        print("answered", begin, time.monotonic(), flush=True)
        await asyncio.sleep(60)
asyncio.run(main())
"""
STOCK_SERVER = f"""\
import rclpy, time
from std_srvs.srv import Empty
print("standby", flush=True)
input()
rclpy.init()
node = rclpy.create_node("mortal")
node.create_service(Empty, "{NAME}", lambda request, response: response)
print("ready", time.monotonic(), flush=True)
rclpy.spin(node)
"""
OUR_SERVER = f"""\
import asyncio, rclpy, rosasync, time
from std_srvs.srv import Empty
print("standby", flush=True)
input()
async def main():
    async with rosasync.Session("mortal") as session:
        session.serve(Empty, "{NAME}", lambda request, response: response)
        print("ready", time.monotonic(), flush=True)
        await asyncio.sleep(60)
asyncio.run(main())
"""
CALLER = f"""\
import rclpy, time
from std_srvs.srv import Empty
rclpy.init()
node = rclpy.create_node("stays")
client = node.create_client(Empty, "{NAME}")
def answered(future):
    print("answered", time.monotonic(), flush=True)
node.create_timer(0.05, lambda: client.call_async(Empty.Request()).add_done_callback(answered))
rclpy.spin(node)
"""
"""Calls all the time, and prints when it gets an answer."""


@dataclass(frozen=True)
class Restart:
    """One process that replaces a killed one.

    Attributes:
        side: what it is, ``client`` or ``server``.
        contestant: which program it runs.
        seconds: for a client, from its call to the answer; for a server, from its being ready to
            the next answer that the caller gets. None if there was none.
    """

    side: str
    contestant: str
    seconds: float | None


def check_contestants(contestants: Sequence[str], before: Path | None) -> Sequence[str]:
    """Return the contestants that can be measured.

    Raises:
        ValueError: one does not exist.
    """
    if unknown := set(contestants) - set(CONTESTANTS):
        raise ValueError(f"no contestant {', '.join(sorted(unknown))}; there are {CONTESTANTS}")
    return [name for name in contestants if name != BEFORE or before is not None]


def measure(
    contestants: Sequence[str],
    restarts: int,
    before: Path | None = None,
    on_restart: Callable[[Restart], object] = lambda restart: None,
) -> list[Restart]:
    """Kill and replace processes; each contestant has peers of its own, which stay."""
    found = []
    with older(before) as older_environment:
        for contestant in contestants:
            environment = older_environment if contestant == BEFORE else {}
            for side, trial in ((CLIENT, _replace_clients), (SERVER, _replace_servers)):
                for seconds in trial(contestant, restarts, environment):
                    found.append(Restart(side, contestant, seconds))
                    on_restart(found[-1])
    return found


heading = ["", "replaced", "restarts", "p50 s", "longest s", f"over {SLOW:g} s", "no answer"]


def rows(restarts: Sequence[Restart]) -> list[list[str]]:
    """Return a row for each contestant and side."""
    groups = dict.fromkeys((restart.side, restart.contestant) for restart in restarts)
    return [_row(side, contestant, restarts) for side, contestant in sorted(groups)]


def section(trials: Trials) -> str:
    """Return the section of the documentation's page."""
    restarts = [Restart(**found) for found in trials.rows]
    return "\n".join(
        (
            "## After a crash\n",
            "`python -m benchmarks cold --after-crash`. Processes are killed and replaced one "
            "after the other. For a client: from its call to the answer of a stock server that "
            "stays. For a server: from its being ready to the next answer at a stock client that "
            "calls all the time. The time of a client has its discovery in it, which a session "
            "shortens.\n",
            f"{trials.conditions}\n",
            markdown_table(heading, rows(restarts)),
        )
    )


def _row(side: str, contestant: str, restarts: Sequence[Restart]) -> list[str]:
    own = [r.seconds for r in restarts if (r.side, r.contestant) == (side, contestant)]
    times = [seconds for seconds in own if seconds is not None]
    figures = (
        [f"{seconds:.2f}" for seconds in np.percentile(times, (50, 100))] if times else ["-"] * 2
    )
    slow = sum(seconds > SLOW for seconds in times)
    return [contestant, side, str(len(own)), *figures, str(slow), str(len(own) - len(times))]


def _replace_clients(
    contestant: str, restarts: int, environment: Mapping[str, str]
) -> Iterator[float | None]:
    program = OUR_CLIENT if contestant in (OURS, BEFORE) else STOCK_CLIENT
    with WorkServer(WORK):
        for restart, client in enumerate(_succession(contestant, program, restarts, environment)):
            answer = client.find("answered")
            # The first one has no predecessor.
            if restart:
                yield None if answer is None else answer[1] - answer[0]


def _replace_servers(
    contestant: str, restarts: int, environment: Mapping[str, str]
) -> Iterator[float | None]:
    program = OUR_SERVER if contestant in (OURS, BEFORE) else STOCK_SERVER
    caller = _Process((sys.executable, "-c", CALLER), {})
    try:
        for restart, server in enumerate(_succession(contestant, program, restarts, environment)):
            ready = server.find("ready")
            answer = None if ready is None else caller.find("answered", after=ready[0])
            if restart:
                yield None if ready is None or answer is None else answer[0] - ready[0]
    finally:
        caller.kill()


def _succession(
    contestant: str, program: str, restarts: int, environment: Mapping[str, str]
) -> Iterator[_Process]:
    """Yield processes, of which each begins as soon as its predecessor is killed.

    It has been started before, as Python and its imports take longer than the peers' watchdogs.
    """
    prefix = (sys.executable, "-m", "rosasync", "run", "--") if contestant == RUN else ()
    current = None
    try:
        for _ in range(restarts + 1):
            successor = _Process((*prefix, sys.executable, "-c", program), environment)
            successor.find("standby")
            if current is not None:
                current.kill()
            current = successor
            current.begin()
            yield current
    finally:
        if current is not None:
            current.kill()


class _Process:
    """A program that prints lines of a word and times, and waits for a line to begin."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def begin(self) -> None:
        """Let it begin."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def find(self, word: str, *, after: float = 0.0) -> tuple[float, ...] | None:
        """Wait for a line with this word; return its times, None after `PATIENCE`."""
        end = time.monotonic() + PATIENCE
        with suppress(queue.Empty):
            while (left := end - time.monotonic()) > 0:
                first, *times = self._lines.get(timeout=left).split()
                if first == word and (not times or float(times[-1]) >= after):
                    return tuple(map(float, times))
        return None

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.kill()
        self._process.wait()
        self._reader.join()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(line)
