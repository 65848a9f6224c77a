"""Chooses a port that no dead process has left behind, for the participant of a new process.

Every participant receives its messages at a port in shared memory, whose number is that of a UDP
port. A process that ends without its clean-up leaves its port behind. Its peers keep the dead
port open and write into it, also after another process has opened a new port of the same number:
their watchdogs notice that after some seconds, and the message that was lost comes again with the
heartbeat after that. So the next process of a host, which gets the same number, is not reached
for 3 to 5 s.

The participants of a domain are discovered at the metatraffic ports. The port for messages
follows from the metatraffic port and ``offsetd3``, and is announced. So another offset is another
port, and changes nothing else.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import re
import time
from collections.abc import Iterable
from pathlib import Path

from rosasync._ros.discovery import BASE, DOMAIN_GAIN, PARTICIPANT_GAIN, UNICAST, udp_sockets
from rosasync._ros.profile import is_old

__all__ = [
    "FOLDER",
    "LEASE",
    "LOCK",
    "dead_ports",
    "fresh_offset",
    "live_ports",
    "own_ports",
    "port_prefix",
]

FOLDER = Path("/dev/shm")
LOCK = "_el"
"""The end of the name of a lock file. The reader of the port holds the lock while it lives."""
SHARED_LOCK = "_sl"
"""The same for a port with several readers, which belongs to no single process."""
LEASE = 20.0
"""Seconds after which no peer writes to a dead process any more: the lease of a participant."""
LAST_PORT = 65535


def port_prefix() -> str:
    """Return the beginning of the name of a port's file."""
    return "fastrtps_port" if is_old() else "fastdds_port"


def fresh_offset(domain: int, current: int | None = None) -> int | None:
    """Choose the ``offsetd3`` that gives the next participant a port that no process left behind.

    Prefers a number that no process has used, then one that was closed, then one whose process is
    dead for so long that no peer can write to it. Among equals it chooses at random, because other
    processes choose at the same time: the second gets the next number.

    Args:
        domain: the ROS domain.
        current: the offset to keep if its port is good enough.

    Returns:
        None if there is no such port, or if there is no shared memory.
    """
    try:
        names = os.listdir(FOLDER)
    except OSError:
        return None
    udp = {port for port, _ in udp_sockets()}
    first = BASE + DOMAIN_GAIN * domain
    end = min(first + DOMAIN_GAIN, LAST_PORT + 1)
    metatraffic = next(
        (p for p in range(first + UNICAST, end, PARTICIPANT_GAIN) if p not in udp), end
    )
    candidates = {*range(metatraffic + 1, end, PARTICIPANT_GAIN)} - udp
    left = candidates - _numbers(names, rf"{port_prefix()}(\d+)(?:{LOCK})?")
    if current is not None and metatraffic + current - UNICAST in left:
        return current
    unused = left - _numbers(names, rf"sem\.{port_prefix()}(\d+)_mutex")
    chosen = _choose(unused) or _choose(left) or _oldest_dead(candidates - left)
    return None if chosen is None else chosen - metatraffic + UNICAST


def dead_ports(domain: int) -> list[Path]:
    """Return the files of the ports that a new process of the domain may open and a dead one had.

    Those are the domain's, and those below `BASE`, which are common to all domains.
    """
    numbers = _there() & {*range(BASE), *_of(domain)}
    files = [file for number in sorted(numbers) if _is_dead(number) for file in _files(number)]
    return [file for file in files if file.exists()]


def live_ports(domain: int) -> dict[int, tuple[Path, int]]:
    """Return the ports of the domain that a process reads from, with their file and its user."""
    found = {}
    for number in _there() & {*_of(domain)}:
        file = _files(number)[0]
        with contextlib.suppress(OSError):
            if not _is_dead(number):
                found[number] = (file, file.stat().st_uid)
    return found


def own_ports() -> set[int]:
    """Return the numbers of the ports that this process reads from."""
    names = []
    for descriptor in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            names.append(os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}")))
    return _numbers(names, rf"{port_prefix()}(\d+){LOCK}")


def _there() -> set[int]:
    """Return the numbers of all ports that have a file."""
    try:
        names = os.listdir(FOLDER)
    except OSError:
        return set()
    return _numbers(names, rf"{port_prefix()}(\d+)(?:{LOCK})?")


def _of(domain: int) -> range:
    """Return the numbers of the ports of a domain."""
    first = BASE + DOMAIN_GAIN * domain
    return range(first, first + DOMAIN_GAIN)


def _choose(ports: set[int]) -> int | None:
    """Choose one at random, if possible one whose successor is there as well."""
    better = [port for port in ports if port + PARTICIPANT_GAIN in ports]
    return random.choice(better or [*ports]) if ports else None


def _oldest_dead(ports: Iterable[int]) -> int | None:
    """Return the dead port that was created first, if it is older than the lease.

    The files do not tell when their process died. With all numbers of the domain in use, the
    oldest is the best guess.
    """
    ages = {port: age for port in ports if (age := _age(port)) > LEASE}
    oldest = sorted(ages, key=ages.__getitem__, reverse=True)
    return next(filter(_is_dead, oldest), None)


def _age(number: int) -> float:
    """Return the seconds since the newest file of a port was created, 0 if there is none."""
    times = []
    for file in _files(number):
        with contextlib.suppress(OSError):
            times.append(file.stat().st_mtime)
    return time.time() - max(times, default=time.time())


def _is_dead(number: int) -> bool:
    """Return whether no process reads from the port, as far as this user may know."""
    if (FOLDER / f"{port_prefix()}{number}{SHARED_LOCK}").exists():
        return False
    try:
        lock = os.open(_files(number)[1], os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(lock)
    return True


def _files(number: int) -> tuple[Path, Path]:
    """Return the segment and the lock of a port."""
    name = f"{port_prefix()}{number}"
    return FOLDER / name, FOLDER / f"{name}{LOCK}"


def _numbers(names: Iterable[str], pattern: str) -> set[int]:
    found = (re.fullmatch(pattern, name) for name in names)
    return {int(match[1]) for match in found if match}
