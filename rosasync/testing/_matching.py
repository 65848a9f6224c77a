"""Comparing requests with what a test expects, and showing the difference."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pprint import pformat
from typing import Any

from rosasync._core.text import count
from rosasync._ros.message_fields import field_types
from rosasync._ros.types import type_name

__all__ = ["check_fields", "describe", "difference", "explain_mismatch", "matches"]


def matches(expected: Any, actual: Any) -> bool:
    """Return whether a plain value fits; of a mapping, only the fields that are expected count."""
    if isinstance(expected, Mapping):
        return isinstance(actual, Mapping) and all(
            name in actual and matches(value, actual[name]) for name, value in expected.items()
        )
    if isinstance(expected, list | tuple) and isinstance(actual, list):
        return len(expected) == len(actual) and all(map(matches, expected, actual))
    # Only NaN differs from itself.
    return bool(expected == actual or (expected != expected and actual != actual))


def check_fields(message_type: type[Any], fields: Mapping[str, Any]) -> None:
    """Check the names of the fields that a test expects, also those of nested messages.

    Raises:
        ValueError: the message has no such field.
    """
    known = field_types(message_type)
    for name, value in fields.items():
        if name not in known:
            raise ValueError(
                f"{type_name(message_type)} has no field {name!r}; it has {', '.join(known)}"
            )
        field = known[name].element or known[name]
        if field.message_type is not None:
            for nested in value if isinstance(value, list | tuple) else [value]:
                if isinstance(nested, Mapping):
                    check_fields(field.message_type, nested)


def describe(requests: Sequence[Mapping[str, Any]], lost: int = 0, noun: str = "request") -> str:
    """List requests, or goals, one in a line, and say how many further ones were lost."""
    further = f" ({count(lost, 'request')} lost on the way)" if lost else ""
    if not requests:
        return f"it received no {noun}{further}"
    lines = [f"  {number}. {fields}" for number, fields in enumerate(requests, 1)]
    return "\n".join([f"it received {count(len(requests), noun)}{further}:", *lines])


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


def explain_mismatch(
    message_type: type[Any],
    expected: Sequence[Mapping[str, Any]],
    requests: Sequence[Mapping[str, Any]],
) -> str | None:
    """Compare all requests, in order; of each, only the fields that are expected count.

    Returns:
        Their difference; None if they match.

    Raises:
        TypeError: something other than a mapping is expected.
        ValueError: the message type has no field that is expected.
    """
    for fields in expected:
        if not isinstance(fields, Mapping):
            kind = type(fields).__name__
            raise TypeError(
                f"expected a mapping of fields for each {type_name(message_type)}, "
                f"not {kind}: give each as an argument of its own"
            )
        check_fields(message_type, fields)
    if len(expected) == len(requests) and all(map(matches, expected, requests)):
        return None
    shown = [
        {name: request[name] for name in fields} if fields else request
        for fields, request in zip([*expected, *[{}] * len(requests)], requests, strict=False)
    ]
    return difference([dict(fields) for fields in expected], shown)
