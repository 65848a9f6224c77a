"""Comparing requests with what a test expects, and showing the difference."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pprint import pformat
from typing import Any

from rosasync.ros.messages import to_dict, type_name

__all__ = ["check_fields", "count", "describe", "difference", "matches"]


def matches(expected: Any, actual: Any) -> bool:
    """Return whether a plain value fits; of a mapping, only the fields that are expected count."""
    if isinstance(expected, Mapping):
        return isinstance(actual, Mapping) and all(
            name in actual and matches(value, actual[name]) for name, value in expected.items()
        )
    return bool(expected == actual)


def check_fields(message_type: type[Any], fields: Mapping[str, Any]) -> None:
    """Check the names of the fields that a test expects.

    Raises:
        ValueError: the message has no such field.
    """
    known = to_dict(message_type())
    for name in fields:
        if name not in known:
            raise ValueError(
                f"{type_name(message_type)} has no field {name!r}; it has {', '.join(known)}"
            )


def describe(requests: Sequence[Mapping[str, Any]]) -> str:
    """List requests, one in a line."""
    if not requests:
        return "it received no request"
    lines = [f"  {number}. {fields}" for number, fields in enumerate(requests, 1)]
    return "\n".join([f"it received {count(len(requests), 'request')}:", *lines])


def difference(expected: Any, actual: Any) -> str:
    """Return the lines in which two plain values differ, marked with - (expected) and +."""
    lines = difflib.unified_diff(
        pformat(expected, width=60).splitlines(),
        pformat(actual, width=60).splitlines(),
        "expected",
        "received",
        lineterm="",
        n=100,
    )
    return "\n".join(lines)


def count(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural if needed."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
