"""The values of parameters as rcl's parser reads them (parse.c of rcl_yaml_param_parser).

Its rules are neither those of YAML 1.1 nor of 1.2: ``y`` and ``on`` are true, ``010`` is eight,
``5e-06`` a number, ``1_000`` and ``null`` are texts. A scalar is read with C's strtoll and strtod,
and is a text if both refuse it.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import Any, TypeAlias

from rosasync._core.safe_yaml import STRING_TAG, Event, YamlError, at, events, import_yaml

__all__ = [
    "Scalar",
    "Value",
    "Values",
    "Variant",
    "is_empty",
    "is_subnormal",
    "read_plain",
    "read_scalar",
    "read_value",
]

Scalar: TypeAlias = bool | int | float | str
Value: TypeAlias = Scalar | list[Any]

_TRUE = frozenset(["Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"])
_FALSE = frozenset(["N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"])

# What C's strtoll takes with base 0, and strtod, in the locale "C".
_SPACE = r"[ \t\n\v\f\r]*"
_INTEGER = re.compile(
    rf"{_SPACE}([-+]?)(?:0x([0-9a-f]+)|(0[0-7]*)|([1-9][0-9]*))", re.ASCII | re.IGNORECASE
)
_DECIMAL = re.compile(
    rf"{_SPACE}([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]+)?)", re.ASCII | re.IGNORECASE
)
_HEXADECIMAL = re.compile(
    _SPACE + r"([-+]?)0x([0-9a-f]*)\.?([0-9a-f]*)(?:p([-+]?[0-9]{1,400}))?",
    re.ASCII | re.IGNORECASE,
)
_NAMED = re.compile(
    rf"{_SPACE}([-+]?)(?:(inf(?:inity)?)|nan(?:\([0-9a-z_]*\))?)", re.ASCII | re.IGNORECASE
)
_YAML_NAMED = re.compile(r"([-+]?)\.(?:inf|Inf|INF)|()\.(?:nan|NaN|NAN)")

_SMALLEST_NORMAL = 2.0**-1022
_INT64 = range(-(2**63), 2**63)
_INT64_DIGITS = 19

_NAMES: dict[type, str] = {bool: "a bool", int: "an integer", float: "a double", str: "a text"}
_ORDER = tuple(_NAMES)


# Scalars


def read_scalar(event: Event) -> Scalar:
    """Return the value of a scalar."""
    # C's strings end there.
    text: str = event.value.partition("\0")[0]
    if event.tag == STRING_TAG or event.style in ("'", '"'):
        return text
    return read_plain(text)


def read_plain(text: str) -> Scalar:
    """Return the value of a scalar without quotes."""
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    for read in (_integer, _double):
        number = read(text)
        if number is not None:
            return number
    return text


def _integer(text: str) -> int | None:
    match = _INTEGER.fullmatch(text)
    if match is None:
        return None
    sign, hexadecimal, octal, decimal = match.groups()
    if decimal is not None and len(decimal) > _INT64_DIGITS:
        return None  # Python does not convert thousands of digits.
    digits, base = next(pair for pair in ((hexadecimal, 16), (octal, 8), (decimal, 10)) if pair[0])
    number = int(f"{sign}{digits}", base)
    return number if number in _INT64 else None


def _double(text: str) -> float | None:
    """Return the value of a number; None for what is none, or causes ERANGE in C."""
    if match := _YAML_NAMED.fullmatch(text):
        return math.nan if match[1] is None else -math.inf if match[1] == "-" else math.inf
    if match := _NAMED.fullmatch(text):
        return math.copysign(math.nan if match[2] is None else math.inf, _sign(match[1]))
    if match := _DECIMAL.fullmatch(text):
        number = float(match[1])
        # Below that, a decimal number of less than some hundred digits is rounded: ERANGE.
        tiny = abs(number) < _SMALLEST_NORMAL and re.search("[1-9]", match[1].lower().split("e")[0])
        return None if math.isinf(number) or tiny else number
    if (match := _HEXADECIMAL.fullmatch(text)) and (match[2] or match[3]):
        return _hexadecimal(match)
    return None


def _hexadecimal(match: re.Match[str]) -> float | None:
    sign, whole, part, exponent = match.groups()
    try:
        number = float.fromhex(f"{sign}0x{whole}.{part}p{exponent or 0}")
    except OverflowError:
        return None
    if abs(number) >= _SMALLEST_NORMAL:
        return number
    digits = int(f"{whole}{part}", 16)
    if number == 0.0:
        return None if digits else number
    exact = Fraction(digits) * Fraction(2) ** (int(exponent or 0) - 4 * len(part))
    return number if exact == Fraction(abs(number)) else None


def _sign(text: str) -> float:
    return -1.0 if text == "-" else 1.0


def is_subnormal(number: float) -> bool:
    """Return whether a number is too small for C's strtod, unless it is written exactly."""
    return 0.0 < abs(number) < _SMALLEST_NORMAL


# Values


class Variant:
    """A parameter's value, as rcl's variant: a place for each type, none of which is emptied.

    So of ``a: x`` and a later ``a: 1``, the node gets what comes first in the order of the types.
    """

    def __init__(self) -> None:
        self.scalars: dict[type, Scalar] = {}
        self.lists: dict[type, list[Any]] = {}

    @property
    def value(self) -> Value | None:
        """The value that a node gets, None for none."""
        for kind in _ORDER:
            if kind in self.scalars:
                return self.scalars[kind]
        return next((self.lists[kind] for kind in _ORDER if kind in self.lists), None)


class Values:
    """Puts scalars into variants, as ``parse_value``; knows whether a list is open."""

    def __init__(self) -> None:
        self.in_list = False
        self._kind: type | None = None

    def start_list(self) -> None:
        """Make the scalars that follow the elements of a list."""
        self.in_list = True
        self._kind = None

    def end_list(self) -> None:
        """End the list."""
        self.in_list = False

    def put(self, event: Event, variant: Variant) -> None:
        """Take a scalar.

        Raises:
            YamlError: it is of another type than the elements before it.
        """
        value = read_scalar(event)
        kind = type(value)
        if not self.in_list:
            variant.scalars[kind] = value
            return
        if self._kind is None:
            self._kind = kind
            variant.lists[kind] = []
        elif self._kind is not kind or kind not in variant.lists:
            raise YamlError(
                f"{at(event)}: {event.value!r} is read as {_NAMES[kind]}, in a list that begins "
                f"with {_NAMES[self._kind]}; write all elements as one type, such as [1.0, 2.5] "
                "or ['1', 'on']"
            )
        variant.lists[kind].append(value)


def is_empty(event: Event) -> bool:
    """Return whether a scalar is nothing at all: empty, and without quotes."""
    return not event.value and event.style not in ("'", '"')


def read_value(text: str) -> Value:
    """Read a value as rcl reads the one of ``-p name:=value``. An empty list is one, too.

    Raises:
        YamlError: rcl does not accept it; the message says why.
        ImportError: PyYAML is not installed.
    """
    yaml = import_yaml()
    values, variant = Values(), Variant()
    empty: list[Any] | None = None
    for event in events(text):
        if isinstance(event, yaml.ScalarEvent):
            if is_empty(event):
                raise YamlError("there is no value")
            values.put(event, variant)
        elif isinstance(event, yaml.SequenceStartEvent):
            values.start_list()
            empty = []
        elif isinstance(event, yaml.SequenceEndEvent):
            values.end_list()
        elif isinstance(event, yaml.AliasEvent | yaml.MappingStartEvent):
            raise YamlError(f"{at(event)}: a parameter has no mappings and no aliases")
    value = empty if variant.value is None else variant.value
    if value is None:
        raise YamlError("there is no value")
    return value
