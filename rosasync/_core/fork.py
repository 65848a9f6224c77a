"""Knows whether this process was forked from one that has used ROS.

Only the thread that forks goes on in the child. Those of the middleware and of the executor are
missing, and what they had locked stays locked: nothing works, and much waits forever. That includes
the destruction of what was inherited. So a child ends without it.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from typing import ClassVar

from rosasync.errors import UsageError

__all__ = ["check_fork", "forked", "note_use", "refuse"]


class _State:
    used = False
    """Whether a session of this process, or of one that it was forked from, has opened a node."""
    forked = False
    nodes: ClassVar[weakref.WeakSet[object]] = weakref.WeakSet()
    """The nodes of the sessions, with all that destroys something of the middleware at its end."""


def note_use(node: object) -> None:
    """Remember that this process uses ROS, by this node of a session."""
    _State.used = True
    _State.nodes.add(node)


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
    if _State.used:
        for node in tuple(_State.nodes):
            # A reference that nothing gives back, also not the interpreter's end.
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(node))
        _skip_destructors()


def _skip_destructors() -> None:
    """Let this process end after the interpreter, without the destructors of C++.

    The C library calls the functions of ``on_exit`` with the exit code, the last one first.
    """
    if _on_exit is not None:
        _on_exit(_exit, None)


_libc = ctypes.CDLL(None)
# Looked up here, because a thread that is missing in the child may have held the loader's lock.
_on_exit, _exit = getattr(_libc, "on_exit", None), _libc._exit
os.register_at_fork(after_in_child=_in_child)
