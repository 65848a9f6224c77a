"""Numbers in messages."""

from __future__ import annotations

__all__ = ["count", "duration"]


def duration(seconds: float) -> str:
    """Format a duration with two digits: a deadline of 0.5 s has passed after 0.501 s."""
    if seconds < 0.0995:
        return f"{1e3 * seconds:.2g} ms"
    return f"{seconds:.2g} s" if seconds < 99.5 else f"{seconds:.0f} s"


def count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural if needed."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
