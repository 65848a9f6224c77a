"""YAML and JSON of messages: every field type of the common interfaces makes the round trip."""

from __future__ import annotations

import json
import math
import re
import time
from typing import Any
from unittest import mock

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import ParameterValue
from std_msgs.msg import Header
from std_srvs.srv import SetBool

from rosasync import to_dict, to_message
from rosasync._cli.documents import (
    DocumentError,
    documents,
    dump_json,
    plain,
    read_message,
)
from rosasync._cli.emitter import dump_yaml
from rosasync._cli.requests import rounds_of, template
from rosasync._ros.fields import FieldType
from rosasync._ros.interfaces import installed_types, parts
from rosasync._ros.message_fields import field_types

PACKAGES = {
    "diagnostic_msgs",
    "geometry_msgs",
    "lifecycle_msgs",
    "nav_msgs",
    "rcl_interfaces",
    "sensor_msgs",
    "shape_msgs",
    "std_msgs",
    "std_srvs",
    "stereo_msgs",
    "trajectory_msgs",
    "visualization_msgs",
}

MESSAGES = [
    part.message_type
    for kind in ("msg", "srv")
    for name in installed_types(kind)
    if name.partition("/")[0] in PACKAGES
    for part in parts(name)
]


def leaves(field: FieldType) -> set[str]:
    """The labels of the basic types, and of arrays of them, that a field consists of."""
    if field.message_type is not None:
        return set().union(*(leaves(inner) for inner in field_types(field.message_type).values()))
    element = field.element
    return {field.label} if element is None or element.message_type is None else leaves(element)


def representatives() -> list[Any]:
    """The fewest messages, in order, that have every field type of all messages."""
    chosen, covered = [], set[str]()
    for message_type in MESSAGES:
        found = set().union(*(leaves(field) for field in field_types(message_type).values()))
        if found - covered:
            covered |= found
            chosen.append(message_type)
    return chosen


SURPRISES = ["", "on", "no", "~", "null", "010", "1e5", "1:30", ".nan", "2024-01-01", "- a", "a: b"]
CHARACTERS = [
    "#",
    "'",
    '"',
    "\\",
    "é",
    "\U0001f916",
    "two\nlines",
    "\t",
    " padded ",
    "\x85",
    "\u2028",
]
TEXTS = st.sampled_from([*SURPRISES, *CHARACTERS]) | st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=8
)

TEXT_KEYS = st.sampled_from(["a", "no", "frame_id", "x1", "data"])
_BITS = {"int8": 8, "int16": 16, "int32": 32, "int64": 64}


def values_of(field: FieldType) -> st.SearchStrategy[Any]:
    if field.message_type is not None:
        return messages_of(field.message_type)
    if field.element is not None:
        size = field.label.rpartition("[")[2].removesuffix("]")
        least = int(size) if size.isdigit() else 0
        most = least or min(int(size.removeprefix("<=") or 3), 3)
        if field.element.kind in ("byte", "int", "float", "bool") and least:
            return st.lists(values_of(field.element), min_size=least, max_size=least)
        return st.lists(values_of(field.element), min_size=least, max_size=most)
    if field.kind == "int":
        bits = _BITS[field.label.removeprefix("u")]
        unsigned = field.label.startswith("u")
        low, high = (0, 2**bits - 1) if unsigned else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return st.integers(low, high)
    kinds: dict[str, st.SearchStrategy[Any]] = {
        "bool": st.booleans(),
        "byte": st.integers(0, 255),
        "float": st.floats(width=32 if field.label == "float32" else 64),
        "string": TEXTS,
    }
    return kinds[field.kind]


def messages_of(message_type: Any) -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries(
        {name: values_of(field) for name, field in field_types(message_type).items()}
    )


def test_the_messages_have_every_field_type() -> None:
    assert len(MESSAGES) > 150
    labels = set().union(
        *(leaves(field) for kind in representatives() for field in field_types(kind).values())
    )
    assert {"bool", "byte", "float32", "float64", "string", "uint8[]", "float64[36]"} <= labels
    assert {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)} <= labels


@pytest.mark.parametrize("message_type", representatives())
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_round_trip(message_type: Any, data: st.DataObject) -> None:
    message = to_message(message_type, data.draw(messages_of(message_type)))
    expected = repr(to_dict(message))  # NaN differs from itself
    assert repr(to_dict(read_message(message_type, dump_yaml(plain(message))))) == expected
    assert repr(to_dict(read_message(message_type, dump_json(plain(message))))) == expected


@pytest.mark.parametrize("message_type", MESSAGES)
def test_a_template_is_the_message_of_defaults(message_type: Any) -> None:
    assert read_message(message_type, template(message_type)) == message_type()


def test_other_readers_of_yaml_and_json_understand_it() -> None:
    message = ParameterValue(string_value="on", bool_value=True, double_value=math.inf)
    assert yaml.safe_load(dump_yaml(plain(message)))["string_value"] == "on"
    assert yaml.safe_load(dump_yaml(plain(message)))["double_value"] == math.inf
    assert json.loads(dump_json(plain(message)))["double_value"] == "Infinity"


@pytest.mark.parametrize("text", ["on", "no", "010", "1e5", "~", "null", "2024-01-01", "1:30"])
def test_a_string_field_takes_the_text_as_written(text: str) -> None:
    assert read_message(ParameterValue, f"string_value: {text}").string_value == text


@pytest.mark.parametrize(
    ("text", "value"),
    [("true", True), ("Yes", True), ("ON", True), ("false", False), ("no", False), ("off", False)],
)
def test_a_bool_field_takes_the_words_of_yaml(text: str, value: bool) -> None:
    assert read_message(SetBool.Request, f"data: {text}").data is value


@pytest.mark.parametrize(
    ("text", "value"),
    [("010", 10), ("0x1f", 31), ("0o17", 15), ("0b11", 3), ("1_000", 1000), ("+5", 5), ("-5", -5)],
)
def test_an_integer_field_takes_integers(text: str, value: int) -> None:
    assert read_message(ParameterValue, f"integer_value: {text}").integer_value == value


@pytest.mark.parametrize(
    ("text", "value"), [("1e5", 1e5), ("3", 3.0), ("-.inf", -math.inf), ('"Infinity"', math.inf)]
)
def test_a_float_field_takes_numbers(text: str, value: float) -> None:
    assert read_message(ParameterValue, f"double_value: {text}").double_value == value


@pytest.mark.parametrize(
    ("message_type", "text", "says"),
    [
        pytest.param(SetBool.Request, "data: maybe", "data: expected bool", id="word"),
        pytest.param(SetBool.Request, "data: 'true'", "expected bool", id="quotes"),
        pytest.param(SetBool.Request, "data: 1", "expected bool", id="number"),
        pytest.param(SetBool.Request, "data:", "expected bool", id="nothing"),
        pytest.param(SetBool.Request, "true", "as 'name: value'", id="no mapping"),
        pytest.param(SetBool.Request, "data: [", "not YAML", id="syntax"),
        pytest.param(SetBool.Request, "data: !!python/name:os.getcwd", "not supported", id="tag"),
        pytest.param(SetBool.Request, "&a {data: *a}", "refers to no anchor", id="recursion"),
        pytest.param(SetBool.Request, "data: !!bool x", "expected bool", id="tagged"),
        pytest.param(SetBool.Request, "data: !!binary '?'", "not base64", id="base64"),
        pytest.param(SetBool.Request, "? [1]\n: 2", "a key has to be", id="key"),
        pytest.param(SetBool.Request, "data: on\n---\ndata: on", "single document", id="two"),
        pytest.param(SetBool.Request, "data: 2024-99-99", "expected bool", id="date"),
        pytest.param(ParameterValue, "integer_value: 1.5", "integer_value", id="float"),
        pytest.param(ParameterValue, "byte_array_value: [256]", "[0]", id="range"),
    ],
)
def test_what_does_not_fit_is_refused(message_type: Any, text: str, says: str) -> None:
    with pytest.raises(DocumentError) as refused:
        read_message(message_type, text)
    assert says in str(refused.value)


@pytest.mark.parametrize(
    ("message_type", "text", "says"),
    [
        (SetBool.Request, "data: 3", "data: expected bool, got 3"),
        (SetBool.Request, "data: maybe", "data: expected bool, got maybe"),
        (SetBool.Request, "data:", "data: expected bool, got nothing"),
        (SetBool.Request, "data: 'on'", "data: expected bool, got str 'on'"),
        (ParameterValue, "integer_value: 1.5", "integer_value: expected int64, got 1.5"),
        (
            ParameterValue,
            "double_array_value: [1, far]",
            "double_array_value[1]: expected float64, got far",
        ),
        (ParameterValue, "bool_array_value: yes", "bool_array_value: expected bool[], got yes"),
        (Header, "stamp: soon", "stamp: expected builtin_interfaces/msg/Time, got soon"),
        (Header, "stamp: auto", "stamp: expected builtin_interfaces/msg/Time, got auto"),
    ],
)
def test_an_error_shows_the_value_as_it_was_written(
    message_type: Any, text: str, says: str
) -> None:
    with pytest.raises(DocumentError) as refused:
        read_message(message_type, text)
    assert str(refused.value) == says


def test_now_and_auto_are_the_time_at_which_the_request_is_read() -> None:
    before = time.time_ns()
    header = read_message(Header, "{stamp: now, frame_id: now}")
    request = read_message(GetPlan.Request, "{start: {header: auto}, goal: {header: 'auto'}}")
    path = read_message(Path, "{header: auto, poses: [{header: {stamp: now}}, {header: auto}]}")
    after = time.time_ns()
    stamps = [header.stamp, request.start.header.stamp, request.goal.header.stamp]
    stamps += [path.header.stamp, *(pose.header.stamp for pose in path.poses)]
    for stamp in stamps:
        assert before <= stamp.sec * 10**9 + stamp.nanosec <= after
    assert header.frame_id == "now"
    assert request.start.header.frame_id == ""


def test_each_round_has_its_own_time() -> None:
    timed = rounds_of(Header, "stamp: now")
    assert next(timed) != next(timed)
    fixed = rounds_of(Header, "frame_id: map")
    assert next(fixed)[0] is next(fixed)[0]


class _AsBefore(yaml.SafeDumper):
    """PyYAML, told to write lists of scalars in one line."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def _list(dumper: Any, data: list[Any]) -> Any:
    flat = not any(isinstance(item, dict | list) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=flat)


_AsBefore.add_representer(list, _list)
_WORDS = st.sampled_from([*SURPRISES, *CHARACTERS, "a, b", "[a]", "y", "=", "-", "?", "!a", "x y"])
_SCALARS = (
    st.booleans() | st.integers() | st.floats() | st.none() | _WORDS.filter(lambda t: "\n" not in t)
)
_LEAVES: st.SearchStrategy[Any] = _SCALARS | st.lists(_SCALARS, max_size=3) | st.just({})


def _mappings(values: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.dictionaries(TEXT_KEYS, values, min_size=1, max_size=3)


_INNER = _mappings(_LEAVES)
_NESTED = _mappings(_LEAVES | _INNER | st.lists(_INNER, min_size=1, max_size=2))


@settings(max_examples=100, deadline=None)
@given(_mappings(_NESTED | _LEAVES | st.lists(_NESTED, min_size=1, max_size=2)))
def test_yaml_has_the_form_of_pyyaml(value: dict[str, Any]) -> None:
    written = dump_yaml(value)
    assert repr(yaml.safe_load(written)) == repr(value)
    if not re.search(r"[\t\x7f-\x9f\u2028]", repr(value).encode().decode("unicode_escape")):
        options: Any = {"sort_keys": False, "allow_unicode": True, "width": 10**9}
        assert written == yaml.dump(value, Dumper=_AsBefore, **options).removesuffix("\n")


def test_numbers_are_written_without_an_object_for_each() -> None:
    with mock.patch("yaml.dump", side_effect=AssertionError("too slow")):
        assert dump_yaml({"data": [1, 2], "k": [0.5, math.inf, 1e20], "name": "map"}) == (
            "data: [1, 2]\nk: [0.5, .inf, 1.0e+20]\nname: map"
        )


def test_a_stream_is_split_at_its_marks() -> None:
    text = "---\n# only a comment\n---\na: 1\n--- {b: 2}\n---\nc: |\n  text\n"
    assert [yaml.safe_load(part) for part in documents(text)] == [
        {"a": 1},
        {"b": 2},
        {"c": "text\n"},
    ]
