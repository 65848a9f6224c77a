"""The fields of messages: how the values of each ROS type are checked and converted.

A value comes from one of two places, and what is taken from each differs a little:

- From a mapping (`Field.to_ros`): YAML, JSON, or a dict. It has to be of the field's kind.
- From a message that the user has filled (`Field.fit`): whatever rclpy sends correctly is taken as
  it is, such as True in an integer field, and is not copied.
"""

from __future__ import annotations

import array
import base64
import binascii
import copy
import difflib
import importlib
import math
import numbers
import operator
import reprlib
import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

from rosasync._ros.types import hint, shown, type_name

__all__ = [
    "BoolField",
    "ByteField",
    "BytesField",
    "CharField",
    "Field",
    "FieldType",
    "FloatField",
    "IntegerField",
    "InvalidField",
    "MessageField",
    "NumbersField",
    "OctetsField",
    "SequenceField",
    "StringField",
    "build",
    "field_types",
    "fields_of",
    "fit",
    "json_fields",
    "plain_fields",
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


_described: dict[type[Any], Mapping[str, FieldType]] = {}


def field_types(message_type: type[Any]) -> Mapping[str, FieldType]:
    """Return the type of each field of a message class, by name.

    Raises:
        TypeError: not a message class.
    """
    known = fields_of(message_type)
    found = _described.get(message_type)
    if found is None:
        found = MappingProxyType({name: field.describe() for name, field in known.items()})
        _described[message_type] = found
    return found


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
        return bytes((_UINT8.to_ros(value),))

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


class MessageField(Field):
    """A nested message."""

    def __init__(self, message_type: type[Any]) -> None:
        super().__init__(type_name(message_type))
        self.message_type = message_type

    def to_ros(self, value: object) -> Any:
        if isinstance(value, self.message_type):
            return fit(self.message_type, value)
        if isinstance(value, Mapping):
            return build(self.message_type, value)
        raise self.refuse(value)

    def refuse(self, value: object) -> InvalidField:
        refused = super().refuse(value)
        if hasattr(value, "to_msg") and not isinstance(value, type):
            refused.problem += ": pass its to_msg()"
        return refused

    def to_plain(self, value: Any) -> dict[str, Any]:
        return plain_fields(value)

    def to_json(self, value: Any) -> dict[str, Any]:
        return json_fields(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "message", message_type=self.message_type)


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


def _base64(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _name_of(value: float) -> str:
    """Return the text by which JSON has a number that it cannot write."""
    return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"


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


def _is_numpy_bool(value: Any) -> bool:
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(value, numpy.bool_)


class UncheckedField(Field):
    """A type of IDL that no message of ROS has, and for which rclpy has no agreed value."""

    def to_ros(self, value: object) -> Any:
        return value


_UINT8 = IntegerField("uint8", "B")
_BASIC: dict[str, Field] = {
    "boolean": BoolField("bool"),
    "octet": ByteField("byte"),
    "char": CharField("char"),
    "float": FloatField("float32", "f", (2 - 2**-23) * 2.0**127),
    "double": FloatField("float64", "d", sys.float_info.max),
    "int8": IntegerField("int8", "b"),
    "uint8": _UINT8,
    "int16": IntegerField("int16", "h"),
    "uint16": IntegerField("uint16", "H"),
    "int32": IntegerField("int32", "i"),
    "uint32": IntegerField("uint32", "I"),
    "int64": IntegerField("int64", "q"),
    "uint64": IntegerField("uint64", "Q"),
}


def build(message_type: type[Any], values: Mapping[Any, Any]) -> Any:
    """Create a message from a mapping of its fields, or raise `InvalidField`."""
    fields = fields_of(message_type)
    message = message_type()
    for name, value in values.items():
        field = fields.get(name)
        if field is None:
            raise _no_such_field(message_type, name)
        try:
            converted = field.to_ros(value)
        except InvalidField as invalid:
            raise invalid.at(f".{name}") from None
        setattr(message, name, converted)
    return message


def fit(message_type: type[Any], message: Any) -> Any:
    """Return a message that rclpy sends as what it holds, or raise `InvalidField`.

    It is the message itself, or a copy if a value had to be converted.
    """
    converted = {}
    for name, field in fields_of(message_type).items():
        value = getattr(message, name)
        try:
            fitted = field.fit(value)
        except InvalidField as invalid:
            raise invalid.at(f".{name}") from None
        if fitted is not value:
            converted[name] = fitted
    if not converted:
        return message
    copied = copy.copy(message)
    for name, fitted in converted.items():
        setattr(copied, name, fitted)
    return copied


def plain_fields(message: Any) -> dict[str, Any]:
    """Return the fields of a message as plain values."""
    fields = fields_of(type(message))
    return {name: field.to_plain(getattr(message, name)) for name, field in fields.items()}


def json_fields(message: Any) -> dict[str, Any]:
    """Return the fields of a message as values of JSON."""
    fields = fields_of(type(message))
    return {name: field.to_json(getattr(message, name)) for name, field in fields.items()}


def _no_such_field(message_type: type[Any], name: object) -> InvalidField:
    fields = fields_of(message_type)
    similar = hint(difflib.get_close_matches(str(name), fields, n=1), fields)
    problem = f"no such field in {type_name(message_type)}{similar}"
    return InvalidField(ValueError, problem).at(f".{name}")


_known: dict[type[Any], dict[str, Field]] = {}


def fields_of(message_type: type[Any]) -> dict[str, Field]:
    """Return the fields of a message class by name.

    Raises:
        TypeError: not a message class.
    """
    if not isinstance(message_type, type):
        raise TypeError(f"{shown(message_type)} is not a message type")
    fields = _known.get(message_type)
    if fields is None:
        if not hasattr(message_type, "SLOT_TYPES"):
            raise TypeError(f"{shown(message_type)} is not a message type")
        # A subclass of the user may need arguments to be created.
        generated: Any = next(base for base in message_type.__mro__ if "SLOT_TYPES" in vars(base))
        names = generated.get_fields_and_field_types()
        types = dict(zip(names, generated.SLOT_TYPES, strict=True))
        blank = generated()
        fields = {name: _field(slot, getattr(blank, name)) for name, slot in types.items()}
        _known[message_type] = fields
    return fields


def _field(slot: Any, default: object = None) -> Field:
    """Return the field for a rosidl_parser type; ``default`` is its value in a new message."""
    idl: Any = importlib.import_module("rosidl_parser.definition")
    if isinstance(slot, idl.AbstractNestedType):
        return _sequence(slot, _field(slot.value_type), default)
    if isinstance(slot, idl.NamespacedType):
        # Not imported if there is a default, because an action goal is not in the module it names.
        return MessageField(type(default) if default is not None else _imported(slot))
    if isinstance(slot, idl.AbstractGenericString):
        bound = slot.maximum_size if slot.has_maximum_size() else None
        return StringField(bound, wide=isinstance(slot, idl.AbstractWString))
    return _BASIC.get(slot.typename) or UncheckedField(slot.typename)


def _imported(slot: Any) -> type[Any]:
    module = importlib.import_module(".".join(slot.namespaces))
    found: type[Any] = getattr(module, slot.name)
    return found


def _sequence(slot: Any, element: Field, default: Any) -> SequenceField:
    size: int | None = getattr(slot, "size", None)  # of an array
    least = size or 0
    most = size or getattr(slot, "maximum_size", None)
    if element is _UINT8:
        return BytesField(_UINT8, least, most, default)
    if isinstance(element, ByteField):
        return OctetsField(element, least, most)
    if isinstance(element, IntegerField | FloatField):
        return NumbersField(element, least, most, default)
    return SequenceField(element, least, most)
