"""The fields of each message class: its messages are built, checked and converted by them."""

from __future__ import annotations

import copy
import difflib
import importlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from rosasync._ros.fields import (
    BASIC,
    Field,
    FieldType,
    InvalidField,
    StringField,
    UncheckedField,
)
from rosasync._ros.sequence_fields import sequence_of
from rosasync._ros.types import hint, shown, type_name

__all__ = [
    "MessageField",
    "build",
    "field_types",
    "fields_of",
    "fit",
    "json_fields",
    "plain_fields",
]


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
        size: int | None = getattr(slot, "size", None)  # of an array
        most = size or getattr(slot, "maximum_size", None)
        return sequence_of(_field(slot.value_type), size or 0, most, default)
    if isinstance(slot, idl.NamespacedType):
        # Not imported if there is a default, because an action goal is not in the module it names.
        return MessageField(type(default) if default is not None else _imported(slot))
    if isinstance(slot, idl.AbstractGenericString):
        bound = slot.maximum_size if slot.has_maximum_size() else None
        return StringField(bound, wide=isinstance(slot, idl.AbstractWString))
    return BASIC.get(slot.typename) or UncheckedField(slot.typename)


def _imported(slot: Any) -> type[Any]:
    module = importlib.import_module(".".join(slot.namespaces))
    found: type[Any] = getattr(module, slot.name)
    return found
