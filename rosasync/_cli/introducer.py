"""Introduces the participants of a program that ``rosasync run`` starts.

`rosasync._ros.discovery` says what for. As the program takes the place of ``rosasync run``, another
process has to do it.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

from rosasync._ros.discovery import introduce, own_ports, ports_of, udp_sockets
from rosasync._ros.processes import PARENT, read_stat

__all__ = ["introduce_program"]

DURATION = 30.0
"""Seconds that the program has for creating its participants."""
POLL_MIN = 0.02
POLL_SHARE = 0.05
"""The interval between two looks, as a share of the time since the start."""
DELAYS = (0.05, 0.15, 0.5, 1.0)
"""Seconds after which a participant is introduced: it has its socket before it listens."""


def introduce_program(domain: int) -> None:
    """Start a process that introduces the participants of this one and of its children.

    It ends with this process, whatever program that has become, and at the latest after `DURATION`.
    """
    program = os.getpid()
    if program == 1:
        # In a container, this process would have to collect the other.
        return
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return
    try:
        # A child of its own would be a surprise to the program.
        if os.fork() == 0:
            _leave()
            _watch(program, domain)
    finally:
        os._exit(0)


def _leave() -> None:
    """Give up what keeps others waiting: the terminal, pipes and other files, and the folder."""
    os.setsid()
    os.chdir("/")
    for descriptor in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            os.close(int(descriptor))


def _watch(program: int, domain: int) -> None:
    """Introduce each new participant of a program, and of its children, several times."""
    start = time.monotonic()
    known: set[int] = set()
    due: list[tuple[float, int, int]] = []
    while (now := time.monotonic()) < start + DURATION and Path(f"/proc/{program}").exists():
        used = {port for port, _ in udp_sockets()} & {*ports_of(domain)}
        if used - known:
            for process in _family(program):
                for port in own_ports(domain, process) - known:
                    due += [(now + delay, port, process) for delay in DELAYS]
        known = used
        for when, port, process in [each for each in due if each[0] <= now]:
            due.remove((when, port, process))
            introduce(domain, port, process)
        time.sleep(POLL_MIN if due else max(POLL_MIN, POLL_SHARE * (now - start)))


def _family(program: int) -> set[int]:
    """Return the ids of a process and of all that it has started."""
    parents = {}
    for name in os.listdir("/proc"):
        if name.isdecimal():
            with suppress(OSError):
                parents[int(name)] = int(read_stat(name)[PARENT])
    family = {program}
    while more := {process for process, parent in parents.items() if parent in family} - family:
        family |= more
    return family
