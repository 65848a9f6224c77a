"""A ROS domain for this process alone, for tests, benchmarks and the demo."""

from __future__ import annotations

import fcntl
import os
import random
import tempfile
from pathlib import Path

__all__ = ["isolate", "isolate_once"]

_claimed: list[int] = []


def isolate() -> int:
    """Put this process and its children into a ROS domain that no other process here claims.

    Claims a domain by a lock on a file in the temporary directory, held until the process ends,
    and sets ``ROS_DOMAIN_ID`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` in ``os.environ``.
    Call it before a context is created.

    Returns:
        The domain id, 1 to 101. Higher ones collide with ephemeral ports on Linux
        (https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html).

    Raises:
        RuntimeError: every domain is taken.
    """
    for domain in random.sample(range(1, 102), 101):
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
