"""Whether a message is sent as what it holds: a function for each type, compiled once.

The setters of generated messages check nothing unless ``ROS_PYTHON_CHECK_FIELDS=1`` is set, and the
generated C code that serialises them trusts every value. It sends ``numpy.True_`` and 1 in a bool
field as False, the bits of an int as those of a float, 300 in a uint8 as 44, and reads beyond the
end of a fixed array that is too short. So every message is checked before it is sent.

The function for a type is a single expression, which reads the slots of the message directly: that
is six times as fast as the loop of `rosasync._ros.message_fields.fit` for a message of one field,
and more for others. It may say no to a message that rclpy would send correctly, but never yes to
another: `fit` decides then, field by field.
"""

from __future__ import annotations

import array
from collections.abc import Callable, Sequence
from typing import Any

from rosasync._ros import fields, message_fields, sequence_fields
from rosasync._ros.types import type_name

__all__ = ["checker"]

_checkers: dict[type[Any], Callable[[Any], bool]] = {}


def checker(message_type: type[Any]) -> Callable[[Any], bool]:
    """Return a function that tells whether a message can be sent as it is.

    It returns False for anything that is not a message of this class. Of a class that is not from
    ROS, it takes every instance.
    """
    found = _checkers.get(message_type)
    if found is None:
        found = _checkers[message_type] = _compile(message_type)
    return found


def _compile(message_type: type[Any]) -> Callable[[Any], bool]:
    if not getattr(message_type, "SLOT_TYPES", ()):
        # No Python code at all for a request without fields.
        return message_type.__instancecheck__
    source = _Source()
    condition = source.message("message", message_type)
    code = f"def check(message):\n    return {condition}\n"
    exec(compile(code, f"<rosasync check of {type_name(message_type)}>", "exec"), source.names)
    check: Callable[[Any], bool] = source.names["check"]
    return check


class _Source:
    """Python expressions that test values, and the names they use."""

    def __init__(self) -> None:
        self.names: dict[str, Any] = {"array": array.array}
        self._variables = 0

    def message(self, value: str, message_type: type[Any]) -> str:
        """Return the test of a message, whose variable or walrus expression is ``value``."""
        name = value.partition(" :=")[0].strip("(")
        tests = [f"type({value}) is {self.constant(message_type)}"]
        for attribute, field in _slots(message_type):
            tests.append(self.field(f"{name}.{attribute}", field))
        return f"({' and '.join(tests)})"

    def field(self, value: str, field: fields.Field) -> str:
        """Return the test of the value of an expression."""
        variable = self.variable()
        assigned = f"{variable} := {value}"
        match field:
            case message_fields.MessageField():
                return self.message(f"({assigned})", field.message_type)
            case fields.BoolField():
                return f"(({assigned}) is True or {variable} is False)"
            case fields.IntegerField(low=low, high=high):
                return f"(isinstance({assigned}, int) and {low} <= {variable} <= {high})"
            case fields.FloatField(typecode="d"):
                return f"isinstance({value}, float)"
            case fields.FloatField(limit=limit):
                # The difference of infinities, and of NaN, is NaN.
                finite = f"-{limit!r} <= {variable} <= {limit!r}"
                infinite = f"{variable} - {variable} != 0.0"
                return f"(isinstance({assigned}, float) and ({finite} or {infinite}))"
            case fields.StringField():
                return self.text(assigned, variable, field)
            case sequence_fields.SequenceField():
                return self.sequence(assigned, variable, field)
        return f"{self.constant(_fits(field))}({value})"

    def text(self, assigned: str, variable: str, field: fields.StringField) -> str:
        tests = [f"{variable}.isascii()"]
        if not field.wide:
            tests.append(f'"\\0" not in {variable}')
        if field.bound is not None:
            tests.append(f"len({variable}) <= {field.bound}")
        other = f"{self.constant(_fits(field))}({variable})"
        return f"(isinstance({assigned}, str) and ({' and '.join(tests)} or {other}))"

    def sequence(self, assigned: str, variable: str, field: sequence_fields.SequenceField) -> str:
        if isinstance(field, sequence_fields.NumbersField):
            return self.numbers(assigned, variable, field)
        kinds = [f"type({assigned}) is list", f"type({variable}) is tuple"]
        tests = [f"({' or '.join(kinds)})"]
        if field.least:
            tests.append(f"len({variable}) == {field.most}")
        elif field.most is not None:
            tests.append(f"len({variable}) <= {field.most}")
        tests.append(f"(not {variable} or {self.elements(field.element)}({variable}))")
        test = f"({' and '.join(tests)})"
        if isinstance(field, sequence_fields.OctetsField) and not field.least:
            # rclpy copies bytes as they are.
            bound = "" if field.most is None else f" and len({variable}) <= {field.most}"
            test = f"({test} or type({variable}) is bytes{bound})"
        return test

    def numbers(self, assigned: str, variable: str, field: sequence_fields.NumbersField) -> str:
        """Return a test that takes the same time for any number of elements."""
        if field.least:
            kind = self.constant(type(field.default))
            dtype = self.constant(getattr(field.default, "dtype", None))
            size = f"{variable}.shape == ({field.most},)"
            return f"(type({assigned}) is {kind} and {size} and {variable}.dtype is {dtype})"
        tests = [f"type({assigned}) is array", f"{variable}.typecode == {field.typecode!r}"]
        if field.most is not None:
            tests.append(f"len({variable}) <= {field.most}")
        return f"({' and '.join(tests)})"

    def elements(self, element: fields.Field) -> str:
        """Return the name of a function that tests the elements of a list that is not empty."""
        match element:
            case fields.BoolField():
                return self.constant(_are_bools)
            case fields.ByteField():
                return self.constant(_are_octets)
            case fields.StringField(bound=None, wide=False):
                return self.constant(_are_texts)
            case message_fields.MessageField():
                name = self.variable()
                test = self.message("item", element.message_type)
                code = (
                    f"def {name}(items):\n"
                    f"    for item in items:\n"
                    f"        if not {test}:\n"
                    f"            return False\n"
                    f"    return True\n"
                )
                label = f"<rosasync check of {element.label}[]>"
                exec(compile(code, label, "exec"), self.names)
                return name
        fits = _fits(element)
        return self.constant(lambda items: all(map(fits, items)))

    def constant(self, value: Any) -> str:
        name = f"c{len(self.names)}"
        self.names[name] = value
        return name

    def variable(self) -> str:
        self._variables += 1
        return f"v{self._variables}"


def _slots(message_type: type[Any]) -> list[tuple[str, fields.Field]]:
    """Return the fields with the attributes that hold their values."""
    slots = getattr(message_type, "__slots__", ())
    return [
        # Read directly, because a property is a Python function.
        (f"_{name}" if f"_{name}" in slots else name, field)
        for name, field in message_fields.fields_of(message_type).items()
    ]


def _fits(field: fields.Field) -> Callable[[Any], bool]:
    def fits(value: Any) -> bool:
        try:
            return field.fit(value) is value
        except fields.InvalidField:
            return False

    return fits


_OCTETS = frozenset(bytes((number,)) for number in range(256))


def _are_bools(items: Sequence[Any]) -> bool:
    for item in items:  # noqa: SIM110 - twice as fast as all()
        if item is not True and item is not False:
            return False
    return True


def _are_octets(items: Sequence[Any]) -> bool:
    return {*map(type, items)} == {bytes} and _OCTETS.issuperset(items)


def _are_texts(items: Sequence[Any]) -> bool:
    try:
        joined = "".join(items)
        if not joined.isascii():
            joined.encode()
    except (TypeError, UnicodeEncodeError):
        return False
    return "\0" not in joined
