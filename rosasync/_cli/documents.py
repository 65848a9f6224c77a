"""YAML and JSON of messages, read; and JSON written.

A plain scalar is read as its field needs it: the text ``on`` is true in a bool field and the text
"on" in a string field, ``010`` is ten, and ``1e5`` is a number. YAML 1.1, which PyYAML implements,
decides that without the field: it would send "True" for ``on`` and 8 for ``010``.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
import reprlib
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from rosasync._cli.emitter import UNREADABLE
from rosasync._core.safe_yaml import STRING_TAG, Event, YamlError, at, build
from rosasync._ros.fields import FieldType
from rosasync._ros.message_fields import field_types
from rosasync._ros.messages import to_dict, to_message
from rosasync._ros.types import Unquoted, type_name

__all__ = ["DocumentError", "documents", "dump_json", "plain", "read_message"]

_TIME = "builtin_interfaces/msg/Time"
_HEADER = "std_msgs/msg/Header"
_TRUE = {"true", "yes", "on"}
_FALSE = {"false", "no", "off"}
_INTEGER = re.compile(r"[-+]?(0x[0-9a-f_]+|0o[0-7_]+|0b[01_]+|[0-9][0-9_]*)", re.IGNORECASE)
_FLOATS = {
    "NaN": math.nan,
    "Infinity": math.inf,
    "-Infinity": -math.inf,
    ".nan": math.nan,
    ".inf": math.inf,
    "+.inf": math.inf,
    "-.inf": -math.inf,
}


_BINARY_TAG = "tag:yaml.org,2002:binary"
_FIELD_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("bool", "float", "int", "null")}
"""The tags that say no more than the type of the field does."""


class DocumentError(ValueError):
    """A document that is not a message; the message says where and why."""


class _Plain(Unquoted):
    """The text of a scalar without quotes."""

    __slots__ = ()


def _read_scalar(event: Event) -> Any:
    """Return the text of a scalar; a plain one, or one with the tag of a number, as `_Plain`."""
    if event.tag in (None, "!", STRING_TAG):
        return event.value if event.style or event.tag else _Plain(event.value)
    if event.tag in _FIELD_TAGS:
        return _Plain(event.value)
    if event.tag == _BINARY_TAG:
        try:
            return base64.b64decode("".join(event.value.split()).encode(), validate=True)
        except binascii.Error as error:
            raise YamlError(f"{at(event)}: {event.value!r} is not base64: {error}") from None
    raise YamlError(f"{at(event)}: the tag {event.tag} is not supported here")


def read_message(message_type: type[Any], text: str) -> Any:
    """Read one YAML or JSON document as a message; fields left out keep their defaults.

    Raises:
        DocumentError: the document is malformed, or does not fit the type.
    """
    try:
        value = build(text, _read_scalar)
    except YamlError as error:
        raise DocumentError(str(error)) from None
    if value is None or (isinstance(value, _Plain) and value in ("", "~", "null")):
        value = {}
    if not isinstance(value, dict):
        raise DocumentError(
            f"expected the fields of {type_name(message_type)} as 'name: value', got "
            f"{reprlib.repr(value)}"
        )
    try:
        return to_message(message_type, _fit_fields(value, message_type))
    except (TypeError, ValueError) as error:
        raise DocumentError(str(error)) from None


def documents(text: str) -> Iterator[str]:
    """Split a stream of YAML documents, without reading them. An empty one is left out."""
    for document in re.split(r"^---(?=\s|$)", text, flags=re.MULTILINE):
        if any(line.strip() and not line.startswith("#") for line in document.splitlines()):
            yield document


def plain(message: Any) -> dict[str, Any]:
    """Return the fields of a message as values of YAML and JSON: bytes become numbers."""
    return _plain_fields(to_dict(message), type(message))


def dump_json(value: object) -> str:
    """Return a value as one line of JSON; NaN and infinity become texts, which are read again."""
    text = json.dumps(_finite(value), ensure_ascii=False, allow_nan=False)
    return UNREADABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def _fit_fields(values: dict[Any, Any], message_type: type[Any]) -> dict[str, Any]:
    types = field_types(message_type)
    return {
        str(name): _fit(value, types[name]) if name in types else value
        for name, value in values.items()
    }


def _fit(value: Any, field: FieldType) -> Any:
    """Return a value as the field needs it. What does not fit is left for `to_message`."""
    if field.message_type is not None and isinstance(value, str):
        return _expand(value, field.message_type)
    if isinstance(value, dict) and field.message_type is not None:
        return _fit_fields(value, field.message_type)
    if isinstance(value, list) and field.element is not None:
        return [_fit(item, field.element) for item in value]
    if field.kind == "float" and isinstance(value, str) and value in _FLOATS:
        return _FLOATS[value]
    return _fit_text(value, field) if isinstance(value, _Plain) else value


def _fit_text(text: _Plain, field: FieldType) -> Any:
    word = text.lower()
    if field.kind == "bool" and word in _TRUE | _FALSE:
        return word in _TRUE
    if field.kind in ("int", "byte", "float") and _INTEGER.fullmatch(text):
        return int(text, 0) if text.lstrip("+-")[:2].lower() in ("0x", "0o", "0b") else int(text)
    if field.kind == "float" and word in _FLOATS:
        return _FLOATS[word]
    if field.kind == "float":
        with suppress(ValueError):
            return float(text)
    return str(text) if field.kind == "string" else text


def _expand(word: str, message_type: type[Any]) -> Any:
    """Return what ``now`` stands for in a stamp, and ``auto`` in a header, as in ``ros2``."""
    wanted = type_name(message_type)
    if (word, wanted) == ("now", _TIME):
        return _now()
    if (word, wanted) == ("auto", _HEADER):
        return {"stamp": _now()}
    return word


def _now() -> dict[str, int]:
    sec, nanosec = divmod(time.time_ns(), 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def _plain_fields(values: dict[str, Any], message_type: type[Any]) -> dict[str, Any]:
    types = field_types(message_type)
    return {name: _plain_value(value, types[name]) for name, value in values.items()}


def _plain_value(value: Any, field: FieldType) -> Any:
    if field.message_type is not None:
        return _plain_fields(value, field.message_type)
    if field.kind == "byte":
        return value[0]
    if isinstance(value, bytes):
        return list(value)
    if field.element is not None and field.element.kind == "message":
        return [_plain_value(item, field.element) for item in value]
    return value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(item) for name, item in value.items()}
    if isinstance(value, list):
        return value if {*map(type, value)} <= {int, str} else [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value
