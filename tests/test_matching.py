"""The assertions about requests, and what they show when they fail."""

from __future__ import annotations

from typing import Any

import pytest
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

from rosasync import ServiceUnavailable
from rosasync._client import call_errors
from rosasync.testing import Graph, StubServer
from rosasync.testing._matching import matches
from tests.support.times import TICK

pytestmark = pytest.mark.rosasync(strict=False)

PLAN = {"start": {"pose": {"position": {"x": 1.0, "y": 2.0}}}, "tolerance": 0.5}


async def called(graph: Graph, srv_type: Any, *requests: Any) -> StubServer:
    """Return a server that has received these requests."""
    server = graph.stub(srv_type, "/matched", {})
    async with graph.session() as session:
        for request in requests:
            await session.call(srv_type, "/matched", request)
    return server


@pytest.fixture
async def lamp(ros_graph: Graph) -> StubServer:
    return await called(ros_graph, SetBool, {"data": True}, {"data": False})


def failure(assertion: Any, *arguments: Any, **options: Any) -> str:
    """Return the message with which an assertion fails."""
    with pytest.raises(AssertionError) as failed:
        assertion(*arguments, **options)
    return str(failed.value)


async def test_how_often(lamp: StubServer, ros_graph: Graph) -> None:
    lamp.assert_called()
    lamp.assert_called(times=2)
    assert failure(lamp.assert_called, times=1).splitlines() == [
        "/matched: expected 1 call, but it received 2 requests:",
        "  1. {'data': True}",
        "  2. {'data': False}",
    ]
    spare = ros_graph.stub(SetBool, "/spare", {})
    assert failure(spare.assert_called) == ("/spare: expected a call, but it received no request")
    spare.assert_called(times=0)
    spare.assert_requests()


async def test_one_of_the_requests(ros_graph: Graph) -> None:
    planner = await called(ros_graph, GetPlan, {"tolerance": 0.25}, PLAN)
    planner.assert_called_with(tolerance=0.25)
    planner.assert_called_with(PLAN)
    planner.assert_called_with({"start": {"pose": {"position": {"y": 2.0}}}}, tolerance=0.5)
    shown = failure(planner.assert_called_with, tolerance=0.75)
    assert shown.startswith("/matched: expected a call with {'tolerance': 0.75}, but it received 2")
    assert shown.splitlines()[-2:] == ["-{'tolerance': 0.75}", "+{'tolerance': 0.5}"]


async def test_one_of_no_requests(ros_graph: Graph) -> None:
    planner = ros_graph.stub(GetPlan, "/matched", {})
    assert failure(planner.assert_called_with, tolerance=0.75).endswith("it received no request")


async def test_all_requests(lamp: StubServer) -> None:
    lamp.assert_requests({"data": True}, {"data": False})
    lamp.assert_requests({}, {})
    shown = failure(lamp.assert_requests, {"data": False}, {"data": False})
    assert shown.splitlines()[-2:] == [
        "-[{'data': False}, {'data': False}]",
        "+[{'data': True}, {'data': False}]",
    ]
    assert "expected 1 request, but it received 2" in failure(lamp.assert_requests, {"data": True})
    assert "expected 3 requests" in failure(lamp.assert_requests, {}, {}, {"data": True})


async def test_messages_in_a_sequence(ros_graph: Graph) -> None:
    speed = {"name": "speed", "value": {"type": 3, "double_value": 0.5}}
    arm = await called(ros_graph, SetParameters, {"parameters": [speed, {"name": "home"}]})
    arm.assert_called_with(parameters=[{"name": "speed"}, {"name": "home"}])
    arm.assert_called_with(parameters=[{"value": {"double_value": 0.5}}, {}])
    shown = failure(arm.assert_called_with, parameters=[{"name": "speed"}])
    assert "-{'parameters': [{'name': 'speed'}]}" in shown
    failure(arm.assert_called_with, parameters=[{"name": "home"}, {"name": "speed"}])


@pytest.mark.parametrize(
    ("srv_type", "fields", "message"),
    [
        (SetBool, {"date": True}, "no field 'date'; it has data"),
        (GetPlan, {"start": {"pose": {"positoin": {}}}}, "geometry_msgs/msg/Pose has no field"),
        (SetParameters, {"parameters": [{"nam": "a"}]}, "rcl_interfaces/msg/Parameter has no"),
    ],
)
async def test_what_no_request_can_have(
    ros_graph: Graph, srv_type: Any, fields: Any, message: str
) -> None:
    server = ros_graph.stub(srv_type, "/matched")
    with pytest.raises(ValueError, match=message):
        server.assert_called_with(fields)
    with pytest.raises(ValueError, match=message):
        server.assert_requests(fields)
    with pytest.raises(ValueError, match=message):
        server.answer({}, match=fields)


async def test_waiting_in_vain(lamp: StubServer) -> None:
    assert [call.request.data for call in await lamp.wait_for_calls(2)] == [True, False]
    with pytest.raises(AssertionError, match=r"expected 3 calls within 0.05 s, but it received 2"):
        await lamp.wait_for_calls(3, timeout=TICK)


async def test_answers_that_are_none(ros_graph: Graph) -> None:
    with pytest.raises(ValueError, match="at least one answer"):
        ros_graph.stub(SetBool, "/matched").answer()


@pytest.mark.parametrize(
    ("expected", "actual", "fit"),
    [
        ({}, {"a": 1}, True),
        ({"a": {}}, {"a": 1}, False),
        ({"a": 1}, {}, False),
        ([1, {"a": 1}], [1, {"a": 1, "b": 2}], True),
        ((1, 2), [1, 2], True),
        ([1], [1, 2], False),
        ([], "", False),
        (b"ab", b"ab", True),
    ],
)
def test_plain_values(expected: Any, actual: Any, fit: bool) -> None:
    assert matches(expected, actual) is fit


async def test_a_missing_name_lists_those_of_its_kind(
    ros_graph: Graph, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Otherwise a description that took long, as on a busy machine, serves for a while.
    monkeypatch.setattr(call_errors, "SHARED", 0)
    async with ros_graph.session() as session:
        with pytest.raises(ServiceUnavailable, match="the graph has no action$"):
            await session.act(Fibonacci, "/park", wait=False)
        ros_graph.stub_action(Fibonacci, "/drive")
        with pytest.raises(ServiceUnavailable, match="the graph has no service$"):
            await session.call(Trigger, "/park", wait=False)
        ros_graph.stub(Trigger, "/stop")
        with pytest.raises(ServiceUnavailable, match=r"the graph has /stop \(std_srvs/srv/T\w+\)$"):
            await session.call(Trigger, "/park", wait=False)
        with pytest.raises(ServiceUnavailable, match=r"the graph has /drive \(test_msgs/\S+\)$"):
            await session.act(Fibonacci, "/park", wait=False)
