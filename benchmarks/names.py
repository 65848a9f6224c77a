"""Names that were given on the command line."""

from __future__ import annotations

from collections.abc import Collection

__all__ = ["check_names"]


def check_names(kind: str, names: Collection[str], known: Collection[str]) -> None:
    """Check that each of these names is known.

    Raises:
        ValueError: one does not exist.
    """
    if unknown := set(names) - set(known):
        raise ValueError(f"no {kind} {', '.join(sorted(unknown))}; there are {', '.join(known)}")
