"""Ports of Fast DDS in shared memory that were left unfinished: each would block a newcomer."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

from rosasync.errors import RosasyncError
from rosasync.profile import is_old

__all__ = ["check_ports", "describe", "remedy", "unfinished_ports"]

FOLDER = Path("/dev/shm")
READY = 2
"""The first word of a segment that boost has initialised (``managed_open_or_create_impl.hpp``)."""
GRACE = 2.0
"""Seconds after which a port that is being created counts as left unfinished."""

FIRST_OF_ALL, FIRST, PER_DOMAIN = 7000, 7400, 250
"""The ports of every domain begin at the first; those of a domain as in RTPS 2.5, 9.6.1."""


def unfinished_ports(domain: int) -> list[Path]:
    """Find the ports that would block a participant of this domain for ever.

    Every participant opens ports in shared memory, the free one with the lowest number. A process
    that dies while it creates one, or finds no memory for it, leaves a file that never becomes
    ready, and Fast DDS waits until it does (https://github.com/eProsima/Fast-DDS/issues/3878).

    Returns:
        The files: they are empty, or begin with a word that says that they are not ready.
    """
    prefix = "fastrtps_port" if is_old() else "fastdds_port"
    begin = FIRST + domain * PER_DOMAIN
    found = []
    for file in sorted(FOLDER.glob(f"{prefix}*")):
        number = re.fullmatch(rf"{prefix}(\d+)", file.name)
        if number and _concerns(int(number[1]), begin) and _is_unfinished(file):
            found.append(file)
    return found


def check_ports(domain: int) -> None:
    """Raise an error instead of blocking for ever.

    Raises:
        RosasyncError: a port was left unfinished.
    """
    if found := unfinished_ports(domain):
        raise RosasyncError(f"{describe(found)}; end it with: {remedy(found)}")


def describe(ports: list[Path]) -> str:
    """Say what unfinished ports do."""
    files = ", ".join(map(str, ports))
    return f"a process died while it created {files}, and every new node waits for that for ever"


def remedy(ports: list[Path]) -> str:
    """Return the command that removes them."""
    return f"rm {' '.join(map(str, ports))}"


def _concerns(number: int, begin: int) -> bool:
    return FIRST_OF_ALL <= number < FIRST or begin <= number < begin + PER_DOMAIN


def _is_unfinished(file: Path) -> bool:
    try:
        if time.time() - file.stat().st_mtime < GRACE:
            return False
        with file.open("rb") as content:
            return int.from_bytes(content.read(4), sys.byteorder) < READY
    except OSError:
        # It was removed, or belongs to another user.
        return False
