"""Messages from and to plain Python values, and the checks before one is sent.

Every function may be called from any thread.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from rosasync._ros.checks import checker
from rosasync._ros.fields import InvalidField
from rosasync._ros.message_fields import build, fit, json_fields, plain_fields
from rosasync._ros.types import shown, type_name

__all__ = ["make_message", "to_dict", "to_message"]


def make_message(message_type: type[Any], value: object) -> Any:
    """Return a message that is sent as what it holds.

    Args:
        message_type: the class.
        value: a message of it; a mapping of its fields, as in `to_message`; or None for an empty
            one. A message is returned as it is. If one of its values is not of its field's kind but
            stands for one, such as a NumPy scalar, a copy with that value is returned instead.

    Raises:
        TypeError: the value is anything else, or a field's value is of the wrong kind; the message
            names the path of the field.
        ValueError: no such field, a value out of its range, or a wrong number of elements.
    """
    if isinstance(value, message_type):
        if checker(message_type)(value):
            return value
        return _convert(fit, message_type, value)
    if value is None:
        return message_type()
    if isinstance(value, Mapping):
        return to_message(message_type, value)
    raise TypeError(f"expected {type_name(message_type)}, got {shown(value)}")


def to_message(message_type: type[Any], mapping: Mapping[str, Any]) -> Any:
    """Create a message from a mapping of its fields; fields left out keep their defaults.

    ==================  ===========================================================================
    field               takes
    ==================  ===========================================================================
    bool                bool and NumPy's bool; no number
    integers            int, enum members and NumPy's integers; neither bool nor float
    float32, float64    float, int and NumPy's numbers; not bool
    byte                bytes of length 1, or an int
    string              str
    a message           a mapping of its fields, or the message, which is copied only if one of its
                        values has to be converted
    arrays, sequences   sequences of these, ``array.array``, one-dimensional NumPy arrays
    uint8 and byte []   bytes and bytearray as well
    ==================  ===========================================================================

    The JSON of ``to_dict(message, json=True)`` is taken as well: base64 for the elements of uint8
    and byte, and the texts "NaN", "Infinity" and "-Infinity" for floats.

    Raises:
        TypeError: a value of the wrong kind; the message names the path of the field.
        ValueError: no such field, a value out of its range, or a wrong number of elements; the
            message names the path of the field.
    """
    if not isinstance(mapping, Mapping):
        raise TypeError(
            f"expected a mapping of the fields of {type_name(message_type)}, got {shown(mapping)}"
        )
    return _convert(build, message_type, mapping)


def to_dict(message: object, json: bool = False) -> dict[str, Any]:
    """Return the fields of a message as plain Python values, which `to_message` accepts.

    Nested messages become dicts, and arrays and sequences become lists, but those of uint8 and
    byte become bytes. A single byte stays bytes of length 1, like the constants of its type.

    Args:
        message: the message.
        json: return values of JSON, which fit `json_schema`. They differ in three kinds, and are
            those of protobuf's JSON: arrays and sequences of uint8 and byte become base64, a
            single byte becomes a number, and NaN and the infinities become "NaN", "Infinity" and
            "-Infinity".

    Raises:
        TypeError: not a message.
    """
    if isinstance(message, type):
        raise TypeError(f"expected a message, got {shown(message)}")
    return json_fields(message) if json else plain_fields(message)


def _convert(function: Callable[[type[Any], Any], Any], message_type: type[Any], value: Any) -> Any:
    try:
        return function(message_type, value)
    except InvalidField as invalid:
        raise invalid.kind(str(invalid)) from None
