"""JSON Schema for messages."""

from __future__ import annotations

import math
from typing import Any

from rosasync._ros import fields, interfaces, message_fields, sequence_fields
from rosasync._ros.types import type_name

__all__ = ["json_schema"]

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def json_schema(message_type: type[Any]) -> dict[str, Any]:
    """Return a JSON Schema for the messages of a class, as ``to_dict(…, json=True)`` has them.

    It has the range of each number, the bounds of texts and sequences, the sizes of arrays and the
    defaults. The comments of the type's definition, if that is installed, and the constants are
    descriptions. Nested types are in ``$defs``. No field is required, because `to_message` takes
    the default for it; other fields are not allowed.

    A text may fit the schema and not the type: JSON Schema counts characters, ROS counts the bytes
    of UTF-8 and allows no NUL.

    Args:
        message_type: a message class, such as ``Pose`` or ``SetBool.Request``.

    Raises:
        TypeError: not a message class.
    """
    nested: dict[str, dict[str, Any]] = {}
    described = _message(message_type, nested)
    name = type_name(message_type)
    schema = {"$schema": DIALECT, "$id": f"ros:{name}", "title": name, **described}
    return schema | ({"$defs": nested} if nested else {})


def _message(message_type: type[Any], nested: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Describe a message class, and add the types of its fields to ``nested``."""
    properties = {}
    known = message_fields.fields_of(message_type)
    blank = message_type()
    comments = {field.name: field.comment for field in interfaces.fields(message_type)}
    for name, field in known.items():
        described = _field(field, nested)
        # A reference has its own defaults.
        if "$ref" not in described:
            described["default"] = field.to_json(getattr(blank, name))
        if comments[name]:
            described["description"] = comments[name]
        properties[name] = described
    schema: dict[str, Any] = {"type": "object"}
    if constants := interfaces.constants(message_type):
        listed = ", ".join(f"{name} = {_constant(value)}" for name, value in constants.items())
        schema["description"] = f"Constants: {listed}"
    return schema | {"properties": properties, "additionalProperties": False}


def _field(field: fields.Field, nested: dict[str, dict[str, Any]]) -> dict[str, Any]:
    match field:
        case message_fields.MessageField():
            return _reference(field.message_type, nested)
        case fields.BoolField():
            return {"type": "boolean"}
        case fields.IntegerField(low=low, high=high):
            return {"type": "integer", "minimum": low, "maximum": high}
        case fields.ByteField():
            return {"type": "integer", "minimum": 0, "maximum": 255}
        case fields.FloatField(limit=limit):
            number = {"type": "number", "minimum": -limit, "maximum": limit}
            return {"anyOf": [number, {"enum": ["NaN", "Infinity", "-Infinity"]}]}
        case fields.CharField():
            return {"type": "string", "minLength": 1, "maxLength": 1}
        case fields.StringField(bound=bound):
            return {"type": "string"} | ({} if bound is None else {"maxLength": bound})
        case sequence_fields.BytesField() | sequence_fields.OctetsField():
            size = {"type": "string", "contentEncoding": "base64"}
            return size | _sizes("Length", _encoded(field.least), _encoded(field.most))
        case sequence_fields.SequenceField():
            items = {"type": "array", "items": _field(field.element, nested)}
            return items | _sizes("Items", field.least, field.most)
    return {}


def _reference(message_type: type[Any], nested: dict[str, dict[str, Any]]) -> dict[str, Any]:
    # Without slashes, which a reference would have to escape.
    name = type_name(message_type).replace("/", ".")
    if name not in nested:
        nested[name] = _message(message_type, nested)
    return {"$ref": f"#/$defs/{name}"}


def _sizes(what: str, least: int | None, most: int | None) -> dict[str, Any]:
    sizes = {f"min{what}": least, f"max{what}": most}
    return {name: size for name, size in sizes.items() if size}


def _encoded(size: int | None) -> int | None:
    """Return the length of this number of bytes as base64."""
    return size and 4 * math.ceil(size / 3)


def _constant(value: Any) -> Any:
    return value[0] if isinstance(value, bytes) else value
