"""ROS domains: which there are, and one for this process alone (tests, benchmarks, the demo)."""

from __future__ import annotations

import ctypes
import fcntl
import os
import random
import tempfile
from pathlib import Path

from rosasync.errors import UsageError

__all__ = ["SAFE", "check_domain", "environment_domain", "isolate", "isolate_once"]

VARIABLE = "ROS_DOMAIN_ID"
MOST = 232
"""The last domain: the ports of the next one would be higher than 65535 (RTPS 2.5, 9.6.1)."""
SAFE = 101
"""The last domain whose ports Linux does not use for outgoing connections
(https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html)."""

_claimed: list[int] = []


def check_domain(domain: int) -> None:
    """Check that a domain exists; Fast DDS would end the process.

    Raises:
        UsageError: it does not.
    """
    if not 0 <= domain <= MOST:
        raise UsageError(
            f"there is no ROS domain {domain}: use 0 to {MOST}, better 0 to {SAFE}, in {VARIABLE} "
            "or in rclpy.init(domain_id=…)"
        )


def environment_domain() -> int:
    """Return the domain that ``ROS_DOMAIN_ID`` chooses, read as rcl reads it.

    Raises:
        UsageError: there is no such domain.
    """
    given = os.environ.get(VARIABLE, "")
    read = ctypes.CDLL(None).strtoul
    read.argtypes = [ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int]
    read.restype = ctypes.c_ulong
    domain = int(read(os.fsencode(given), None, 0))
    if domain == 0 and given and given.strip("+-0xX \t"):
        raise UsageError(f"{VARIABLE}={given} is not a number: use 0 to {MOST}, better 0 to {SAFE}")
    check_domain(domain)
    return domain


def isolate() -> int:
    """Put this process and its children into a ROS domain that no other process here claims.

    Claims a domain by a lock on a file in the temporary directory, held until the process ends,
    and sets ``ROS_DOMAIN_ID`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` in ``os.environ``.
    Call it before a context is created.

    Returns:
        The domain id, 1 to `SAFE`.

    Raises:
        RuntimeError: every domain is taken.
    """
    for domain in random.sample(range(1, SAFE + 1), SAFE):
        path = Path(tempfile.gettempdir()) / f"rosasync-domain-{domain}.lock"
        lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        _claimed.append(lock)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        return domain
    raise RuntimeError(
        "all ROS domains from 1 to 101 are claimed by running processes: end some of them"
    )


def isolate_once() -> int:
    """Return the domain that `isolate` has put this process into; call it if it never did.

    Raises:
        RuntimeError: every domain is taken.
    """
    return int(os.environ["ROS_DOMAIN_ID"]) if _claimed else isolate()
