"""What is sent is what the message holds, or it is refused: every type, every kind of value."""

from __future__ import annotations

import array
import enum
import importlib
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseStamped, TwistStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import ParameterValue
from rclpy.duration import Duration
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Float32, Header, Int8, Int64, String, UInt8
from std_srvs.srv import SetBool, Trigger
from test_msgs.msg import Arrays, BasicTypes, BoundedSequences, Nested, UnboundedSequences, WStrings

from rosasync import Session, to_dict, to_message
from rosasync._ros.checks import checker
from rosasync._ros.interfaces import parts
from rosasync._ros.messages import make_message
from tests.support.times import LIMIT
from tests.test_cli_documents import messages_of, representatives

descriptions: Any = importlib.import_module("type_description_interfaces.msg")
shapes: Any = importlib.import_module("shape_msgs.msg")

# rosidl_generator_py imports the parser, lark, with the first type support that it loads.
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning:lark")

Unit = enum.IntEnum("Unit", {"METRE": 1})


def sent(message: Any) -> Any:
    return make_message(type(message), message)


def wired(message: Any) -> Any:
    """Serialize a message as a send does, and read it again."""
    return deserialize_message(serialize_message(message), type(message))


def with_value(message: Any, **values: Any) -> Any:
    for name, value in values.items():
        setattr(message, name, value)
    return message


CONVERTED: list[tuple[Any, str, Any]] = [
    (SetBool.Response(success=np.all([1, 2])), "success", True),
    (SetBool.Response(success=np.all([0])), "success", False),
    (Float32(data=np.float32(0.5)), "data", 0.5),
    (Float32(data=3), "data", 3.0),
    (Point(x=np.int64(-2), y=1), "x", -2.0),
    (UInt8(data=np.uint8(200)), "data", 200),
    (Int64(data=np.int64(-(2**63))), "data", -(2**63)),
    (DiagnosticStatus(level=2), "level", b"\x02"),
    (DiagnosticStatus(level=np.uint8(2)), "level", b"\x02"),
    (ParameterValue(bool_array_value=[np.True_, False]), "bool_array_value", [True, False]),
    (ParameterValue(bool_array_value=np.array([True, False])), "bool_array_value", [True, False]),
    (ParameterValue(byte_array_value=[1, 255]), "byte_array_value", [b"\x01", b"\xff"]),
    (UnboundedSequences(bool_values=np.array([1, 0], bool)), "bool_values", [True, False]),
    (Arrays(byte_values=b"\x01\x02\x03"), "byte_values", [b"\x01", b"\x02", b"\x03"]),
    (Arrays(bool_values=np.array([True, False, True])), "bool_values", [True, False, True]),
    (Pose(position={"x": 1.0}), "position", Point(x=1.0)),
]


@pytest.mark.parametrize(("message", "name", "value"), CONVERTED)
def test_what_stands_for_a_value_is_sent_as_that_value(message: Any, name: str, value: Any) -> None:
    before = repr(message)
    assert getattr(wired(sent(message)), name) == value
    assert repr(message) == before


AS_THEY_ARE: list[tuple[Any, str, Any]] = [
    (Int8(data=True), "data", 1),
    (Int8(data=Unit.METRE), "data", 1),
    (Point(x=np.float64(0.5)), "x", 0.5),
    (String(data=np.str_("ü")), "data", "ü"),
    (ParameterValue(byte_array_value=b"\x01\xff"), "byte_array_value", [b"\x01", b"\xff"]),
    (ParameterValue(string_array_value=("a", "ü")), "string_array_value", ["a", "ü"]),
    (ParameterValue(integer_array_value=np.array([1, 2])), "integer_array_value", [1, 2]),
    (UInt8(data=255), "data", 255),
    (Float32(data=float("inf")), "data", float("inf")),
    (descriptions.FieldType(nested_type_name="x" * 255), "nested_type_name", "x" * 255),
    (Trigger.Request(), "structure_needs_at_least_one_member", None),
]


@pytest.mark.parametrize(("message", "name", "value"), AS_THEY_ARE)
def test_what_rclpy_sends_correctly_is_not_copied(message: Any, name: str, value: Any) -> None:
    assert sent(message) is message
    if value is not None:
        got = getattr(wired(message), name)
        assert (got.tolist() if isinstance(got, array.array) else got) == value


REFUSED: list[tuple[Any, type[Exception], str]] = [
    (SetBool.Response(success=1), TypeError, "success: expected bool, got int 1"),
    (SetBool.Response(success=None), TypeError, "success: expected bool, got None"),
    (SetBool.Response(message=b"on"), TypeError, "message: expected string, got bytes b'on'"),
    (SetBool.Response(message="a\0b"), ValueError, "message: a ROS string ends at NUL"),
    (SetBool.Response(message="\ud800"), ValueError, "message: cannot be encoded"),
    (UInt8(data=300), ValueError, "data: 300 is out of the range of uint8, 0 to 255"),
    (UInt8(data=-1), ValueError, "data: -1 is out of the range of uint8"),
    (UInt8(data=1.0), TypeError, "data: expected uint8, got float 1.0"),
    (Int64(data=2**63), ValueError, "data: 9223372036854775808 is out of the range of int64"),
    (Float32(data=1e39), ValueError, r"data: 1e\+39 is out of the range of float32"),
    (Float32(data=True), TypeError, "data: expected float32, got bool True"),
    (Float32(data="1"), TypeError, "data: expected float32, got str '1'"),
    (DiagnosticStatus(level=b""), ValueError, "level: expected 1 byte, got 0"),
    (DiagnosticStatus(level=b"ab"), ValueError, "level: expected 1 byte, got 2"),
    (CameraInfo(k=[1.0, 2.0]), ValueError, "k: expected 9 elements, got 2"),
    (CameraInfo(k=np.zeros(10)), ValueError, "k: expected 9 elements, got 10"),
    (CameraInfo(k=np.eye(3)), TypeError, r"k: .* got an array of shape \(3, 3\): flatten it"),
    (Arrays(bool_values=[True]), ValueError, "bool_values: expected 3 elements, got 1"),
    (Arrays(string_values=["a"] * 4), ValueError, "string_values: expected 3 elements, got 4"),
    (Arrays(byte_values=[b"a", b"b", b""]), ValueError, r"byte_values\[2\]: expected 1 byte"),
    (Arrays(basic_types_values=[BasicTypes()]), ValueError, "basic_types_values: expected 3 el"),
    (BoundedSequences(string_values=["a"] * 4), ValueError, "string_values: expected at most 3"),
    (BoundedSequences(int8_values=[1] * 4), ValueError, "int8_values: expected at most 3"),
    (shapes.SolidPrimitive(dimensions=[0.0] * 4), ValueError, "dimensions: expected at most 3"),
    (
        descriptions.FieldType(nested_type_name="ü" * 128),
        ValueError,
        "nested_type_name: expected at most 255 bytes of UTF-8, got 256",
    ),
    (WStrings(wstring_value="\ud800"), ValueError, "wstring_value: cannot be encoded"),
    (ParameterValue(bool_array_value=[True, 1]), TypeError, r"bool_array_value\[1\]: expected bo"),
    (ParameterValue(bool_array_value=np.array([1, 0])), TypeError, r"bool_array_value\[0\]: "),
    (ParameterValue(bool_array_value={True}), TypeError, r"bool_array_value: .* got set"),
    (ParameterValue(string_array_value="ab"), TypeError, r"string_array_value: .* got str 'ab'"),
    (ParameterValue(string_array_value=["a", 1]), TypeError, r"string_array_value\[1\]: expected"),
    (ParameterValue(string_array_value=["a", "\0"]), ValueError, r"string_array_value\[1\]: a ROS"),
    (ParameterValue(byte_array_value="ab"), TypeError, r"byte_array_value: expected byte\[\], got"),
    (Header(stamp=Time()), TypeError, r"stamp: .*/Time, got rclpy.time.Time: pass its to_msg\(\)"),
    (
        with_value(GetPlan.Request(), start=PoseStamped(header=Header(stamp=Time()))),
        TypeError,
        r"start.header.stamp: expected builtin_interfaces/msg/Time, got rclpy.*: pass its to_msg",
    ),
    (Header(stamp=Duration()), TypeError, r"stamp: .* got rclpy.duration.Duration: pass its to"),
    (Header(stamp=Time), TypeError, r"stamp: .* got the class rclpy.time.Time$"),
    (Pose(position=Pose()), TypeError, "position: expected geometry_msgs/msg/Point, got geometry"),
    (TwistStamped(twist=None), TypeError, "twist: expected geometry_msgs/msg/Twist, got None"),
    (
        Path(poses=[PoseStamped(), PoseStamped(pose=Pose(position=Point(x="far")))]),
        TypeError,
        r"poses\[1\].pose.position.x: expected float64, got str 'far'",
    ),
    (Path(poses=[PoseStamped(), Pose()]), TypeError, r"poses\[1\]: expected geometry_msgs/msg/Po"),
    (Path(poses=PoseStamped()), TypeError, r"poses: expected geometry_msgs/msg/PoseStamped\[\], "),
]


@pytest.mark.parametrize(("message", "error", "text"), REFUSED)
def test_what_stands_for_no_value_is_refused_with_its_path(
    message: Any, error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=f"^{text}") as caught:
        sent(message)
    assert type(caught.value) is error


def test_a_message_in_a_mapping_is_checked_too() -> None:
    with pytest.raises(TypeError, match=r"^goal.pose.position.x: expected float64, got str"):
        make_message(GetPlan.Request, {"goal": PoseStamped(pose=Pose(position=Point(x="far")))})


def test_an_instance_of_a_subclass_is_a_message() -> None:
    class Near(Point):  # type: ignore[misc]
        def __init__(self, x: Any) -> None:
            super().__init__(x=x)

    near = Near(0.5)
    assert to_dict(near) == {"x": 0.5, "y": 0.0, "z": 0.0}
    assert make_message(Point, near) is near
    assert make_message(Point, Near(np.float32(0.5))).x == 0.5
    assert make_message(Pose, Pose(position=near)).position is near


JUNK = [
    *(None, True, np.True_, 0, 1, -1, 200, 300, 2**40, 2**70, -(2**70), 0.5, 1e300, 1j),
    *(np.float32(0.5), np.int8(-3), np.uint64(2**64 - 1), "", "x", "a\0b", "\ud800", "ü" * 300),
    *(b"", b"x", b"xy", bytearray(b"x"), [], [True], [1], [0.5], ["x"], [b"x"], [None]),
    *((), (1, 2, 3), {1}, {}, {"x": 1}, {"nanosec": 5}, range(3), array.array("d", [0.5] * 3)),
    *(np.zeros(3), np.eye(3), np.array([1, 2, 3], np.uint8), np.array([True] * 3), np.array(1)),
    *(Point(), Pose(), [Point()], BasicTypes(), [BasicTypes()] * 3, object(), Time(), int),
]
TYPES = [
    *(Arrays, BoundedSequences, UnboundedSequences, BasicTypes, Nested, WStrings),
    *(GetPlan.Request, ParameterValue, CameraInfo, DiagnosticStatus, Header, Pose, Path),
]


@pytest.mark.parametrize("message_type", TYPES)
def test_whatever_a_message_holds_is_what_is_sent_or_refused(message_type: Any) -> None:
    for name in message_type.get_fields_and_field_types():
        for junk in JUNK:
            message = message_type()
            try:
                setattr(message, name, junk)
            except (TypeError, ValueError, OverflowError, RuntimeWarning):
                continue  # refused when it is set, by rclpy or NumPy
            before = repr(message)
            try:
                checked = sent(message)
            except (TypeError, ValueError) as error:
                assert str(error).startswith(name)  # noqa: PT017
            else:
                assert repr(to_dict(wired(checked))) == repr(to_dict(checked))
            assert repr(message) == before


@pytest.mark.parametrize("message_type", representatives())
@settings(max_examples=5, deadline=None)
@given(data=st.data())
def test_a_message_of_correct_values_is_sent_as_it_is(
    message_type: Any, data: st.DataObject
) -> None:
    assert checker(message_type)(to_message(message_type, data.draw(messages_of(message_type))))


def test_every_default_message_is_sent_as_it_is() -> None:
    for interface in ("nav_msgs/srv/GetMap", "test_msgs/srv/Arrays", "test_msgs/action/Fibonacci"):
        for part in parts(interface):
            assert checker(part.message_type)(part.message_type())


# On both bridges


async def test_a_request_that_cannot_be_sent_is_refused_before_it_is(session: Session) -> None:
    requests = []

    def handler(request: Any, response: Any) -> Any:
        requests.append(request)
        return response

    name = "/checked"
    async with session.serve(SetBool, name, handler):
        with pytest.raises(TypeError, match="^data: expected bool, got int 1$"):
            await session.call(SetBool, name, SetBool.Request(data=1), timeout=LIMIT)
        with pytest.raises(TypeError, match="^data: expected bool, got int 1$"):
            session.start(SetBool, name, SetBool.Request(data=1))
        with pytest.raises(TypeError, match="^data: expected bool, got int 1$"):
            await session.client(SetBool, name).call(SetBool.Request(data=1))
        async with session.pool.lease(SetBool, name) as client:
            with pytest.raises(TypeError, match="^data: expected bool, got int 1$"):
                await client.call(SetBool.Request(data=1))
        assert await session.call(SetBool, name, SetBool.Request(data=np.True_), timeout=LIMIT)
    assert requests == [SetBool.Request(data=True)]


async def test_a_response_that_cannot_be_sent_can_be_replaced(session: Session) -> None:
    name = "/checked"
    async with session.serve(SetBool, name) as server:
        task = session.start(SetBool, name, timeout=LIMIT)
        async for call in server:
            with pytest.raises(TypeError, match="^success: expected bool, got int 1$"):
                call.respond(SetBool.Response(success=1))
            with pytest.raises(ValueError, match="^message: a ROS string ends at NUL"):
                call.respond(SetBool.Response(message="\0"))
            assert not call.responded
            call.respond(SetBool.Response(success=np.True_))
            break
        assert (await task).success is True
        assert server.statistics().responded == 1


async def test_a_handlers_response_that_cannot_be_sent_goes_to_on_error(session: Session) -> None:
    errors = []

    def handler(request: Any, response: Any) -> Any:
        response.success = 1
        return response

    def on_error(call: Any, error: BaseException) -> Any:
        errors.append(str(error))
        return {"message": "replaced"}

    async with session.serve(SetBool, "/checked", handler, on_error=on_error) as server:
        response = await session.call(SetBool, "/checked", timeout=LIMIT)
        assert response.message == "replaced"
        assert (server.statistics().failed, server.statistics().responded) == (1, 1)
    assert errors == ["success: expected bool, got int 1"]
