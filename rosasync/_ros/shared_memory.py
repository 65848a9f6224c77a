"""Finds ports in shared memory that Fast DDS did not finish creating."""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

from rosasync._ros.discovery import BASE, DOMAIN_GAIN
from rosasync._ros.fresh_ports import FOLDER, port_prefix
from rosasync._ros.profile import is_old, user_profile
from rosasync.errors import RosasyncError

__all__ = ["FOLDER", "check_ports", "describe_unfinished", "removal_command", "unfinished_ports"]

READY = 2
"""The first word of a segment that boost has initialised (``managed_open_or_create_impl.hpp``)."""
GRACE = 2.0
"""Seconds to wait for a port to become ready before it counts as unfinished."""

COMMON = range(7000, BASE)
"""The numbers of ports that participants of every domain use."""


def unfinished_ports(domain: int) -> list[Path]:
    """Find the ports for which a new participant of this domain would wait forever.

    Every participant opens ports in shared memory, beginning with the lowest free number. A process
    that dies while it creates one, or runs out of shared memory, leaves a file that never becomes
    ready, and Fast DDS waits until it does (https://github.com/eProsima/Fast-DDS/issues/3878).

    Blocks for `GRACE` if there are any.

    Returns:
        The files: they are empty, or begin with a word that says that they are not ready. None if
        Fast DDS is configured not to use shared memory.
    """
    if not _uses_shared_memory():
        return []
    prefix = port_prefix()
    own = range(BASE + DOMAIN_GAIN * domain, BASE + DOMAIN_GAIN * (domain + 1))
    found = [
        file
        for file in sorted(FOLDER.glob(f"{prefix}*"))
        if (name := re.fullmatch(rf"{prefix}(\d+)", file.name))
        and (int(name[1]) in COMMON or int(name[1]) in own)
        and _is_unfinished(file)
    ]
    # A port that a live process is creating is ready within milliseconds.
    deadline = time.monotonic() + GRACE
    while found and time.monotonic() < deadline:
        time.sleep(0.01)
        found = [file for file in found if _is_unfinished(file)]
    return found


def check_ports(domain: int) -> None:
    """Raise an error where Fast DDS would wait forever.

    Raises:
        RosasyncError: there are unfinished ports.
    """
    if found := unfinished_ports(domain):
        raise RosasyncError(f"{describe_unfinished(found)}. Remove it: {removal_command(found)}")


def describe_unfinished(ports: list[Path]) -> str:
    """Say what unfinished ports do, and where they come from."""
    files = ", ".join(map(str, ports))
    return (
        f"every new node would wait forever for {files}: a process died, or ran out of shared "
        "memory, while it created this"
    )


def removal_command(ports: list[Path]) -> str:
    """Return the command that removes the files."""
    return f"rm {' '.join(map(str, ports))}"


def _uses_shared_memory() -> bool:
    """Return whether Fast DDS uses shared memory, as far as its configuration tells."""
    transports = os.environ.get("FASTDDS_BUILTIN_TRANSPORTS", "").partition("?")[0].upper()
    if transports in ("NONE", "UDPV4", "UDPV6", "TCPV4", "TCPV6"):
        return False
    file = user_profile(is_old())
    try:
        text = file.read_text() if file else ""
    except (OSError, ValueError):
        return True
    return "<useBuiltinTransports>false" not in text or "SHM" in text


def _is_unfinished(file: Path) -> bool:
    try:
        with file.open("rb") as content:
            return int.from_bytes(content.read(4), sys.byteorder) < READY
    except OSError:
        # It was removed, or belongs to another user.
        return False
