"""Recordings: of a session, of other nodes by their introspection events, and their files."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.service_introspection import ServiceIntrospectionState
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import SetBool, Trigger

from rosasync import Limits, ResponseTimeout, Retry, Session
from rosasync.parameters import ParameterClient
from rosasync.testing import Graph, RecordedCall, Recording
from tests.conftest import Bridge
from tests.support.introspected import NAME, PARAMETER, IntrospectedProcess
from tests.support.nodes import borrowed_node
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK, until

SET_BOOL = "std_srvs/srv/SetBool"
LAMP = "/recorded/lamp"
ON, OFF = {"data": True}, {"data": False}


def answer(number: int) -> dict[str, Any]:
    return {"success": True, "message": str(number)}


@pytest.fixture
def stock() -> Iterator[IntrospectedProcess]:
    """A stock node that publishes its calls, if its parameter says so."""
    with IntrospectedProcess() as process:
        yield process


@asynccontextmanager
async def listening(
    recording: Recording,
    session: Session,
    service: tuple[Any, str],
    to: Session | IntrospectedProcess,
    publishers: int = 1,
) -> AsyncIterator[None]:
    """Listen to a service, whose events are discovered when the block begins.

    Args:
        recording: what gets the calls.
        session: the session that listens.
        service: the type and the name of the service.
        to: whose events.
        publishers: how many publishers of events there are.
    """
    async with recording.listen(session, service):
        await discovered(session, to, service[1], publishers)
        yield


async def discovered(
    session: Session, to: Session | IntrospectedProcess, name: str, publishers: int
) -> None:
    """Wait until publishers of events and a subscription know each other."""
    topic = f"{name}/_service_event"
    await until(lambda: session.node.count_publishers(topic) >= publishers)
    if isinstance(to, IntrospectedProcess):
        await until(lambda: to.listeners)
    else:
        await until(lambda: to.node.count_subscribers(topic))
    # Matched is what is discovered a moment later.
    await asyncio.sleep(4 * TICK)


class TestOfASession:
    async def test_of_stock_services(self, server: ServerProcess, bridge: Bridge) -> None:
        await server.serve(LAMP, SET_BOOL)
        recording = Recording()
        async with recording.session("recorder", bridge=bridge, timeout=2 * LIMIT) as session:
            await session.call(SetBool, LAMP, ON)
            await session.call(SET_BOOL, "recorded/lamp", OFF)
        assert recording.calls == [
            RecordedCall(LAMP, SET_BOOL, ON, {"success": True, "message": "True"}),
            RecordedCall(LAMP, SET_BOOL, OFF, {"success": True, "message": "False"}),
        ]
        assert repr(recording) == "<Recording 2 calls>"

    async def test_answers_out_of_order(self, server: ServerProcess) -> None:
        await server.serve(LAMP, SET_BOOL, delay="hold")
        recording = Recording()
        async with recording.session("recorder", timeout=2 * LIMIT) as session:
            calls = [session.start(SetBool, LAMP, request) for request in (ON, OFF)]
            await server.received(LAMP, at_least=2)
            await server.release(LAMP, newest=True)
            await asyncio.gather(*calls)
        assert [call.request for call in recording.calls] == [ON, OFF]
        assert [call.response["message"] for call in recording.calls if call.response] == [
            "True",
            "False",
        ]

    async def test_what_is_not_answered(self, server: ServerProcess) -> None:
        await server.serve(LAMP, SET_BOOL, skip=2)
        recording = Recording()
        async with recording.session("recorder", timeout=2 * LIMIT) as session:
            await session.wait_for_service(SetBool, LAMP)
            with pytest.raises(ResponseTimeout):
                await session.call(SetBool, LAMP, ON, timeout=4 * TICK)
            await session.call(SetBool, LAMP, ON, retry=Retry(after=4 * TICK))
        responses = [call.response for call in recording.calls]
        assert responses[:2] == [None, None]
        assert responses[2] == {"success": True, "message": "True"}

    async def test_of_a_borrowed_node(self, server: ServerProcess) -> None:
        await server.serve(LAMP, SET_BOOL)
        recording = Recording()
        with borrowed_node() as node:
            async with recording.session(node, timeout=2 * LIMIT) as session:
                assert session.node is node
                await session.call(SetBool, LAMP, ON)
        assert len(recording.calls) == 1


class TestOfOtherNodes:
    @pytest.fixture
    async def session(self) -> AsyncIterator[Session]:
        async with Session("listener", timeout=2 * LIMIT) as session:
            yield session

    async def test_of_a_stock_server(self, stock: IntrospectedProcess, session: Session) -> None:
        node = ParameterClient(session, "/watched", timeout=2 * LIMIT)
        await node.set(PARAMETER, "contents")
        recording = Recording()
        async with listening(recording, session, (SetBool, NAME), stock):
            for data in (True, False):
                await asyncio.to_thread(stock.call, data)
            await until(lambda: len(recording.calls) == 2 and recording.calls[1].response)
        await asyncio.to_thread(stock.call, True)
        assert recording.calls == [
            RecordedCall(NAME, SET_BOOL, ON, {"success": True, "message": ""}),
            RecordedCall(NAME, SET_BOOL, OFF, {"success": False, "message": ""}),
        ]

    async def test_both_sides_publish_and_each_call_counts_once(self, session: Session) -> None:
        recording = Recording()
        async with Session("both", introspection="contents", timeout=2 * LIMIT) as both:

            async def switch(request: Any, response: Any) -> Any:
                response.success = request.data
                return response

            async with both.serve(SetBool, LAMP, switch):
                await both.call(SetBool, LAMP)
                async with listening(recording, session, (SET_BOOL, LAMP), both, publishers=2):
                    await asyncio.gather(*(both.call(SetBool, LAMP, ON) for _ in range(5)))
                    await both.call(SetBool, LAMP, OFF)
                    await until(lambda: len(recording.calls) == 6 and recording.calls[5].response)
        assert [call.request for call in recording.calls] == [ON] * 5 + [OFF]
        assert all(call.response for call in recording.calls)

    async def test_two_clients_of_one_process_with_equal_requests(self, session: Session) -> None:
        recording = Recording()
        limits = Limits(clients=2, in_flight=1)
        async with Session(
            "both", introspection="contents", limits=limits, timeout=2 * LIMIT
        ) as both:
            held: list[Any] = []
            async with both.serve(SetBool, LAMP, lambda call: held.append(call)):
                await both.pool.warm(SetBool, LAMP, clients=2)
                async with listening(recording, session, (SetBool, LAMP), both, publishers=3):
                    calls = [both.start(SetBool, LAMP, ON) for _ in range(2)]
                    await until(lambda: len(held) == 2)
                    for call in held:
                        call.respond(SetBool.Response(success=True))
                    await asyncio.gather(*calls)
                    await until(lambda: len([c for c in recording.calls if c.response]) == 2)
                    # Longer than a third one would take.
                    await asyncio.sleep(4 * TICK)
        assert [call.request for call in recording.calls] == [ON, ON]

    async def test_what_a_server_does_not_answer(self, session: Session) -> None:
        recording = Recording()
        async with Session("both", introspection="contents", timeout=2 * LIMIT) as both:
            held: list[Any] = []
            async with both.serve(SetBool, LAMP, lambda call: held.append(call)):
                await both.wait_for_service(SetBool, LAMP)
                async with listening(recording, session, (SetBool, LAMP), both, publishers=2):
                    call = both.start(SetBool, LAMP, ON)
                    await until(lambda: held)
                    await until(lambda: recording.calls)
                    assert recording.calls == [RecordedCall(LAMP, SET_BOOL, ON, None)]
                    held.pop().respond(SetBool.Response(success=True))
                    await call
                    await until(lambda: recording.calls[0].response)

    async def test_events_without_contents(
        self,
        stock: IntrospectedProcess,
        session: Session,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        node = ParameterClient(session, "/watched", timeout=2 * LIMIT)
        await node.set(PARAMETER, "metadata")
        recording = Recording()
        async with listening(recording, session, (SetBool, NAME), stock):
            for _ in range(2):
                await asyncio.to_thread(stock.call, True)
            await until(lambda: "have no contents" in caplog.text)
        warnings = [r for r in caplog.records if r.levelno == logging.WARNING]
        assert len([r for r in warnings if "have no contents" in r.message]) == 1
        assert recording.calls == []

    async def test_events_that_are_best_effort(self, session: Session) -> None:
        recording = Recording()
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        contents = ServiceIntrospectionState.CONTENTS
        with borrowed_node("best_effort") as node:
            async with Session(node, timeout=2 * LIMIT) as other:
                service = node.create_service(SetBool, LAMP, lambda request, response: response)
                service.configure_introspection(node.get_clock(), qos, contents)
                await until(lambda: session.node.count_publishers(f"{LAMP}/_service_event"))
                async with recording.listen(session, (SetBool, LAMP)):
                    while not recording.calls:
                        await other.call(SetBool, LAMP, ON)
                        await asyncio.sleep(TICK)
        assert recording.calls[0].request == ON

    async def test_a_relative_name_and_several_services(self, session: Session) -> None:
        recording = Recording()
        services: list[tuple[Any, str]] = [(SetBool, "recorded/lamp"), (Trigger, "recorded/bell")]
        async with Session("both", introspection="contents", timeout=2 * LIMIT) as both:
            for srv_type, srv_name in services:
                both.serve(srv_type, srv_name, lambda request, response: response)
                await both.call(srv_type, srv_name)
            async with recording.listen(session, *services):
                for _, srv_name in services:
                    await discovered(session, both, f"/{srv_name}", publishers=2)
                for srv_type, srv_name in services:
                    await both.call(srv_type, srv_name)
                await until(lambda: len(recording.calls) == 2)
        assert {call.srv_name for call in recording.calls} == {LAMP, "/recorded/bell"}

    async def test_a_type_that_does_not_exist(self, session: Session) -> None:
        before = len(list(session.node.subscriptions))
        with pytest.raises(ValueError, match="NoSuch"):
            async with Recording().listen(session, (SetBool, LAMP), ("std_srvs/srv/NoSuch", LAMP)):
                raise AssertionError
        assert len(list(session.node.subscriptions)) == before


class TestFiles:
    def test_every_kind_of_value_comes_back(self, tmp_path: Path) -> None:
        info = {"width": 640, "k": [0.1] * 9, "distortion_model": "plumb\n°", "d": [float("inf")]}
        call = RecordedCall("/camera", "sensor_msgs/srv/SetCameraInfo", {"camera_info": info})
        Recording([call]).save(tmp_path / "file.yaml")
        assert Recording.load(tmp_path / "file.yaml").calls == [call]

    @pytest.mark.parametrize(
        ("text", "error", "message"),
        [
            ("", ValueError, "is not a recording of format 1"),
            ("rosasync-recording: 2", ValueError, "is not a recording of format 1"),
            ("[1]", ValueError, "is not a recording of format 1"),
            ("calls: [{srv_name: /a}]", ValueError, "is not a recorded call: .*srv_type"),
            ("calls: [3]", ValueError, "3 is not a recorded call"),
            ("calls: 3", ValueError, "is not a list of calls"),
            ("calls: [{srv_name: /a, srv_type: x/srv/Y, request: {}}]", ValueError, "x/srv/Y"),
            (
                "calls: [{srv_name: /a, srv_type: std_srvs/srv/SetBool, request: {date: 1}}]",
                ValueError,
                "date: no such field",
            ),
            (
                "calls: [{srv_name: /a, srv_type: std_srvs/srv/SetBool, request: {data: 1}}]",
                TypeError,
                "data",
            ),
        ],
    )
    def test_what_is_no_recording(
        self, tmp_path: Path, text: str, error: type[Exception], message: str
    ) -> None:
        path = tmp_path / "file.yaml"
        path.write_text(f"rosasync-recording: 1\n{text}\n" if text.startswith("calls") else text)
        with pytest.raises(error, match=message):
            Recording.load(path)

    def test_an_empty_one(self, tmp_path: Path) -> None:
        Recording().save(tmp_path / "file.yaml")
        assert Recording.load(tmp_path / "file.yaml").calls == []


@pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True)
class TestReplay:
    async def test_several_services(self, ros_graph: Graph) -> None:
        calls = [
            RecordedCall(LAMP, SET_BOOL, ON, answer(1)),
            RecordedCall("/bell", "std_srvs/srv/Trigger", {}, answer(2)),
            RecordedCall(LAMP, SET_BOOL, OFF, answer(3)),
            RecordedCall(LAMP, SET_BOOL, ON, answer(4)),
        ]
        servers = ros_graph.replay(Recording(calls))
        assert list(servers) == [LAMP, "/bell"]
        async with ros_graph.session(timeout=2 * LIMIT) as session:
            asked: list[tuple[Any, str, Any]] = [
                (SetBool, LAMP, OFF),
                (SetBool, LAMP, ON),
                (Trigger, "/bell", {}),
                (SetBool, LAMP, ON),
                (SetBool, LAMP, ON),
            ]
            answers = [(await session.call(*one)).message for one in asked]
        assert answers == ["3", "1", "2", "4", "4"]

    async def test_a_request_that_was_not_recorded(self, ros_graph: Graph) -> None:
        recording = Recording([RecordedCall(LAMP, SET_BOOL, ON, answer(1))])
        lamp = ros_graph.replay(recording)[LAMP]
        async with ros_graph.session(timeout=2 * LIMIT) as session:
            await session.wait_for_service(SetBool, LAMP)
            with pytest.raises(ResponseTimeout):
                await session.call(SetBool, LAMP, OFF, timeout=4 * TICK)
            await lamp.wait_for_calls(1)
        with pytest.raises(AssertionError, match="has no answer left for {'data': False}"):
            ros_graph.check()
        ros_graph.strict = False

    async def test_optional(self, ros_graph: Graph) -> None:
        call = RecordedCall(LAMP, SET_BOOL, ON, answer(1))
        ros_graph.replay(Recording([call]), optional=True)
        ros_graph.check()

    async def test_not_a_number(self, ros_graph: Graph) -> None:
        info = {"camera_info": {"k": [float("nan")] * 9}}
        recorded = RecordedCall("/camera", "sensor_msgs/srv/SetCameraInfo", info, {"success": True})
        camera = ros_graph.replay(Recording([recorded]))["/camera"]
        async with ros_graph.session(timeout=2 * LIMIT) as session:
            assert (await session.call(SetCameraInfo, "/camera", info, timeout=LIMIT)).success
        camera.assert_called_with(info)
