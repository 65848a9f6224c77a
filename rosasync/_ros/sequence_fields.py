"""The fields that hold several values: arrays and sequences of each ROS type."""

from __future__ import annotations

import array
import base64
import binascii
import math
import operator
import struct
from collections.abc import Sequence
from typing import Any

from rosasync._ros.fields import (
    UINT8,
    ByteField,
    Field,
    FieldType,
    FloatField,
    IntegerField,
    InvalidField,
)

__all__ = ["BytesField", "NumbersField", "OctetsField", "SequenceField", "sequence_of"]


class SequenceField(Field):
    """An array, of which ``least`` equals ``most``, or a sequence, bounded or not."""

    def __init__(self, element: Field, least: int, most: int | None) -> None:
        size = "" if most is None else f"{most}" if least else f"<={most}"
        super().__init__(f"{element.label}[{size}]")
        self.element = element
        self.least = least
        self.most = most

    def to_ros(self, value: object) -> Any:
        items = self.items(value)
        self.check_size(len(items))
        convert = self.element.to_ros
        converted: list[Any] = []
        try:
            for item in items:
                converted.append(convert(item))
        except InvalidField as invalid:
            raise invalid.at(f"[{len(converted)}]") from None
        return converted

    def fit(self, value: Any) -> Any:
        if not isinstance(value, list | tuple):
            return self.to_ros(value)
        self.check_size(len(value))
        fitted: list[Any] = []
        try:
            for item in value:
                fitted.append(self.element.fit(item))
        except InvalidField as invalid:
            raise invalid.at(f"[{len(fitted)}]") from None
        return value if all(map(operator.is_, value, fitted)) else fitted

    def to_plain(self, value: Any) -> Any:
        return [self.element.to_plain(item) for item in value]

    def to_json(self, value: Any) -> Any:
        return [self.element.to_json(item) for item in value]

    def describe(self) -> FieldType:
        return FieldType(self.label, "sequence", element=self.element.describe())

    def items(self, value: object) -> Sequence[Any]:
        """Return the elements of a value."""
        if isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray):
            return value
        if getattr(value, "ndim", 1) > 1:
            shape = getattr(value, "shape", None)
            raise InvalidField(
                TypeError, f"expected {self.label}, got an array of shape {shape}: flatten it"
            )
        to_list = getattr(value, "tolist", None)  # of NumPy arrays and memory views
        items = to_list() if to_list is not None else None
        if not isinstance(items, list):
            raise self.refuse(value)
        return items

    def decode(self, text: str) -> bytes:
        """Return the bytes that JSON has as base64."""
        try:
            return base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError):  # ValueError: not ASCII
            refused = self.refuse(text)
            refused.problem += ", which is not base64"
            raise refused from None

    def check_size(self, size: int) -> None:
        """Raise unless this many elements fit."""
        if size < self.least:
            raise InvalidField(ValueError, f"expected {self.least} elements, got {size}")
        if self.most is not None and size > self.most:
            wanted = f"{self.most}" if self.least else f"at most {self.most}"
            raise InvalidField(ValueError, f"expected {wanted} elements, got {size}")


class NumbersField(SequenceField):
    """Numbers, in rclpy an ``array.array``, or a NumPy array if the size is fixed."""

    def __init__(
        self, element: IntegerField | FloatField, least: int, most: int | None, default: Any
    ) -> None:
        super().__init__(element, least, most)
        self.typecode = element.typecode
        self.default = default
        self.formats = _formats_like(element.typecode)

    def to_ros(self, value: object) -> Any:
        packed = _buffer(value, self.formats)
        if packed is None:
            return super().to_ros(value)
        self.check_size(len(packed))
        copied = array.array(self.typecode)
        copied.frombytes(packed.tobytes())
        return copied

    def fit(self, value: Any) -> Any:
        packed = _buffer(value, self.formats) if isinstance(value, type(self.default)) else None
        if packed is None:
            return self.to_ros(value)
        self.check_size(len(packed))
        return value

    def to_plain(self, value: Any) -> Any:
        return array.array(self.typecode, value).tolist()

    def to_json(self, value: Any) -> Any:
        plain = self.to_plain(value)
        if self.typecode in "fd" and not all(map(math.isfinite, plain)):
            return [self.element.to_json(item) for item in plain]
        return plain


class BytesField(NumbersField):
    """Numbers of type uint8."""

    def to_ros(self, value: object) -> Any:
        return super().to_ros(self.decode(value) if isinstance(value, str) else value)

    def to_plain(self, value: Any) -> bytes:
        return bytes(value)

    def to_json(self, value: Any) -> str:
        return _base64(self.to_plain(value))


class OctetsField(SequenceField):
    """Bytes, which rclpy represents as a list of bytes of length 1."""

    def to_ros(self, value: object) -> Any:
        if isinstance(value, str):
            value = self.decode(value)
        packed = _buffer(value, ("B",))
        if packed is None:
            return super().to_ros(value)
        self.check_size(len(packed))
        return [bytes((number,)) for number in packed]

    def fit(self, value: Any) -> Any:
        if isinstance(value, bytes | bytearray) and not self.least:
            self.check_size(len(value))
            return value
        if isinstance(value, str):
            raise self.refuse(value)
        return super().fit(value)

    def to_plain(self, value: Any) -> bytes:
        return bytes(value) if isinstance(value, bytes | bytearray) else b"".join(value)

    def to_json(self, value: Any) -> str:
        return _base64(self.to_plain(value))


def sequence_of(element: Field, least: int, most: int | None, default: Any) -> SequenceField:
    """Return the field of an array or sequence; ``default`` is its value in a new message."""
    if element is UINT8:
        return BytesField(UINT8, least, most, default)
    if isinstance(element, ByteField):
        return OctetsField(element, least, most)
    if isinstance(element, IntegerField | FloatField):
        return NumbersField(element, least, most, default)
    return SequenceField(element, least, most)


def _base64(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _formats_like(typecode: str) -> tuple[str, ...]:
    """Return the codes of the same kind and size, such as a C long for an int64."""
    size = struct.calcsize(typecode)
    kind = next(codes for codes in ("bhilq", "BHILQ", "fd") if typecode in codes)
    return tuple(code for code in kind if struct.calcsize(code) == size)


def _buffer(value: Any, formats: tuple[str, ...]) -> memoryview | None:
    """Return a view of the value if its layout fits, so that no element needs a check; or None."""
    try:
        view = memoryview(value)
    except (TypeError, ValueError):  # ValueError: a NumPy array of dates, a released view
        return None
    return view if view.ndim == 1 and view.format in formats else None
