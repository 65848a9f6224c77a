"""The fields of messages: how the values of each ROS type are checked and converted.

The types with one value are here, those with several in `rosasync._ros.sequence_fields`, and nested
messages in `rosasync._ros.message_fields`, which has the fields of each message class.

A value comes from one of two places, and what is taken from each differs a little:

- From a mapping (`Field.to_ros`): YAML, JSON, or a dict. It has to be of the field's kind.
- From a message that the user has filled (`Field.fit`): whatever rclpy sends correctly is taken as
  it is, such as True in an integer field, and is not copied.
"""

from __future__ import annotations

import math
import numbers
import operator
import reprlib
import struct
import sys
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal

from rosasync._ros.types import shown

__all__ = [
    "BASIC",
    "UINT8",
    "BoolField",
    "ByteField",
    "CharField",
    "Field",
    "FieldType",
    "FloatField",
    "IntegerField",
    "InvalidField",
    "StringField",
    "UncheckedField",
]

_NOT_FINITE = frozenset({"NaN", "Infinity", "-Infinity"})


@dataclass(frozen=True, slots=True)
class FieldType:
    """The type of a field.

    Attributes:
        label: as in a .msg file, ``"float64[36]"``.
        kind: what its values are.
        message_type: the class of a message field.
        element: the type of the elements of an array or a sequence.
    """

    label: str
    kind: Literal["bool", "int", "float", "byte", "string", "message", "sequence"]
    message_type: type[Any] | None = None
    element: FieldType | None = None


class InvalidField(Exception):
    """A value that a field cannot take. The path is collected while it propagates."""

    def __init__(self, kind: type[Exception], problem: str) -> None:
        self.kind = kind
        self.problem = problem
        self.steps: list[str] = []

    def at(self, step: str) -> InvalidField:
        """Add the step from the containing value, ``".name"`` or ``"[3]"``."""
        self.steps.append(step)
        return self

    def __str__(self) -> str:
        return f"{''.join(reversed(self.steps)).removeprefix('.')}: {self.problem}"


class Field(ABC):
    """How the values of one ROS type are checked and converted."""

    def __init__(self, label: str) -> None:
        self.label = label

    @abstractmethod
    def to_ros(self, value: object) -> Any:
        """Return a value of a mapping as rclpy needs it, or raise `InvalidField`."""

    def fit(self, value: Any) -> Any:
        """Return a value of a message: itself if rclpy sends it as it is, otherwise as `to_ros`."""
        return self.to_ros(value)

    def to_plain(self, value: Any) -> Any:
        """Return a value of a message as `to_dict` does."""
        return value

    def to_json(self, value: Any) -> Any:
        """Return a value of a message as `to_dict` does for JSON."""
        return self.to_plain(value)

    def describe(self) -> FieldType:
        """Return the type of the field."""
        return FieldType(self.label, "string")

    def refuse(self, value: object) -> InvalidField:
        """Return the error for a value of the wrong kind."""
        return InvalidField(TypeError, f"expected {self.label}, got {shown(value)}")


class BoolField(Field):
    """A bool."""

    def to_ros(self, value: object) -> bool:
        if isinstance(value, bool):
            return value
        if _is_numpy_bool(value):
            return bool(value)
        raise self.refuse(value)

    def to_plain(self, value: Any) -> bool:
        return bool(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "bool")


class IntegerField(Field):
    """An integer of one to eight bytes."""

    def __init__(self, label: str, typecode: str) -> None:
        super().__init__(label)
        self.typecode = typecode
        bits = 8 * struct.calcsize(typecode)
        signed = typecode.islower()
        self.low: int = -(1 << (bits - 1)) if signed else 0
        self.high: int = (1 << (bits - signed)) - 1

    def to_ros(self, value: object) -> int:
        if type(value) is int:
            number = value
        elif isinstance(value, numbers.Integral) and not isinstance(value, bool):
            number = operator.index(value)
        else:
            raise self.refuse(value)
        if self.low <= number <= self.high:
            return number
        raise InvalidField(
            ValueError,
            f"{reprlib.repr(number)} is out of the range of {self.label}, "
            f"{self.low} to {self.high}",
        )

    def fit(self, value: Any) -> Any:
        if isinstance(value, bool):
            return value
        converted = self.to_ros(value)
        return value if isinstance(value, int) else converted

    def to_plain(self, value: Any) -> int:
        return int(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "int")


class FloatField(Field):
    """A float32 or float64."""

    def __init__(self, label: str, typecode: str, limit: float) -> None:
        super().__init__(label)
        self.typecode = typecode
        self.limit = limit

    def to_ros(self, value: object) -> float:
        if type(value) is float:
            number = value
        elif isinstance(value, numbers.Real) and not isinstance(value, bool):
            try:
                number = float(value)
            except OverflowError:
                raise self._out_of_range(value) from None
        elif isinstance(value, str) and value in _NOT_FINITE:
            return float(value)
        else:
            raise self.refuse(value)
        if abs(number) > self.limit and not math.isinf(number):
            raise self._out_of_range(number)
        return number

    def fit(self, value: Any) -> Any:
        if isinstance(value, str):
            raise self.refuse(value)
        converted = self.to_ros(value)
        return value if isinstance(value, float) else converted

    def to_plain(self, value: Any) -> float:
        return float(value)

    def to_json(self, value: Any) -> float | str:
        return float(value) if math.isfinite(value) else _name_of(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "float")

    def _out_of_range(self, value: object) -> InvalidField:
        return InvalidField(
            ValueError,
            f"{reprlib.repr(value)} is out of the range of {self.label}, "
            f"{-self.limit:.9g} to {self.limit:.9g}",
        )


class ByteField(Field):
    """A byte, which rclpy represents as bytes of length 1."""

    def to_ros(self, value: object) -> bytes:
        if isinstance(value, bytes | bytearray):
            if len(value) == 1:
                return bytes(value)
            raise InvalidField(ValueError, f"expected 1 byte, got {len(value)}")
        if not isinstance(value, numbers.Integral) or isinstance(value, bool):
            raise self.refuse(value)
        return bytes((UINT8.to_ros(value),))

    def to_json(self, value: Any) -> int:
        return int(value[0])

    def describe(self) -> FieldType:
        return FieldType(self.label, "byte")


class CharField(Field):
    """A ``char`` of an IDL file. In a .msg file, ``char`` is a uint8."""

    def to_ros(self, value: object) -> str:
        if not isinstance(value, str):
            raise self.refuse(value)
        if len(value) != 1 or not value.isascii():
            raise InvalidField(ValueError, f"expected 1 ASCII character, got {value!r}")
        return value


class StringField(Field):
    """A string or wstring, bounded or not."""

    def __init__(self, bound: int | None, *, wide: bool) -> None:
        name = "wstring" if wide else "string"
        super().__init__(name if bound is None else f"{name}<={bound}")
        self.bound = bound
        self.wide = wide

    def to_ros(self, value: object) -> str:
        if not isinstance(value, str):
            raise self.refuse(value)
        if not self.wide and "\0" in value:
            # rosidl copies up to there and silently drops the rest.
            raise InvalidField(ValueError, f"a ROS string ends at NUL, and {value!r} has one")
        size = self._size(value)
        if self.bound is not None and size > self.bound:
            unit = "UTF-16 units" if self.wide else "bytes of UTF-8"
            raise InvalidField(ValueError, f"expected at most {self.bound} {unit}, got {size}")
        return value

    def _size(self, value: str) -> int:
        if value.isascii():
            return len(value)
        try:
            return len(value.encode("utf-16-le")) // 2 if self.wide else len(value.encode())
        except UnicodeEncodeError as error:
            raise InvalidField(
                ValueError, f"cannot be encoded: {error.reason} at {error.start}"
            ) from None


class UncheckedField(Field):
    """A type of IDL that no message of ROS has, and for which rclpy has no agreed value."""

    def to_ros(self, value: object) -> Any:
        return value


def _name_of(value: float) -> str:
    """Return the text by which JSON has a number that it cannot write."""
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


def _is_numpy_bool(value: Any) -> bool:
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(value, numpy.bool_)


UINT8 = IntegerField("uint8", "B")
BASIC: dict[str, Field] = {
    "boolean": BoolField("bool"),
    "octet": ByteField("byte"),
    "char": CharField("char"),
    "float": FloatField("float32", "f", (2 - 2**-23) * 2.0**127),
    "double": FloatField("float64", "d", sys.float_info.max),
    "int8": IntegerField("int8", "b"),
    "uint8": UINT8,
    "int16": IntegerField("int16", "h"),
    "uint16": IntegerField("uint16", "H"),
    "int32": IntegerField("int32", "i"),
    "uint32": IntegerField("uint32", "I"),
    "int64": IntegerField("int64", "q"),
    "uint64": IntegerField("uint64", "Q"),
}
"""The fields that are neither messages nor strings nor sequences, by the name of the IDL type."""
