"""The value that ``rosasync param set`` gives a parameter: read as in a parameter file."""

from __future__ import annotations

import re
from typing import Any

from rosasync._core.parameter_values import read_scalar
from rosasync._core.parameter_values import read_value as read_untyped
from rosasync._core.safe_yaml import Event, YamlError, at, build
from rosasync.parameters import ParameterType

__all__ = ["read_value"]

BYTES = range(256)
_WHOLE = re.compile("[-+]?[1-9][0-9]*")


def read_value(text: str, kind: ParameterType) -> Any:
    """Read the value for a parameter.

    What does not fit the type is left as it is: the node refuses it, and says why.

    Args:
        text: what was written.
        kind: the type that the parameter has and keeps; NOT_SET if the text decides.

    Raises:
        YamlError: it cannot be read; the message says why.
    """
    if kind is ParameterType.STRING:
        return _text(text)
    if not text.strip():
        return text
    if kind in (ParameterType.DOUBLE_ARRAY, ParameterType.STRING_ARRAY):
        items = build(text, _itself)
        if isinstance(items, list) and not any(isinstance(item, list | dict) for item in items):
            return [_element(item, kind) for item in items]
    value = read_untyped(text)
    if kind is ParameterType.DOUBLE and type(value) is int:
        return float(value)
    if kind is ParameterType.INTEGER and type(value) is float and _WHOLE.fullmatch(text):
        return int(text)  # Out of range, which is said before anything is sent.
    if kind is ParameterType.BYTE_ARRAY and isinstance(value, list):
        fits = all(type(item) is int and item in BYTES for item in value)
        return bytes(value) if fits else value
    return value


def _text(text: str) -> str:
    """Return a text without its quotes, and otherwise as it was written."""
    try:
        scalar = build(text, _itself)
    except YamlError:
        return text
    is_quoted = getattr(scalar, "style", None) in ("'", '"')
    return str(read_scalar(scalar)) if is_quoted else text


def _element(scalar: Event, kind: ParameterType) -> Any:
    if kind is ParameterType.STRING_ARRAY:
        return scalar.value
    value = read_scalar(scalar)
    if isinstance(value, bool | str):
        raise YamlError(f"{at(scalar)}: {scalar.value!r} is not a number, as a double array needs")
    return float(value)


def _itself(event: Event) -> Event:
    return event
