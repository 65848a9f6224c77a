"""Types by name, and messages from and to plain values, with the real generated types."""

from __future__ import annotations

import array
import contextlib
import enum
import importlib
import math
import subprocess
import sys
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any
from unittest import mock

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticStatus
from diagnostic_msgs.srv import AddDiagnostics, SelfTest
from geometry_msgs.msg import Point, Point32, Pose, PoseStamped
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nav_msgs.srv import GetPlan, SetMap
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameterTypes, SetParameters
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Joy, RegionOfInterest
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Bool, ByteMultiArray, Int8, Int64, String, UInt8MultiArray, UInt64
from std_srvs.srv import Empty, SetBool, Trigger
from test_msgs.action import Fibonacci

from rosasync._ros.messages import make_message, to_dict, to_message
from rosasync._ros.types import action_type, service_type, type_name

idl: Any = importlib.import_module("rosidl_parser.definition")
shapes: Any = importlib.import_module("shape_msgs.msg")
descriptions: Any = importlib.import_module("type_description_interfaces.msg")
markers: Any = importlib.import_module("visualization_msgs.srv")

# rosidl_generator_py imports the parser, lark, with the first type support that it loads.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning:lark")


# Types by name


def test_service_class_passes_through() -> None:
    assert service_type(SetBool) is SetBool


@pytest.mark.parametrize("srv_type", [SetBool, GetPlan, SetParameters])
def test_service_type_and_its_name_are_inverse(srv_type: type[Any]) -> None:
    assert service_type(type_name(srv_type)) is srv_type


def test_service_type_of_a_name_is_cached() -> None:
    service_type("std_srvs/srv/SetBool")
    with mock.patch("importlib.import_module", side_effect=AssertionError("imported again")):
        assert service_type("std_srvs/srv/SetBool") is SetBool


@pytest.mark.parametrize(
    ("given_type", "message"),
    [
        (Pose, "geometry_msgs/msg/Pose is not a service: it has no Request and Response"),
        (SetBool.Request, "SetBool_Request is not a service: .* the Request of std_srvs/srv/SetB"),
        (SetBool.Request, "pass SetBool itself$"),
        (Fibonacci, "Fibonacci is not a service: .*it is an action, for session.act and"),
        (int, "int is not a service"),
        (SetBool.Request(), "or its name .*, got std_srvs/srv/SetBool_Request"),
        (None, "got None"),
        (5, "got int 5"),
    ],
)
def test_what_is_no_service_type_is_a_type_error(given_type: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        service_type(given_type)


@pytest.mark.parametrize(
    "name",
    [
        *("", "SetBool", "std_srvs/SetBool", "std_srvs.srv.SetBool", "std_srvs/msg/SetBool"),
        *("std_srvs/srv/", "/std_srvs/srv/SetBool", "std_srvs/srv/SetBool\n", "../srv/SetBool"),
    ],
)
def test_malformed_name_says_the_form(name: str) -> None:
    with pytest.raises(ValueError, match="expected 'package/srv/Type', such as") as caught:
        service_type(name)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("/lamp/switch", "; the type comes before the name"),
        ("std_srvs/SetBool", "; did you mean 'std_srvs/srv/SetBool'?"),
        ("std_srvs.srv.SetBool", "; did you mean 'std_srvs/srv/SetBool'?"),
        ("SetBool", "'std_srvs/srv/SetBool'"),
        (
            "test_msgs/action/Fibonacci",
            "; it is an action, for session.act and session.serve_action",
        ),
    ],
)
def test_malformed_name_says_what_was_meant(name: str, meant: str) -> None:
    with pytest.raises(ValueError, match="expected 'package/srv/Type', such as") as caught:
        service_type(name)
    assert str(caught.value).endswith(meant)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("std_srv/srv/SetBool", "the package 'std_srv' is not installed"),
        ("geometry_msgs/srv/Pose", "the package 'geometry_msgs' has no services"),
        ("os/srv/SetBool", "the package 'os' has no services"),
        ("std_srvs/srv/Setbol", r"in std_srvs; did you mean 'std_srvs/srv/SetBool'\?"),
        ("std_srvs/srv/SetBool_Request", "did you mean 'std_srvs/srv/SetBool'"),
        ("std_srvs/srv/Quux", "in std_srvs; it has Empty, SetBool, Trigger"),
    ],
)
def test_unknown_name_says_what_is_there(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        service_type(name)
    assert repr(name) in str(caught.value)


@pytest.mark.parametrize(
    ("given_type", "error", "message"),
    [
        ("test_msgs/action/Quux", ValueError, "no such action in test_msgs; it has Fibonacci, "),
        ("test_msgs/srv/Fibonacci", ValueError, "expected 'package/action/Type', such as .*"),
        ("std_srvs/srv/SetBool", ValueError, "; it is a service, for session.call and session.se"),
        ("std_srvs/action/SetBool", ValueError, "the package 'std_srvs' has no actions"),
        (SetBool, TypeError, "std_srvs/srv/SetBool is not an action: it has no Goal, Result and"),
        (SetBool, TypeError, "it is a service, for session.call and session.serve$"),
        (Fibonacci.Goal, TypeError, "it is the Goal of test_msgs/action/Fibonacci: pass Fibonacci"),
        (5, TypeError, "expected an action class, or its name such as .*, got int 5"),
    ],
)
def test_action_types_have_the_same_errors(
    given_type: Any, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        action_type(given_type)


def test_broken_package_is_not_called_missing() -> None:
    missing = ModuleNotFoundError("No module named 'rosidl_parser'", name="rosidl_parser")
    with (
        mock.patch("importlib.import_module", side_effect=missing),
        pytest.raises(ModuleNotFoundError, match="rosidl_parser"),
    ):
        service_type("broken_srvs/srv/Thing")


@pytest.mark.parametrize(
    ("named", "name"),
    [
        (SetBool, "std_srvs/srv/SetBool"),
        (SetBool.Request, "std_srvs/srv/SetBool_Request"),
        (SetBool.Response, "std_srvs/srv/SetBool_Response"),
        (Pose, "geometry_msgs/msg/Pose"),
        (int, "int"),
        (array.array, "array.array"),
    ],
)
def test_type_name(named: type[Any], name: str) -> None:
    assert type_name(named) == name


# Requests


def test_message_of_the_right_type_passes_as_it_is() -> None:
    request = SetBool.Request(data=True)
    assert make_message(SetBool.Request, request) is request


def test_none_is_an_empty_message() -> None:
    assert make_message(SetBool.Request, None) == SetBool.Request()


@pytest.mark.parametrize("mapping", [dict, MappingProxyType])
def test_mapping_becomes_a_message(mapping: Any) -> None:
    assert make_message(SetBool.Request, mapping({"data": True})) == SetBool.Request(data=True)


@pytest.mark.parametrize(
    ("request_", "got"),
    [
        (Trigger.Request(), "std_srvs/srv/Trigger_Request"),
        (SetBool.Response(), "std_srvs/srv/SetBool_Response"),
        (SetBool.Request, "the class std_srvs/srv/SetBool_Request"),
        (SetBool, "the class std_srvs/srv/SetBool"),
        ([True], "list"),
        (True, "bool True"),
    ],
)
def test_wrong_message_names_both_types(request_: object, got: str) -> None:
    with pytest.raises(TypeError) as caught:
        make_message(SetBool.Request, request_)
    assert str(caught.value) == f"expected std_srvs/srv/SetBool_Request, got {got}"


# From mappings


def test_fields_left_out_keep_their_defaults() -> None:
    pose = to_message(Pose, {"position": {"x": 1.0}})
    assert pose == Pose(position=Point(x=1.0))
    assert pose.orientation.w == 1.0


def test_nested_messages_as_mappings_and_as_messages() -> None:
    goal = PoseStamped(pose=Pose(position=Point(x=1.0)))
    request = to_message(
        GetPlan.Request,
        {
            "start": {"header": {"frame_id": "map", "stamp": {"sec": 1, "nanosec": 2}}},
            "goal": goal,
            "tolerance": 1,
        },
    )
    assert request.start.header.frame_id == "map"
    assert (request.start.header.stamp.sec, request.start.header.stamp.nanosec) == (1, 2)
    assert request.goal is goal
    assert request.tolerance == 1.0


def test_sequences_of_messages_mix_both() -> None:
    request = to_message(
        SetParameters.Request,
        {
            "parameters": (
                {
                    "name": "speed",
                    "value": {"type": ParameterType.PARAMETER_DOUBLE, "double_value": 0.5},
                },
                {"name": "tags", "value": ParameterValue(string_array_value=["a"])},
            )
        },
    )
    assert request.parameters[0].value == ParameterValue(type=3, double_value=0.5)
    assert request.parameters[1].value.string_array_value == ["a"]


class Button(enum.IntEnum):
    FIRE = 7


@pytest.mark.parametrize("value", [7, Button.FIRE, np.int64(7), np.uint8(7)])
def test_integers(value: Any) -> None:
    data = to_message(Int8, {"data": value}).data
    assert type(data) is int
    assert data == 7


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.float64(2), np.int8(2)])
def test_floats(value: Any) -> None:
    # rosidl accepts an int here, and serializes its bits as those of a float.
    x = to_message(Point, {"x": value}).x
    assert isinstance(x, float)
    assert wired(Point(x=x)).x == 2.0


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, (2 - 2**-23) * 2.0**127])
def test_extreme_floats(value: float) -> None:
    x = wired(to_message(Point32, {"x": value})).x
    assert x == value or (math.isnan(x) and math.isnan(value))


@pytest.mark.parametrize(
    "value", [b"\x02", bytearray(b"\x02"), 2, DiagnosticStatus.ERROR, np.uint8(2)]
)
def test_single_byte(value: Any) -> None:
    status = to_message(DiagnosticStatus, {"level": value})
    assert type(status.level) is bytes
    assert status.level == DiagnosticStatus.ERROR
    assert wired(status).level == DiagnosticStatus.ERROR


def label(value: Any) -> str:
    kind = getattr(value, "dtype", None) or getattr(value, "typecode", "")
    return f"{type(value).__name__}{kind}"


BYTES = [
    b"\x00\xff",
    bytearray(b"\x00\xff"),
    memoryview(b"\x00\xff"),
    memoryview(b"\x00\x01\xff\x01")[::2],
    [0, 255],
    (0, 255),
    range(0, 256, 255),
    array.array("B", [0, 255]),
    array.array("q", [0, 255]),
    np.array([0, 255], np.uint8),
    np.array([0, 255], ">i4"),
]


@pytest.mark.parametrize("value", BYTES, ids=label)
@pytest.mark.parametrize("message_type", [UInt8MultiArray, ByteMultiArray])
def test_byte_arrays(message_type: type[Any], value: Any) -> None:
    message = wired(to_message(message_type, {"data": value}))
    assert to_dict(message)["data"] == b"\x00\xff"


def test_byte_array_of_bytes_as_rclpy_has_it() -> None:
    assert to_message(ByteMultiArray, {"data": [b"\x00", b"\xff"]}).data == [b"\x00", b"\xff"]


def test_byte_array_is_a_copy() -> None:
    source = array.array("B", [1, 2])
    message = to_message(UInt8MultiArray, {"data": source})
    source[0] = 9
    assert message.data.tolist() == [1, 2]


@pytest.mark.parametrize(
    "value",
    [
        [1, -2],
        (1, np.int8(-2)),
        array.array("i", [1, -2]),
        array.array("b", [1, -2]),
        np.array([1, -2]),
        np.array([1, 0, -2, 0], np.int32)[::2],
        np.array([1, -2], ">i4"),
        memoryview(array.array("q", [1, -2])),
    ],
    ids=label,
)
def test_sequences_of_integers(value: Any) -> None:
    assert wired(to_message(Joy, {"buttons": value})).buttons.tolist() == [1, -2]


@pytest.mark.parametrize(
    "value",
    [
        [0, 0.5, *[1] * 7],
        array.array("d", [0, 0.5, *[1] * 7]),
        array.array("f", [0, 0.5, *[1] * 7]),
        np.array([0, 0.5, *[1] * 7]),
        np.array([0, 0.5, *[1] * 7], np.float16),
    ],
    ids=label,
)
def test_fixed_arrays(value: Any) -> None:
    k = wired(to_message(CameraInfo, {"k": value})).k
    assert (k.dtype, k.tolist()) == (np.float64, [0, 0.5, *[1] * 7])


def test_booleans_and_strings_in_sequences() -> None:
    value = {"bool_array_value": np.array([True, False]), "string_array_value": ("a", "ü")}
    message = wired(to_message(ParameterValue, value))
    assert message.bool_array_value == [True, False]
    assert message.string_array_value == ["a", "ü"]


def test_bounds_are_inclusive() -> None:
    assert to_message(
        shapes.SolidPrimitive, {"dimensions": [1.0, 2.0, 3.0]}
    ).dimensions.tolist() == [*(1.0, 2.0, 3.0)]
    assert (
        len(to_message(descriptions.FieldType, {"nested_type_name": "x" * 255}).nested_type_name)
        == 255
    )
    assert to_message(UInt64, {"data": 2**64 - 1}).data == 2**64 - 1
    assert to_message(Int64, {"data": -(2**63)}).data == -(2**63)


# What is rejected

WRONG_KIND: list[tuple[type[Any], dict[str, Any], str]] = [
    (Bool, {"data": 1}, "data: expected bool, got int 1"),
    (Bool, {"data": None}, "data: expected bool, got None"),
    (Int8, {"data": True}, "data: expected int8, got bool True"),
    (Int8, {"data": 1.0}, "data: expected int8, got float 1.0"),
    (Int8, {"data": "OK"}, "data: expected int8, got str 'OK'"),
    (Int8, {"data": np.True_}, "data: expected int8, got "),
    (Point, {"x": True}, "x: expected float64, got bool True"),
    (Point, {"x": "1"}, "x: expected float64, got str '1'"),
    (Point32, {"x": 1j}, "x: expected float32, got complex"),
    (String, {"data": b"a"}, "data: expected string, got bytes b'a'"),
    (String, {"data": String}, "data: expected string, got the class std_msgs/msg/String"),
    (DiagnosticStatus, {"level": "\x01"}, r"level: expected byte, got str '\\x01'"),
    (DiagnosticStatus, {"level": True}, "level: expected byte, got bool True"),
    (
        GetPlan.Request,
        {"goal": {"pose": {"position": {"x": "far"}}}},
        "goal.pose.position.x: expected float64, got str 'far'",
    ),
    (GetPlan.Request, {"goal": {"pose": Point()}}, "goal.pose: expected geometry_msgs/msg/Pose, "),
    (GetPlan.Request, {"goal": None}, "goal: expected geometry_msgs/msg/PoseStamped, got None"),
    (GetPlan.Request, {"goal": Pose}, "goal: .* got the class geometry_msgs/msg/Pose"),
    (
        SetParameters.Request,
        {"parameters": [{}, {"value": {"integer_array_value": [1, 2, 3.0]}}]},
        r"parameters\[1\].value.integer_array_value\[2\]: expected int64, got float 3.0",
    ),
    (SetParameters.Request, {"parameters": {"name": "a"}}, "parameters: expected .*Parameter.., "),
    (SetParameters.Request, {"parameters": [None]}, r"parameters\[0\]: .*Parameter, got None"),
    (ParameterValue, {"string_array_value": "ab"}, r"string_array_value: expected string\[\], got"),
    (ParameterValue, {"string_array_value": {"a"}}, "string_array_value: .* got set$"),
    (
        ParameterValue,
        {"string_array_value": iter("ab")},
        "string_array_value: .* got str_ascii_iter",
    ),
    (ParameterValue, {"bool_array_value": [0]}, r"bool_array_value\[0\]: expected bool, got int"),
    (ParameterValue, {"byte_array_value": ["a"]}, r"byte_array_value\[0\]: expected byte, got"),
    (ParameterValue, {"byte_array_value": 3}, r"byte_array_value: expected byte\[\], got int 3"),
    (UInt8MultiArray, {"data": "ab"}, r"data: expected uint8\[\], got str 'ab'"),
    (Joy, {"buttons": b"ab"}, r"buttons: expected int32\[\], got bytes b'ab'"),
    (Joy, {"buttons": np.array([1.0])}, r"buttons\[0\]: expected int32, got float 1.0"),
    (Joy, {"buttons": np.array([True])}, r"buttons\[0\]: expected int32, got bool True"),
    (Joy, {"buttons": np.array([[1]])}, r"buttons: .* got an array of shape \(1, 1\): flatten it"),
    (Joy, {"buttons": np.array(1)}, r"buttons: expected int32\[\], got numpy.ndarray"),
    (Joy, {"buttons": np.array(["2026"], "M8[D]")}, r"buttons\[0\]: expected int32, got datetime"),
    (CameraInfo, {"k": 9.0}, r"k: expected float64\[9\], got float 9.0"),
    (shapes.SolidPrimitive, {"dimensions": 1.0}, r"dimensions: expected float64\[<=3\], got float"),
]


@pytest.mark.parametrize(("message_type", "fields", "message"), WRONG_KIND)
def test_wrong_kind_names_the_path(
    message_type: type[Any], fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=f"^{message}"):
        to_message(message_type, fields)


WRONG_VALUE: list[tuple[type[Any], dict[Any, Any], str]] = [
    (
        GetPlan.Request,
        {"goal": {"pose": {"positon": {}}}},
        r"goal.pose.positon: no such field in geometry_msgs/msg/Pose; did you mean 'position'\?",
    ),
    (Point, {"colour": 1}, "colour: no such field in geometry_msgs/msg/Point; it has x, y, z$"),
    (Point, {1: 1}, "1: no such field in geometry_msgs/msg/Point"),
    (Point, {"_x": 1.0}, r"_x: no such field .*; did you mean 'x'\?"),
    (Empty.Request, {"data": 1}, "data: no such field in std_srvs/srv/Empty_Request; it has none"),
    (
        SetParameters.Request,
        {"parameters": [{}, {"nme": ""}]},
        r"parameters\[1\].nme: no such field in rcl_interfaces/msg/Parameter; did you mean 'name'",
    ),
    (Int8, {"data": 128}, "data: 128 is out of the range of int8, -128 to 127$"),
    (Int8, {"data": -129}, "data: -129 is out of the range of int8, -128 to 127$"),
    (UInt64, {"data": -1}, "data: -1 is out of the range of uint64, 0 to 18446744073709551615$"),
    (UInt64, {"data": 2**64}, "data: 18446744073709551616 is out of the range of uint64"),
    (Duration, {"nanosec": -1}, "nanosec: -1 is out of the range of uint32, 0 to 4294967295$"),
    (Point, {"x": 10**400}, "x: 1000.* is out of the range of float64, -1.79769313e"),
    (Point32, {"x": 1e39}, "x: 1e[+]39 is out of the range of float32, -3.40282347e"),
    (DiagnosticStatus, {"level": 256}, "level: 256 is out of the range of uint8, 0 to 255"),
    (DiagnosticStatus, {"level": b""}, "level: expected 1 byte, got 0"),
    (ByteMultiArray, {"data": [0, -1]}, r"data\[1\]: -1 is out of the range of uint8, 0 to 255"),
    (UInt8MultiArray, {"data": [0, 256]}, r"data\[1\]: 256 is out of the range of uint8"),
    (UInt8MultiArray, {"data": np.array([-1])}, r"data\[0\]: -1 is out of the range of uint8"),
    (Joy, {"buttons": np.array([0, 2**31])}, r"buttons\[1\]: 2147483648 is out of the range"),
    (Joy, {"axes": array.array("d", [1e39])}, r"axes\[0\]: 1e[+]39 is out of the range of float32"),
    (CameraInfo, {"k": [0.0] * 8}, "k: expected 9 elements, got 8$"),
    (CameraInfo, {"k": np.zeros(10)}, "k: expected 9 elements, got 10$"),
    (CameraInfo, {"k": []}, "k: expected 9 elements, got 0$"),
    (
        shapes.MeshTriangle,
        {"vertex_indices": array.array("I", [1])},
        "vertex_indices: expected 3 elem",
    ),
    (
        shapes.SolidPrimitive,
        {"dimensions": [0.0] * 4},
        "dimensions: expected at most 3 elements, got 4$",
    ),
    (
        shapes.SolidPrimitive,
        {"dimensions": np.zeros(4)},
        "dimensions: expected at most 3 elements, got 4",
    ),
    (
        descriptions.FieldType,
        {"nested_type_name": "x" * 256},
        "nested_type_name: expected at most 255 bytes of UTF-8, got 256$",
    ),
    (descriptions.FieldType, {"nested_type_name": "ü" * 128}, "nested_type_name: .* got 256$"),
    (String, {"data": "a\0b"}, "data: a ROS string ends at NUL"),
    (String, {"data": "a\ud800"}, "data: cannot be encoded: surrogates not allowed at 1$"),
]


@pytest.mark.parametrize(("message_type", "fields", "message"), WRONG_VALUE)
def test_wrong_value_names_the_path(
    message_type: type[Any], fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        to_message(message_type, fields)
    assert type(caught.value) is ValueError


@pytest.mark.parametrize("fields", [None, [("data", True)], SetBool.Request(), "data"])
def test_fields_have_to_be_a_mapping(fields: Any) -> None:
    with pytest.raises(TypeError, match="expected a mapping of the fields of std_srvs/srv/SetBool"):
        to_message(SetBool.Request, fields)


@pytest.mark.parametrize("message_type", [SetBool, int, "std_msgs/msg/String"])
def test_only_messages_are_made(message_type: Any) -> None:
    with pytest.raises(TypeError, match="is not a message type"):
        to_message(message_type, {})


# Field types that no installed package has: stand-ins for generated classes


class Part:
    """A message type that cannot be imported by its name, like an action's goal."""

    SLOT_TYPES = (idl.BasicType("int8"),)

    def __init__(self) -> None:
        self.size = 0

    @staticmethod
    def get_fields_and_field_types() -> dict[str, str]:
        return {"size": "int8"}


class Rare:
    SLOT_TYPES = (
        idl.UnboundedWString(),
        idl.BoundedWString(3),
        idl.BasicType("char"),
        idl.Array(idl.BasicType("boolean"), 2),
        idl.Array(idl.UnboundedString(), 2),
        idl.Array(idl.BasicType("octet"), 2),
        idl.Array(idl.NamespacedType(["geometry_msgs", "msg"], "Point"), 2),
        idl.BoundedSequence(idl.BoundedString(2), 2),
        idl.NamespacedType(["nowhere", "action"], "Part"),
    )
    NAMES = ("wide", "short", "letter", "flags", "words", "octets", "points", "tags", "part")

    def __init__(self) -> None:
        self.wide = self.short = ""
        self.letter = "\0"
        self.flags = [False, False]
        self.words = ["", ""]
        self.octets = [b"\0", b"\0"]
        self.points = [Point(), Point()]
        self.tags: list[str] = []
        self.part = Part()

    @classmethod
    def get_fields_and_field_types(cls) -> dict[str, str]:
        return dict.fromkeys(cls.NAMES, "")


def test_rare_types() -> None:
    point = {"x": 1.0, "y": 2.0, "z": 3.0}
    plain = {
        "wide": "a\0😀",
        "short": "a😀",
        "letter": "x",
        "flags": [True, False],
        "words": ["a", "ü"],
        "octets": b"\x01\x02",
        "points": [point, point],
        "tags": ["ab", "ü"],
        "part": {"size": 5},
    }
    message = to_message(Rare, plain)
    assert message.octets == [b"\x01", b"\x02"]
    assert message.points == [Point(**point)] * 2
    assert message.part.size == 5
    assert to_dict(message) == plain


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"short": "😀😀"}, ValueError, "short: expected at most 3 UTF-16 units, got 4"),
        ({"wide": "\ud800"}, ValueError, "wide: cannot be encoded"),
        ({"wide": 1}, TypeError, "wide: expected wstring, got int 1"),
        ({"letter": "ab"}, ValueError, "letter: expected 1 ASCII character, got 'ab'"),
        ({"letter": "ü"}, ValueError, "letter: expected 1 ASCII character"),
        ({"letter": 97}, TypeError, "letter: expected char, got int 97"),
        ({"flags": [True]}, ValueError, "flags: expected 2 elements, got 1"),
        ({"flags": [True, 0]}, TypeError, r"flags\[1\]: expected bool, got int 0"),
        ({"words": ["a"] * 3}, ValueError, "words: expected 2 elements, got 3"),
        ({"octets": b"abc"}, ValueError, "octets: expected 2 elements, got 3"),
        ({"points": [{}]}, ValueError, "points: expected 2 elements, got 1"),
        ({"points": [{}, {"w": 1}]}, ValueError, r"points\[1\].w: no such field in geometry"),
        ({"tags": ["", "abc"]}, ValueError, r"tags\[1\]: expected at most 2 bytes of UTF-8"),
        ({"tags": ["", "", ""]}, ValueError, "tags: expected at most 2 elements, got 3"),
        ({"tags": "ab"}, TypeError, r"tags: expected string<=2\[<=2\], got str 'ab'"),
        ({"part": {"size": 200}}, ValueError, "part.size: 200 is out of the range of int8"),
    ],
)
def test_rare_types_refused(fields: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{message}"):
        to_message(Rare, fields)


# To plain values


def test_to_dict_is_plain() -> None:
    assert to_dict(SetCameraInfo.Request()) == {
        "camera_info": {
            "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
            "height": 0,
            "width": 0,
            "distortion_model": "",
            "d": [],
            "k": [0.0] * 9,
            "r": [0.0] * 9,
            "p": [0.0] * 12,
            "binning_x": 0,
            "binning_y": 0,
            "roi": to_dict(RegionOfInterest()),
        }
    }
    assert to_dict(Empty.Request()) == {}


def test_to_dict_shares_nothing_with_the_message() -> None:
    message = Joy(axes=[1.0], buttons=[1])
    plain = to_dict(message)
    message.axes[0] = 2.0
    message.buttons[0] = 2
    assert (plain["axes"], plain["buttons"]) == ([1.0], [1])


def test_to_dict_makes_numpy_scalars_plain() -> None:
    plain = to_dict(Point(x=np.float64(1), y=np.float32(2), z=3))
    assert [type(value) for value in plain.values()] == [float, float, float]


def test_to_dict_takes_bytes_for_uint8_and_byte() -> None:
    assert to_dict(GetParameterTypes.Response(types=[1, 2]))["types"] == b"\x01\x02"
    assert to_dict(ParameterValue(byte_array_value=[b"\x01"]))["byte_array_value"] == b"\x01"
    assert to_dict(DiagnosticStatus(level=DiagnosticStatus.WARN))["level"] == DiagnosticStatus.WARN


@pytest.mark.parametrize(
    ("message", "error"),
    [(5, "int is not a message type"), (Pose, "expected a message, got the class geometry_msgs")],
)
def test_to_dict_of_no_message(message: Any, error: str) -> None:
    with pytest.raises(TypeError, match=error):
        to_dict(message)


# Every value to a message and back, also through the middleware's encoding


def wired(message: Any) -> Any:
    """Return the message as a receiver would get it."""
    return deserialize_message(serialize_message(message), type(message))


@contextlib.contextmanager
def checking_setters() -> Iterator[None]:
    """Enable the checks of the generated setters, which have to agree with ours."""
    generated = [module for name, module in sys.modules.items() if is_generated(name)]
    with contextlib.ExitStack() as stack:
        for module in generated:
            stack.enter_context(mock.patch.object(module, "ros_python_check_fields", "1"))
        yield


def is_generated(module: str) -> bool:
    return hasattr(sys.modules[module], "ros_python_check_fields")


BASIC: dict[str, st.SearchStrategy[Any]] = {
    "boolean": st.booleans(),
    "octet": st.binary(min_size=1, max_size=1),
    "float": st.floats(width=32, allow_nan=False, min_value=-(2.0**127), max_value=2.0**127),
    "double": st.floats(allow_nan=False),
    **{
        f"int{bits}": st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        for bits in (8, 16, 32, 64)
    },
    **{f"uint{bits}": st.integers(0, 2**bits - 1) for bits in (8, 16, 32, 64)},
}
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=20)


def plain_values(message_type: type[Any]) -> st.SearchStrategy[dict[str, Any]]:
    names = message_type.get_fields_and_field_types()
    slots = zip(names, message_type.SLOT_TYPES, strict=True)
    return st.fixed_dictionaries({name: plain_value(slot) for name, slot in slots})


def plain_value(slot: Any) -> st.SearchStrategy[Any]:
    if isinstance(slot, idl.AbstractNestedType):
        size = getattr(slot, "size", None)
        least, most = size or 0, size or getattr(slot, "maximum_size", 4)
        if getattr(slot.value_type, "typename", "") in ("uint8", "octet"):
            return st.binary(min_size=least, max_size=most)
        return st.lists(plain_value(slot.value_type), min_size=least, max_size=most)
    if isinstance(slot, idl.NamespacedType):
        module = importlib.import_module(".".join(slot.namespaces))
        return plain_values(getattr(module, slot.name))
    if isinstance(slot, idl.AbstractGenericString):
        return TEXT
    return BASIC[slot.typename]


ROUND_TRIPS = [
    *(Trigger.Response, SelfTest.Response, AddDiagnostics.Request, SetParameters.Request),
    *(GetPlan.Request, GetPlan.Response, SetCameraInfo.Request, SetMap.Request),
    *(
        ByteMultiArray,
        shapes.MeshTriangle,
        shapes.SolidPrimitive,
        descriptions.FieldType,
        SetBool.Event,
    ),
    markers.GetInteractiveMarkers.Response,
]


@pytest.mark.parametrize("message_type", ROUND_TRIPS, ids=type_name)
@settings(
    max_examples=25, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
@given(st.data())
def test_plain_values_survive_the_round_trip(message_type: type[Any], data: st.DataObject) -> None:
    plain: Mapping[str, Any] = data.draw(plain_values(message_type))
    message = to_message(message_type, plain)
    assert to_dict(message) == plain
    assert to_dict(wired(message)) == plain
    with checking_setters():
        assert to_message(message_type, plain) == message


# Without ROS


def test_importing_it_imports_nothing_of_ros() -> None:
    code = (
        "import sys, rosasync._ros.messages;"
        "print([name for name in sys.modules if name.startswith(('rclpy', 'rosidl', 'numpy'))])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
