"""How many bytes a message holds, estimated without serializing it."""

from __future__ import annotations

from typing import Any

__all__ = ["payload_size"]

SCALAR = 8
"""Bytes for a number, whatever its type."""
NO_FIELD = "_check_fields"
"""A slot of every generated message that is not one of its fields."""


def payload_size(value: Any) -> int:
    """Return about how many bytes a message or a value of its fields holds.

    Strings count a byte for each character. Arrays and lists of numbers are not iterated over.
    """
    if isinstance(value, str | bytes | bytearray):
        return len(value)
    itemsize = getattr(value, "itemsize", None)
    if itemsize is not None:
        # An array.array or a NumPy array.
        return len(value) * int(itemsize)
    if isinstance(value, list | tuple):
        return _sequence_size(value)
    slots = getattr(value, "__slots__", None)
    if not slots:
        return SCALAR
    return sum(payload_size(getattr(value, slot, None)) for slot in slots if slot != NO_FIELD)


def _sequence_size(values: list[Any] | tuple[Any, ...]) -> int:
    if values and isinstance(values[0], int | float):
        return SCALAR * len(values)
    return sum(map(payload_size, values))
