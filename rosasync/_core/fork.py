"""Knows whether this process was forked from one that has used ROS.

Only the thread that forks goes on in the child. Those of the middleware and of the executor are
missing, and what they had locked stays locked: nothing works, and much waits forever.
"""

from __future__ import annotations

import os

from rosasync.errors import UsageError

__all__ = ["check_fork", "forked", "note_use", "refuse"]


class _State:
    used = False
    """Whether a session of this process, or of one that it was forked from, has opened a node."""
    forked = False


def note_use() -> None:
    """Remember that this process uses ROS."""
    _State.used = True


def forked() -> bool:
    """Return whether this process was forked since rosasync was imported."""
    return _State.forked


def check_fork() -> None:
    """Raise `UsageError` in a process that was forked from one that has used ROS."""
    if _State.forked and _State.used:
        raise refuse()


def refuse() -> UsageError:
    """Return the error of a process that was forked too late."""
    return UsageError(
        "this process was forked from one that has used ROS, which does not work in the child: the "
        "middleware's threads are missing. Start it with multiprocessing's method 'spawn' or "
        "'forkserver', or with subprocess; or fork before the first session is opened"
    )


def _in_child() -> None:
    _State.forked = True


os.register_at_fork(after_in_child=_in_child)
