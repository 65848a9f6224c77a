"""What Linux says of a process: its state, its parent, its threads."""

from __future__ import annotations

from pathlib import Path

__all__ = ["PARENT", "STATE", "THREADS", "read_stat"]

STATE, PARENT, THREADS = 0, 1, 17
"""Positions in what `read_stat` returns."""


def read_stat(process: int | str) -> list[str]:
    """Return the fields of ``/proc/[pid]/stat``, from the state on (``man 5 proc``).

    Args:
        process: the id of the process.

    Raises:
        OSError: there is no such process, or this user may not see it.
    """
    # The name, in parentheses before them, may contain anything.
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
