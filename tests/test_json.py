"""JSON of messages and their schemas: every installed type, in both directions."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import ParameterValue
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import ByteMultiArray, Int64, UInt8MultiArray
from std_srvs.srv import SetBool, Trigger
from test_msgs.msg import Arrays, BoundedSequences, Constants, Defaults, Strings, WStrings
from unique_identifier_msgs.msg import UUID

import rosasync
from rosasync import json_schema, to_dict, to_message
from rosasync._ros.interfaces import installed_types, parts
from tests.test_cli_documents import messages_of, representatives

# rosidl_generator_py imports the parser, lark, with the first type support that it loads.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning:lark")

INTERFACES = [name for kind in ("msg", "srv", "action") for name in installed_types(kind)]
FLOATS = [math.nan, math.inf, -math.inf, 0.5]


def through_json(message: Any) -> Any:
    """Write a message as JSON, check it with the schema, and read it again."""
    value = json.loads(json.dumps(to_dict(message, json=True), allow_nan=False))
    Draft202012Validator(json_schema(type(message))).validate(value)
    return to_message(type(message), value)


def test_there_are_many_types() -> None:
    assert len(INTERFACES) > 150


@pytest.mark.parametrize("interface", INTERFACES)
def test_the_default_message_of_every_type(interface: str) -> None:
    for part in parts(interface):
        schema = json_schema(part.message_type)
        Draft202012Validator.check_schema(schema)
        json.dumps(schema, allow_nan=False)
        message = part.message_type()
        assert through_json(message) == message
        Draft202012Validator(schema).validate({})


@pytest.mark.parametrize("message_type", [*representatives(), Arrays, BoundedSequences, WStrings])
@settings(max_examples=10, deadline=None)
@given(data=st.data())
def test_round_trip(message_type: Any, data: st.DataObject) -> None:
    message = to_message(message_type, data.draw(messages_of(message_type)))
    # NaN differs from itself.
    assert repr(to_dict(through_json(message))) == repr(to_dict(message))


def test_the_kinds_that_differ_from_plain_values() -> None:
    assert to_dict(UInt8MultiArray(data=b"\x00\xff"), json=True)["data"] == "AP8="
    assert to_dict(ByteMultiArray(data=[b"\x00", b"\xff"]), json=True)["data"] == "AP8="
    assert to_dict(DiagnosticStatus(level=b"\x02"), json=True)["level"] == 2
    assert to_dict(Point(x=math.nan, y=math.inf, z=-math.inf), json=True) == {
        "x": "NaN",
        "y": "Infinity",
        "z": "-Infinity",
    }
    camera = to_dict(CameraInfo(d=FLOATS, k=[math.nan] * 9), json=True)
    assert camera["d"] == ["NaN", "Infinity", "-Infinity", 0.5]
    assert camera["k"] == ["NaN"] * 9
    assert to_dict(Int64(data=2**53 + 1), json=True) == {"data": 2**53 + 1}
    assert to_dict(UUID(uuid=list(range(16))), json=True)["uuid"] == (
        base64.b64encode(bytes(range(16))).decode()
    )


def test_without_json_values_stay_as_they_are() -> None:
    assert to_dict(UInt8MultiArray(data=b"\x00\xff"))["data"] == b"\x00\xff"
    assert to_dict(Point(x=math.inf), json=False)["x"] == math.inf


def test_a_message_does_not_hold_the_texts_of_json() -> None:
    with pytest.raises(TypeError, match="^x: expected float64, got str 'NaN'$"):
        rosasync._ros.messages.make_message(Point, Point(x="NaN"))
    with pytest.raises(TypeError, match=r"^byte_array_value: expected byte\[\], got str 'AP8='$"):
        rosasync._ros.messages.make_message(ParameterValue, ParameterValue(byte_array_value="AP8="))


@pytest.mark.parametrize(
    ("message_type", "fields", "error", "text"),
    [
        (UInt8MultiArray, {"data": "a"}, TypeError, "data: .* got str 'a', which is not base64"),
        (ByteMultiArray, {"data": "a b="}, TypeError, "data: .* got str 'a b=', which is not"),
        (UInt8MultiArray, {"data": "ü"}, TypeError, "data: .* got str 'ü', which is not base64"),
        (UUID, {"uuid": "AP8="}, ValueError, "uuid: expected 16 elements, got 2"),
        (Point, {"x": "nan"}, TypeError, "x: expected float64, got str 'nan'"),
        (Point, {"x": "1"}, TypeError, "x: expected float64, got str '1'"),
    ],
)
def test_texts_that_are_not_of_json_are_refused(
    message_type: Any, fields: Any, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=f"^{text}"):
        to_message(message_type, fields)


JUNK = [None, True, 0, -1, 300, 2**70, 0.5, 1e300, "x", "NaN", [], [0], ["x"], {}, {"sec": 1}]


@pytest.mark.parametrize(
    "message_type", [Arrays, BoundedSequences, Defaults, Strings, ParameterValue, PoseStamped, UUID]
)
def test_the_schema_refuses_what_cannot_be_read(message_type: Any) -> None:
    validator = Draft202012Validator(json_schema(message_type))
    for name in message_type.get_fields_and_field_types():
        for junk in JUNK:
            try:
                to_message(message_type, {name: junk})
            except (TypeError, ValueError):
                # JSON Schema does not say what is base64.
                if not isinstance(junk, str):
                    assert not validator.is_valid({name: junk}), (name, junk)
            else:
                # Bytes are read from a list of numbers, too, which is not written.
                if not isinstance(junk, list):
                    assert validator.is_valid({name: junk}), (name, junk)
    assert not validator.is_valid({"no_such_field": 1})


def test_a_schema() -> None:
    schema = json_schema(DiagnosticStatus)
    assert schema["title"] == "diagnostic_msgs/msg/DiagnosticStatus"
    assert schema["description"] == "Constants: OK = 0, WARN = 1, ERROR = 2, STALE = 3"
    assert schema["properties"]["level"] == {
        "type": "integer",
        "minimum": 0,
        "maximum": 255,
        "default": 0,
        "description": "Level of operation enumerated above.",
    }
    assert schema["properties"]["values"]["items"] == {
        "$ref": "#/$defs/diagnostic_msgs.msg.KeyValue"
    }
    assert list(schema["$defs"]) == ["diagnostic_msgs.msg.KeyValue"]


def test_bounds_sizes_defaults_and_constants() -> None:
    arrays = json_schema(Arrays)["properties"]
    assert (arrays["bool_values"]["minItems"], arrays["bool_values"]["maxItems"]) == (3, 3)
    assert (arrays["uint8_values"]["minLength"], arrays["uint8_values"]["maxLength"]) == (4, 4)
    bounded = json_schema(BoundedSequences)["properties"]["float32_values"]
    assert "minItems" not in bounded
    assert bounded["maxItems"] == 3
    assert json_schema(Strings)["properties"]["bounded_string_value"]["maxLength"] == 22
    assert json_schema(Defaults)["properties"]["int32_value"]["default"] == -30000
    assert "INT32_CONST = -30000" in json_schema(Constants)["description"]
    assert json_schema(UUID)["properties"]["uuid"]["maxLength"] == 24


def test_services_have_a_schema_for_each_side() -> None:
    assert json_schema(SetBool.Request)["properties"]["data"]["type"] == "boolean"
    assert json_schema(Trigger.Request)["properties"] == {}
    nested = json_schema(GetPlan.Request)["$defs"]
    assert "geometry_msgs.msg.Point" in nested


@pytest.mark.parametrize("wrong", [SetBool, int, Point(), "std_msgs/msg/String"])
def test_only_message_classes_have_one(wrong: Any) -> None:
    with pytest.raises(TypeError, match="is not a message type"):
        json_schema(wrong)
