"""From the start of a process that replaces a killed one to its first answer.

The other side is stock and stays. As its predecessor was killed, each process is reached late if it
takes the port in shared memory that was left behind. In one more trial, the killed server had the
calls of its caller, which is of the same kind as the server.
"""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.names import check_names
from benchmarks.pages import markdown_table
from benchmarks.server import WorkServer
from benchmarks.sharing import BEFORE, older
from benchmarks.trials import Trials
from benchmarks.work import Work
from tests.support.child import ROOT
from tests.support.hosts import Hosts, own_shared_memory

__all__ = [
    "COMMAND",
    "CONTESTANTS",
    "LOCALHOST",
    "OURS",
    "PLACES",
    "SIDES",
    "STOCK",
    "Place",
    "Restart",
    "check_contestants",
    "heading",
    "measure",
    "placed",
    "rows",
    "section",
]

COMMAND = "crash"
DISCOVERY = "ROS_AUTOMATIC_DISCOVERY_RANGE"
WORK = Work(srv_name="/bench/crash")
NAME = WORK.names[0]
STOCK, RUN, OURS = "stock", "stock with rosasync run", "rosasync"
CONTESTANTS = (STOCK, BEFORE, OURS, RUN)
PATIENCE = 60.0
"""Seconds after which an answer counts as missing."""
SLOW = 1.0
OUT = 10
"""Calls that are out at the server that is killed, and one more waits."""
CLIENT, SERVER, HELD = "client", "server", f"server with {OUT} calls out"
SIDES = (CLIENT, SERVER, HELD)
STOPPED = 0.6
"""Seconds for which that server takes no requests before it is killed."""

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
OUR_CALLER = f"""\
import asyncio, rosasync, time
from std_srvs.srv import Empty
async def call(session):
    while True:
        try:
            await session.call(Empty, "{NAME}", timeout=10.0)
        except rosasync.CallError:
            continue
        print("answered", time.monotonic(), flush=True)
        await asyncio.sleep(0.05)
async def main():
    async with rosasync.Session("stays") as session, asyncio.TaskGroup() as group:
        for _ in range({OUT + 1}):
            group.create_task(call(session))
asyncio.run(main())
"""


@dataclass(frozen=True)
class Place:
    """Where the processes run.

    Attributes:
        name: its name in the table.
        mortal: the start of the commands of the processes that are killed.
        peer: the start of the commands of those that stay.
        environment: variables for all of them.
    """

    name: str
    mortal: Sequence[str] = ()
    peer: Sequence[str] = ()
    environment: Mapping[str, str] = field(default_factory=dict)


LOCALHOST, SUBNET, ONE, TWO = "LOCALHOST", "SUBNET", "one namespace", "two namespaces"
CONTAINERS = "two containers"
PLACES = (LOCALHOST, SUBNET, ONE, TWO, CONTAINERS)
"""This host with either range of discovery; network namespaces, which share the host's memory: one
for all, one for those that are killed and one for those that stay; the same without a common
``/dev/shm``, as in containers."""


@contextmanager
def placed(name: str) -> Iterator[Place]:
    """Make a place, which is there until the end of the block.

    Raises:
        NoHosts: network namespaces cannot be created on this machine.
    """
    if name in (LOCALHOST, SUBNET):
        yield Place(name, environment={DISCOVERY: name})
        return
    with Hosts() as hosts:
        if name == ONE:
            yield Place(name, hosts.on_server, hosts.on_server, {DISCOVERY: LOCALHOST})
            return
        inside = own_shared_memory("64m") if name == CONTAINERS else ()
        mortal, peer = ([*host, *inside] for host in (hosts.on_client, hosts.on_server))
        yield Place(name, mortal, peer, {DISCOVERY: SUBNET})


@dataclass(frozen=True)
class Restart:
    """One process that replaces a killed one.

    Attributes:
        side: what it is, `CLIENT`, `SERVER` or `HELD`.
        contestant: which program it runs.
        seconds: for a client, from its call to the answer; for a server, from its being ready to
            the next answer that the caller gets. None if there was none.
        place: the name of the place.
    """

    side: str
    contestant: str
    seconds: float | None
    place: str = LOCALHOST


def check_contestants(contestants: Sequence[str], before: Path | None) -> Sequence[str]:
    """Return the contestants that can be measured.

    Raises:
        ValueError: one does not exist.
    """
    check_names("contestant", contestants, CONTESTANTS)
    return [name for name in contestants if name != BEFORE or before is not None]


def measure(
    contestants: Sequence[str],
    restarts: int,
    place: Place,
    before: Path | None = None,
    on_restart: Callable[[Restart], object] = lambda restart: None,
    sides: Sequence[str] = SIDES,
) -> list[Restart]:
    """Kill and replace processes; each contestant has peers of its own, which stay."""
    found = []
    with older(before) as older_environment:
        for contestant in contestants:
            environment = older_environment if contestant == BEFORE else {}
            for side in sides:
                for seconds in _TRIALS[side](_Kind(contestant, environment, place), restarts):
                    found.append(Restart(side, contestant, seconds, place.name))
                    on_restart(found[-1])
    return found


heading = ["", "replaced", "restarts", "p50 s", "longest s", f"over {SLOW:g} s", "no answer"]


def rows(restarts: Sequence[Restart]) -> list[list[str]]:
    """Return a row for each contestant and side."""
    groups = dict.fromkeys((r.place, r.side, r.contestant) for r in restarts)
    return [_row(*group, restarts) for group in sorted(groups)]


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
            f"shortens. In the trial with {OUT} calls out, the server is stopped until they are, "
            "and the time is that of the next call of the same caller, which is a session for a "
            "rosasync server. `--places` measures it elsewhere: with `SUBNET`, in one network "
            "namespace, between two (which share the host's memory), and between two containers "
            "(which do not).\n",
            f"{trials.conditions}\n",
            markdown_table(heading, rows(restarts)),
        )
    )


def _row(place: str, side: str, contestant: str, restarts: Sequence[Restart]) -> list[str]:
    group = (place, side, contestant)
    own = [r.seconds for r in restarts if (r.place, r.side, r.contestant) == group]
    times = [seconds for seconds in own if seconds is not None]
    figures = (
        [f"{seconds:.2f}" for seconds in np.percentile(times, (50, 100))] if times else ["-"] * 2
    )
    slow = sum(seconds > SLOW for seconds in times)
    where = "" if place == LOCALHOST else f", {place}"
    counts = (str(slow), str(len(own) - len(times)))
    return [contestant, side + where, str(len(own)), *figures, *counts]


@dataclass(frozen=True)
class _Kind:
    """Which programs one trial runs, and where."""

    contestant: str
    variables: Mapping[str, str]
    place: Place

    @property
    def ours(self) -> bool:
        return self.contestant in (OURS, BEFORE)

    def succession(self, program: str, restarts: int) -> Iterator[_Process]:
        """Yield processes, of which each begins as soon as its predecessor is killed.

        It has been started before, as Python and its imports take longer than the peers'
        watchdogs.
        """
        run = (sys.executable, "-m", "rosasync", "run", "--") if self.contestant == RUN else ()
        current = None
        try:
            for _ in range(restarts + 1):
                successor = self._start((*self.place.mortal, *run), program)
                successor.find("standby")
                if current is not None:
                    current.kill()
                current = successor
                current.begin()
                yield current
        finally:
            if current is not None:
                current.kill()

    @contextmanager
    def caller(self, program: str) -> Iterator[_Process]:
        """Start a process that calls all the time and stays."""
        caller = self._start(self.place.peer, program)
        try:
            yield caller
        finally:
            caller.kill()

    def _start(self, prefix: Sequence[str], program: str) -> _Process:
        environment = {**self.place.environment, **self.variables}
        return _Process((*prefix, sys.executable, "-c", program), environment)


def _replace_clients(kind: _Kind, restarts: int) -> Iterator[float | None]:
    program = OUR_CLIENT if kind.ours else STOCK_CLIENT
    place = kind.place
    with WorkServer(WORK, prefix=place.peer, environment=place.environment):
        for restart, client in enumerate(kind.succession(program, restarts)):
            answer = client.find("answered")
            # The first one has no predecessor.
            if restart:
                yield None if answer is None else answer[1] - answer[0]


def _replace_servers(kind: _Kind, restarts: int) -> Iterator[float | None]:
    with kind.caller(CALLER) as caller:
        for restart, server in enumerate(kind.succession(_server(kind), restarts)):
            seconds = _next_answer(server, caller)
            if restart:
                yield seconds


def _replace_held_servers(kind: _Kind, restarts: int) -> Iterator[float | None]:
    # A caller has all its calls out only once: the next restart has another.
    program = OUR_CALLER if kind.ours else CALLER
    with ExitStack() as stack:
        caller = None
        for server in kind.succession(_server(kind), restarts):
            if caller is not None:
                yield _next_answer(server, caller)
                stack.close()
            caller = stack.enter_context(kind.caller(program))
            caller.find("answered")
            server.stop()
            time.sleep(STOPPED)


def _server(kind: _Kind) -> str:
    return OUR_SERVER if kind.ours else STOCK_SERVER


def _next_answer(server: _Process, caller: _Process) -> float | None:
    """Return the seconds from a server's being ready to the caller's next answer."""
    ready = server.find("ready")
    answer = None if ready is None else caller.find("answered", after=ready[0])
    return None if ready is None or answer is None else answer[0] - ready[0]


_TRIALS = {CLIENT: _replace_clients, SERVER: _replace_servers, HELD: _replace_held_servers}


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

    def stop(self) -> None:
        """Let it do nothing any more, until it is killed."""
        self._process.send_signal(signal.SIGSTOP)

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
