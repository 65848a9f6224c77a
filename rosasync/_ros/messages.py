"""ROS types by their names, and messages from and to plain Python values.

The setters of generated messages check nothing unless ``ROS_PYTHON_CHECK_FIELDS=1`` is set, and
the serialisation turns wrong values into garbage: an int in a float field, ``numpy.True_``, a fixed
array that is too short. So the values of a mapping are checked here, before they are sent.

ROS packages are imported when their first message type is used. Every function may be called from
any thread.
"""

from __future__ import annotations

import array
import difflib
import functools
import importlib
import math
import numbers
import operator
import re
import reprlib
import struct
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

__all__ = [
    "FieldType",
    "field_types",
    "request_message",
    "service_type",
    "to_dict",
    "to_message",
    "type_name",
]


def service_type(srv_type: type[Any] | str) -> type[Any]:
    """Resolve a service class from a class or a name.

    Args:
        srv_type: a service class, or its name, ``"std_srvs/srv/SetBool"``.

    Raises:
        TypeError: neither a service class nor a string.
        ValueError: the name is malformed, or no such service is installed.
    """
    if isinstance(srv_type, str):
        return _service_named(srv_type)
    if not isinstance(srv_type, type):
        raise TypeError(
            "expected a service class, or its name such as 'std_srvs/srv/SetBool', "
            f"got {_given(srv_type)}"
        )
    if not _is_service(srv_type):
        raise TypeError(f"{type_name(srv_type)} is not a service: it has no Request and Response")
    return srv_type


def type_name(srv_type: type[Any]) -> str:
    """Return the name of a service, request, response or message class as ROS writes it.

    ``"std_srvs/srv/SetBool"``, ``"std_srvs/srv/SetBool_Request"``, ``"geometry_msgs/msg/Pose"``.
    For a class that is not from ROS, it is the Python name.
    """
    package, *inner = srv_type.__module__.split(".")
    if inner and inner[0] in ("msg", "srv", "action"):
        return f"{package}/{inner[0]}/{srv_type.__name__}"
    if package == "builtins":
        return srv_type.__qualname__
    return f"{srv_type.__module__}.{srv_type.__qualname__}"


def request_message(srv_type: type[Any], request: object) -> Any:
    """Return the request to send.

    Args:
        srv_type: the service class.
        request: a ``srv_type.Request``, returned as it is; a mapping of its fields, as in
            `to_message`; or None for an empty one.

    Raises:
        TypeError: the request is anything else, or a field's value is of the wrong kind.
        ValueError: no such field, or a value out of its range.
    """
    expected = srv_type.Request
    if isinstance(request, expected):
        return request
    if request is None:
        return expected()
    if isinstance(request, Mapping):
        return to_message(expected, request)
    raise TypeError(f"expected {type_name(expected)}, got {_given(request)}")


def to_message(message_type: type[Any], fields: Mapping[str, Any]) -> Any:
    """Create a message from a mapping of its fields; fields left out keep their defaults.

    ==================  ===========================================================================
    field               takes
    ==================  ===========================================================================
    bool                bool
    integers            int, enum members and NumPy's integers; neither bool nor float
    float32, float64    float, int and NumPy's numbers; not bool
    byte                bytes of length 1, or an int
    string              str
    a message           a mapping of its fields, or the message, which is not copied
    arrays, sequences   sequences of these, ``array.array``, one-dimensional NumPy arrays
    uint8 and byte []   bytes and bytearray as well
    ==================  ===========================================================================

    Raises:
        TypeError: a value of the wrong kind; the message names the path of the field.
        ValueError: no such field, a value out of its range, or a wrong number of elements; the
            message names the path of the field.
    """
    if not isinstance(fields, Mapping):
        raise TypeError(
            f"expected a mapping of the fields of {type_name(message_type)}, got {_given(fields)}"
        )
    try:
        return _build(message_type, fields)
    except _InvalidField as invalid:
        raise invalid.kind(str(invalid)) from None


def to_dict(message: object) -> dict[str, Any]:
    """Return the fields of a message as plain Python values, which `to_message` accepts.

    Nested messages become dicts, and arrays and sequences become lists, but those of uint8 and
    byte become bytes. A single byte stays bytes of length 1, like the constants of its type.

    Raises:
        TypeError: not a message.
    """
    if isinstance(message, type):
        raise TypeError(f"expected a message, got {_given(message)}")
    fields = _fields(type(message))
    return {name: field.to_plain(getattr(message, name)) for name, field in fields.items()}


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


def field_types(message_type: type[Any]) -> dict[str, FieldType]:
    """Return the type of each field of a message class, by name.

    Raises:
        TypeError: not a message class.
    """
    return {name: field.describe() for name, field in _fields(message_type).items()}


def _given(value: object) -> str:
    """Describe a value for an error: by its type, and by the value itself if it is a scalar."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {type_name(value)}"
    name = type_name(type(value))
    return f"{name} {reprlib.repr(value)}" if isinstance(value, str | bytes | float | int) else name


# Types by name

_SERVICE_NAME = re.compile(r"([a-z]\w*)/srv/([a-z]\w*)", re.ASCII | re.IGNORECASE)


@functools.cache
def _service_named(name: str) -> type[Any]:
    match = _SERVICE_NAME.fullmatch(name)
    if match is None:
        raise ValueError(
            f"{name!r} does not name a service type: expected 'package/srv/Type', "
            "such as 'std_srvs/srv/SetBool'"
        )
    package, wanted = match.groups()
    services = _services_of(package, name)
    if wanted not in services:
        similar = difflib.get_close_matches(wanted, services, n=1)
        hint = _hint([f"{package}/srv/{found}" for found in similar], services)
        raise ValueError(f"{name!r}: no such service in {package}{hint}")
    return services[wanted]


def _services_of(package: str, name: str) -> dict[str, type[Any]]:
    try:
        module = importlib.import_module(f"{package}.srv")
    except ModuleNotFoundError as error:
        if error.name == package:
            raise ValueError(
                f"{name!r}: the package {package!r} is not installed for this Python, "
                "or its workspace is not sourced"
            ) from None
        if error.name == f"{package}.srv":
            raise ValueError(f"{name!r}: the package {package!r} has no services") from None
        raise
    return {key: found for key, found in vars(module).items() if _is_service(found)}


def _is_service(candidate: object) -> bool:
    return (
        isinstance(candidate, type)
        and isinstance(getattr(candidate, "Request", None), type)
        and isinstance(getattr(candidate, "Response", None), type)
    )


def _hint(similar: Sequence[str], all_names: Iterable[str]) -> str:
    if similar:
        return f"; did you mean {similar[0]!r}?"
    return f"; it has {', '.join(all_names) or 'none'}"


# Fields


class _InvalidField(Exception):
    """A value that a field cannot take. The path is collected while it propagates."""

    def __init__(self, kind: type[Exception], problem: str) -> None:
        self.kind = kind
        self.problem = problem
        self.steps: list[str] = []

    def at(self, step: str) -> _InvalidField:
        self.steps.append(step)
        return self

    def __str__(self) -> str:
        return f"{''.join(reversed(self.steps)).removeprefix('.')}: {self.problem}"


class _Field(ABC):
    """How the values of one ROS type are checked and converted."""

    def __init__(self, label: str) -> None:
        self.label = label

    @abstractmethod
    def to_ros(self, value: object) -> Any:
        """Return the value as rclpy needs it, or raise `_InvalidField`."""

    def to_plain(self, value: Any) -> Any:
        return value

    def describe(self) -> FieldType:
        return FieldType(self.label, "string")

    def refuse(self, value: object) -> _InvalidField:
        return _InvalidField(TypeError, f"expected {self.label}, got {_given(value)}")


class _Boolean(_Field):
    def to_ros(self, value: object) -> bool:
        if isinstance(value, bool):
            return value
        raise self.refuse(value)

    def to_plain(self, value: Any) -> bool:
        return bool(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "bool")


class _Integer(_Field):
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
        raise _InvalidField(
            ValueError,
            f"{reprlib.repr(number)} is out of the range of {self.label}, "
            f"{self.low} to {self.high}",
        )

    def to_plain(self, value: Any) -> int:
        return int(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "int")


class _Float(_Field):
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
        else:
            raise self.refuse(value)
        if abs(number) > self.limit and not math.isinf(number):
            raise self._out_of_range(number)
        return number

    def to_plain(self, value: Any) -> float:
        return float(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "float")

    def _out_of_range(self, value: object) -> _InvalidField:
        return _InvalidField(
            ValueError,
            f"{reprlib.repr(value)} is out of the range of {self.label}, "
            f"{-self.limit:.9g} to {self.limit:.9g}",
        )


class _Octet(_Field):
    """A byte, which rclpy represents as bytes of length 1."""

    def to_ros(self, value: object) -> bytes:
        if isinstance(value, bytes | bytearray):
            if len(value) == 1:
                return bytes(value)
            raise _InvalidField(ValueError, f"expected 1 byte, got {len(value)}")
        if not isinstance(value, numbers.Integral) or isinstance(value, bool):
            raise self.refuse(value)
        return bytes((_UINT8.to_ros(value),))

    def describe(self) -> FieldType:
        return FieldType(self.label, "byte")


class _Character(_Field):
    """A ``char`` of an IDL file. In a .msg file, ``char`` is a uint8."""

    def to_ros(self, value: object) -> str:
        if not isinstance(value, str):
            raise self.refuse(value)
        if len(value) != 1 or not value.isascii():
            raise _InvalidField(ValueError, f"expected 1 ASCII character, got {value!r}")
        return value


class _Text(_Field):
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
            raise _InvalidField(ValueError, f"a ROS string ends at NUL, and {value!r} has one")
        size = self._size(value)
        if self.bound is not None and size > self.bound:
            unit = "UTF-16 units" if self.wide else "bytes of UTF-8"
            raise _InvalidField(ValueError, f"expected at most {self.bound} {unit}, got {size}")
        return value

    def _size(self, value: str) -> int:
        if value.isascii():
            return len(value)
        try:
            return len(value.encode("utf-16-le")) // 2 if self.wide else len(value.encode())
        except UnicodeEncodeError as error:
            raise _InvalidField(
                ValueError, f"cannot be encoded: {error.reason} at {error.start}"
            ) from None


class _Nested(_Field):
    def __init__(self, message_type: type[Any]) -> None:
        super().__init__(type_name(message_type))
        self.message_type = message_type

    def to_ros(self, value: object) -> Any:
        if isinstance(value, self.message_type):
            return value
        if isinstance(value, Mapping):
            return _build(self.message_type, value)
        raise self.refuse(value)

    def to_plain(self, value: Any) -> dict[str, Any]:
        return to_dict(value)

    def describe(self) -> FieldType:
        return FieldType(self.label, "message", message_type=self.message_type)


class _Sequence(_Field):
    """An array, of which ``least`` equals ``most``, or a sequence, bounded or not."""

    def __init__(self, element: _Field, least: int, most: int | None) -> None:
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
        except _InvalidField as invalid:
            raise invalid.at(f"[{len(converted)}]") from None
        return converted

    def to_plain(self, value: Any) -> Any:
        return [self.element.to_plain(item) for item in value]

    def describe(self) -> FieldType:
        return FieldType(self.label, "sequence", element=self.element.describe())

    def items(self, value: object) -> Sequence[Any]:
        if isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray):
            return value
        to_list = getattr(value, "tolist", None)  # of NumPy arrays and memory views
        items = to_list() if to_list is not None else None
        if not isinstance(items, list):
            raise self.refuse(value)
        return items

    def check_size(self, size: int) -> None:
        if size < self.least:
            raise _InvalidField(ValueError, f"expected {self.least} elements, got {size}")
        if self.most is not None and size > self.most:
            wanted = f"{self.most}" if self.least else f"at most {self.most}"
            raise _InvalidField(ValueError, f"expected {wanted} elements, got {size}")


class _Numbers(_Sequence):
    """Numbers, in rclpy an ``array.array``, or a NumPy array if the size is fixed."""

    def __init__(self, element: _Integer | _Float, least: int, most: int | None) -> None:
        super().__init__(element, least, most)
        self.typecode = element.typecode
        self.formats = _formats_like(element.typecode)

    def to_ros(self, value: object) -> Any:
        packed = _buffer(value, self.formats)
        if packed is None:
            return super().to_ros(value)
        self.check_size(len(packed))
        copied = array.array(self.typecode)
        copied.frombytes(packed.tobytes())
        return copied

    def to_plain(self, value: Any) -> Any:
        return array.array(self.typecode, value).tolist()


class _Bytes(_Numbers):
    def to_plain(self, value: Any) -> bytes:
        return bytes(value)


class _Octets(_Sequence):
    """Bytes, which rclpy represents as a list of bytes of length 1."""

    def to_ros(self, value: object) -> Any:
        packed = _buffer(value, ("B",))
        if packed is None:
            return super().to_ros(value)
        self.check_size(len(packed))
        return [bytes((number,)) for number in packed]

    def to_plain(self, value: Any) -> bytes:
        return b"".join(value)


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


_UINT8 = _Integer("uint8", "B")
_BASIC: dict[str, _Field] = {
    "boolean": _Boolean("bool"),
    "octet": _Octet("byte"),
    "char": _Character("char"),
    "float": _Float("float32", "f", (2 - 2**-23) * 2.0**127),
    "double": _Float("float64", "d", sys.float_info.max),
    "int8": _Integer("int8", "b"),
    "uint8": _UINT8,
    "int16": _Integer("int16", "h"),
    "uint16": _Integer("uint16", "H"),
    "int32": _Integer("int32", "i"),
    "uint32": _Integer("uint32", "I"),
    "int64": _Integer("int64", "q"),
    "uint64": _Integer("uint64", "Q"),
}


def _build(message_type: type[Any], values: Mapping[Any, Any]) -> Any:
    fields = _fields(message_type)
    message = message_type()
    for name, value in values.items():
        field = fields.get(name)
        if field is None:
            raise _no_such_field(message_type, name)
        try:
            converted = field.to_ros(value)
        except _InvalidField as invalid:
            raise invalid.at(f".{name}") from None
        setattr(message, name, converted)
    return message


def _no_such_field(message_type: type[Any], name: object) -> _InvalidField:
    fields = _fields(message_type)
    hint = _hint(difflib.get_close_matches(str(name), fields, n=1), fields)
    problem = f"no such field in {type_name(message_type)}{hint}"
    return _InvalidField(ValueError, problem).at(f".{name}")


_fields_of: dict[type[Any], dict[str, _Field]] = {}


def _fields(message_type: type[Any]) -> dict[str, _Field]:
    fields = _fields_of.get(message_type)
    if fields is None:
        if not hasattr(message_type, "SLOT_TYPES"):
            raise TypeError(f"{_given(message_type)} is not a message type")
        names = message_type.get_fields_and_field_types()
        types = dict(zip(names, message_type.SLOT_TYPES, strict=True))
        blank = message_type()
        fields = {name: _field(slot, getattr(blank, name)) for name, slot in types.items()}
        _fields_of[message_type] = fields
    return fields


def _field(slot: Any, default: object = None) -> _Field:
    """Return the field for a rosidl_parser type; ``default`` is its value in a new message."""
    idl: Any = importlib.import_module("rosidl_parser.definition")
    if isinstance(slot, idl.AbstractNestedType):
        return _sequence(slot, _field(slot.value_type))
    if isinstance(slot, idl.NamespacedType):
        # Not imported if there is a default, because an action goal is not in the module it names.
        return _Nested(type(default) if default is not None else _imported(slot))
    if isinstance(slot, idl.AbstractGenericString):
        bound = slot.maximum_size if slot.has_maximum_size() else None
        return _Text(bound, wide=isinstance(slot, idl.AbstractWString))
    return _BASIC[slot.typename]


def _imported(slot: Any) -> type[Any]:
    module = importlib.import_module(".".join(slot.namespaces))
    found: type[Any] = getattr(module, slot.name)
    return found


def _sequence(slot: Any, element: _Field) -> _Sequence:
    size: int | None = getattr(slot, "size", None)  # of an array
    least = size or 0
    most = size or getattr(slot, "maximum_size", None)
    if element is _UINT8:
        return _Bytes(_UINT8, least, most)
    if isinstance(element, _Octet):
        return _Octets(element, least, most)
    if isinstance(element, _Integer | _Float):
        return _Numbers(element, least, most)
    return _Sequence(element, least, most)
