"""The types of parameters, and their values in Python and in messages."""

from __future__ import annotations

import enum
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rosasync._ros.messages import to_dict

__all__ = [
    "ParameterDescriptor",
    "ParameterRange",
    "ParameterType",
    "descriptor_of",
    "from_ros",
    "is_value",
    "to_ros",
    "typed_value",
]


class ParameterType(enum.IntEnum):
    """The type of a parameter; the values are those of ``rcl_interfaces/msg/ParameterType``."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9

    @property
    def field(self) -> str:
        """The field of ``rcl_interfaces/msg/ParameterValue`` that holds such a value."""
        return f"{self.name.lower()}_value"

    @property
    def is_array(self) -> bool:
        """Whether it is one of the arrays."""
        return self >= ParameterType.BYTE_ARRAY


ARRAY_OF = {
    ParameterType.BOOL: ParameterType.BOOL_ARRAY,
    ParameterType.INTEGER: ParameterType.INTEGER_ARRAY,
    ParameterType.DOUBLE: ParameterType.DOUBLE_ARRAY,
    ParameterType.STRING: ParameterType.STRING_ARRAY,
}
"""The type of an array, by the type of its elements."""


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """The values that a number may take.

    Attributes:
        minimum: the smallest value.
        maximum: the largest value.
        step: the distance of the values from the minimum is a multiple of this; 0 for any value.
    """

    minimum: float
    maximum: float
    step: float


@dataclass(frozen=True, slots=True)
class ParameterDescriptor:
    """What a node says about one of its parameters.

    Attributes:
        name: the parameter's name.
        type: its type.
        description: what it is for.
        constraints: constraints in plain English, besides the range.
        read_only: whether it can be set only when the node starts.
        dynamic_typing: whether its type may change.
        range: the values that a number may take; None for any.
    """

    name: str
    type: ParameterType
    description: str = ""
    constraints: str = ""
    read_only: bool = False
    dynamic_typing: bool = False
    range: ParameterRange | None = None


def typed_value(name: str, value: Any) -> tuple[ParameterType | None, Any]:
    """Return the type of a value, None for an empty list; and the value without NumPy's types."""
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays, and array.array
        value = value.tolist()
    if isinstance(value, bytes | bytearray):
        return ParameterType.BYTE_ARRAY, bytes(value)
    if not isinstance(value, Sequence) or isinstance(value, str):
        kind = _scalar_type(value)
        if kind is not None:
            return kind, value
        raise TypeError(f"{name!r}: no parameter can have a {type(value).__name__}")
    if not value:
        return None, []
    if all(isinstance(item, bytes) and len(item) == 1 for item in value):
        return ParameterType.BYTE_ARRAY, b"".join(value)
    return _array_type(name, value), value


def _scalar_type(value: object) -> ParameterType | None:
    if value is None:
        return ParameterType.NOT_SET
    if isinstance(value, bool):
        return ParameterType.BOOL
    if isinstance(value, numbers.Integral):
        return ParameterType.INTEGER
    if isinstance(value, numbers.Real):
        return ParameterType.DOUBLE
    return ParameterType.STRING if isinstance(value, str) else None


def _array_type(name: str, values: Sequence[Any]) -> ParameterType:
    kinds = {_scalar_type(value) for value in values}
    if kinds == {ParameterType.INTEGER, ParameterType.DOUBLE}:
        return ParameterType.DOUBLE_ARRAY
    kind = kinds.pop()
    if kinds or kind not in ARRAY_OF:
        raise TypeError(
            f"{name!r}: the elements of a list must all be bool, int, float, str or single bytes"
        )
    return ARRAY_OF[kind]


def to_ros(kind: ParameterType | None, value: Any) -> dict[str, Any]:
    """Return the fields of the message for a value whose type is known by now."""
    assert kind is not None
    return {"type": kind} if kind is ParameterType.NOT_SET else {"type": kind, kind.field: value}


def from_ros(message: Any, kind: ParameterType) -> Any:
    """Return the value that a message holds."""
    return None if kind is ParameterType.NOT_SET else to_dict(message)[kind.field]


def is_value(message: Any, value: Any) -> bool:
    """Return whether a node's value is this one; NaN is NaN, and 1 is neither 1.0 nor True."""
    kind, value = typed_value("", value)
    return (
        kind is not None and message.type == kind and repr(from_ros(message, kind)) == repr(value)
    )


def descriptor_of(message: Any, kind: ParameterType) -> ParameterDescriptor:
    """Return the descriptor that a message holds."""
    ranges = [*message.floating_point_range, *message.integer_range]
    return ParameterDescriptor(
        name=message.name,
        type=kind,
        description=message.description,
        constraints=message.additional_constraints,
        read_only=message.read_only,
        dynamic_typing=message.dynamic_typing,
        range=next((ParameterRange(r.from_value, r.to_value, r.step) for r in ranges), None),
    )
