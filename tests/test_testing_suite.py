"""What a user tests with `rosasync.testing`: one suite, in memory and on real ROS."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from rcl_interfaces.srv import GetParameters
from std_srvs.srv import SetBool, Trigger

from rosasync import (
    AsyncServiceProxy,
    InvalidServiceName,
    ResponseTimeout,
    Retry,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync.parameters import ParameterClient
from rosasync.testing import Graph, Recording, VirtualClock
from tests.support.times import LIMIT, TICK, until

pytestmark = pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True)

LAMP = "/suite/lamp"


@pytest.fixture
async def session(ros_graph: Graph) -> AsyncIterator[Session]:
    async with ros_graph.session(timeout=2 * LIMIT) as session:
        yield session


async def switch(session: Session, on: bool = True, **options: Any) -> SetBool.Response:
    """The code under test."""
    return await session.call(SetBool, LAMP, {"data": on}, **options)


def plain(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success = request.data
    return response


async def asynchronous(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    await asyncio.sleep(0)
    return plain(request, response)


def with_call(call: Any) -> SetBool.Response:
    return plain(call.request, call.response)


async def responding_later(call: Any) -> None:
    asyncio.get_running_loop().call_soon(call.respond, plain(call.request, call.response))


class TestHandlers:
    @pytest.mark.parametrize("handler", [plain, asynchronous, with_call, responding_later])
    async def test_every_kind(
        self, ros_graph: Graph, session: Session, handler: Callable[..., Any]
    ) -> None:
        lamp = ros_graph.serve(SetBool, LAMP, handler)
        assert (await switch(session)).success
        assert not (await switch(session, False)).success
        assert lamp.requests == [{"data": True}, {"data": False}]
        assert [call.response and call.response.success for call in lamp.calls] == [True, False]

    async def test_iteration(self, ros_graph: Graph, session: Session) -> None:
        lamp = ros_graph.serve("std_srvs/srv/SetBool", LAMP)
        pending = session.start(SetBool, LAMP, {"data": True})
        async for call in lamp:
            call.respond(plain(call.request, call.response))
            break
        assert (await pending).success

    async def test_an_error_is_not_the_callers(
        self, ros_graph: Graph, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        def broken(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
            raise ZeroDivisionError

        lamp = ros_graph.serve(SetBool, LAMP, broken)
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        with pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert lamp.server.statistics().failed == 1
        assert "ZeroDivisionError" in caplog.text

    async def test_hooks_and_limits(self, ros_graph: Graph, session: Session) -> None:
        def broken(call: Any) -> None:
            raise ValueError(call.request.data)

        def repair(call: Any, error: Exception) -> SetBool.Response:
            return SetBool.Response(message=str(error))

        ros_graph.serve(SetBool, LAMP, broken, on_error=repair, concurrency=1)
        assert (await switch(session)).message == "True"

    async def test_what_is_no_handler(self, ros_graph: Graph) -> None:
        with pytest.raises(TypeError, match="handler"):
            ros_graph.serve(SetBool, LAMP, lambda: None)  # type: ignore[arg-type]
        assert ros_graph.servers == []


class TestAnswers:
    async def test_one_for_all(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP, {"message": "yes"})
        assert [(await switch(session)).message for _ in range(3)] == ["yes"] * 3

    async def test_in_turn(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP, {"message": "a"}, SetBool.Response(message="b"))
        assert [(await switch(session)).message for _ in range(2)] == ["a", "b"]

    async def test_by_the_fields_of_the_request(self, ros_graph: Graph, session: Session) -> None:
        lamp = ros_graph.stub(SetBool, LAMP)
        lamp.answer({"message": "off"}, match={"data": False})
        lamp.answer({"message": "first"}, {"message": "second"}, match=lambda r: r.data)
        lamp.answer({"message": "otherwise"})
        answers = [await switch(session, on) for on in (True, False, True, True)]
        assert [a.message for a in answers] == ["first", "off", "second", "otherwise"]

    @pytest.mark.parametrize("error", [OSError("burnt out"), OSError])
    async def test_an_exception(
        self,
        ros_graph: Graph,
        session: Session,
        error: Exception,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        ros_graph.stub(SetBool, LAMP, error, {"success": True})
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        with pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert (await switch(session)).success
        assert "OSError" in caplog.text

    async def test_no_answer(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP, None, {"success": True})
        assert (await switch(session, retry=Retry(after=2 * TICK))).success

    async def test_what_does_not_fit(self, ros_graph: Graph) -> None:
        lamp = ros_graph.stub(SetBool, LAMP, optional=True)
        for answer, error in (({"succes": True}, ValueError), ({"success": 1}, TypeError)):
            with pytest.raises(error, match="succes"):
                lamp.answer(answer)
        with pytest.raises(TypeError, match="an answer is"):
            lamp.answer("yes")
        with pytest.raises(ValueError, match="no field 'date'"):
            lamp.answer({}, match={"date": True})


class TestFaults:
    @pytest.fixture(autouse=True)
    async def lamp(self, ros_graph: Graph, session: Session) -> Any:
        lamp = ros_graph.stub(SetBool, LAMP, {"success": True})
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        return lamp

    async def test_delay(self, lamp: Any, session: Session) -> None:
        with lamp.delay_responses(4 * TICK):
            with pytest.raises(ResponseTimeout):
                await switch(session, timeout=TICK)
            assert (await switch(session)).success

    async def test_lost_requests(self, lamp: Any, session: Session) -> None:
        with lamp.drop_requests(), pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert lamp.calls == []
        assert (await switch(session)).success

    async def test_lost_responses(self, lamp: Any, session: Session) -> None:
        with lamp.drop_responses(), pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert lamp.calls[0].response.success
        assert (await switch(session)).success

    async def test_late(self, lamp: Any, session: Session) -> None:
        with lamp.hold_responses():
            with pytest.raises(ResponseTimeout):
                await switch(session, timeout=4 * TICK)
            await lamp.wait_for_calls(1, timeout=LIMIT)
        await until(lambda: session.pool.statistics().late == 1)
        assert (await switch(session)).success

    async def test_twice(self, lamp: Any, session: Session) -> None:
        with lamp.duplicate_responses():
            assert (await switch(session)).success
            await until(lambda: session.pool.statistics().late == 1)
        assert (await switch(session)).success
        assert session.pool.statistics().completed == 2

    async def test_vanish_and_come_back(self, lamp: Any, session: Session) -> None:
        with lamp.hold_responses():
            call = session.start(SetBool, LAMP, {"data": True})
            await lamp.wait_for_calls(1, timeout=LIMIT)
            await lamp.vanish()
        with pytest.raises(ServerGone):
            await call
        await until(lambda: not session.service_is_ready(SetBool, LAMP))
        with pytest.raises(ServiceUnavailable):
            await switch(session, wait=False)
        call = session.start(SetBool, LAMP, {"data": False})
        await lamp.come_back()
        await lamp.come_back()
        assert (await call).success
        lamp.assert_requests({"data": True}, {"data": False})

    async def test_one_server_alone(self, ros_graph: Graph, lamp: Any, session: Session) -> None:
        other = ros_graph.stub(Trigger, "/suite/other", {"message": "here"})
        with lamp.drop_responses():
            assert (await session.call(Trigger, "/suite/other")).message == "here"
        assert (await switch(session)).success
        other.assert_called(times=1)

    async def test_they_combine(self, lamp: Any, session: Session) -> None:
        with lamp.delay_responses(2 * TICK), lamp.duplicate_responses():
            assert (await switch(session)).success
            await until(lambda: session.pool.statistics().late == 1)
        with lamp.drop_requests(), lamp.hold_responses(), pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert session.pool.statistics().late == 1

    async def test_they_end_with_their_block(self, lamp: Any, session: Session) -> None:
        blocks = [lamp.delay_responses(LIMIT), lamp.drop_requests(), lamp.drop_responses()]
        for block in [*blocks, lamp.hold_responses(), lamp.duplicate_responses()]:
            with pytest.raises(ZeroDivisionError), block:
                raise ZeroDivisionError
        assert (await switch(session)).success
        assert session.pool.statistics().late == 0

    @pytest.mark.parametrize("fault", ["delay_responses", "drop_responses", "hold_responses"])
    async def test_a_crash_before_the_response(
        self, lamp: Any, session: Session, fault: str
    ) -> None:
        seconds = [LIMIT] if fault == "delay_responses" else []
        with getattr(lamp, fault)(*seconds):
            call = session.start(SetBool, LAMP, {"data": True})
            await lamp.wait_for_calls(1, timeout=LIMIT)
            await lamp.vanish()
            await lamp.vanish()
            with pytest.raises(ServerGone):
                await call
        assert repr(lamp) == f"<StubServer {LAMP} vanished, 1 call>"
        await lamp.come_back()
        assert (await switch(session)).success
        assert repr(lamp) == f"<StubServer {LAMP} up, 2 calls>"

    async def test_a_crash_while_the_handler_runs(
        self, ros_graph: Graph, lamp: Any, session: Session
    ) -> None:
        cancelled = []

        async def endless(request: Any, response: Any) -> Any:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                cancelled.append(request.data)
                raise

        other = ros_graph.serve(SetBool, "/suite/endless", endless)
        call = session.start(SetBool, "/suite/endless", {"data": True})
        await other.wait_for_calls(1, timeout=LIMIT)
        await other.vanish()
        with pytest.raises(ServerGone):
            await call
        assert cancelled == [True]
        assert (await switch(session)).success

    async def test_a_retry_after_a_crash(self, lamp: Any, session: Session) -> None:
        with lamp.drop_responses():
            call = session.start(SetBool, LAMP, {"data": True}, retry=Retry(after=LIMIT))
            await lamp.wait_for_calls(1, timeout=LIMIT)
            await lamp.vanish()
            await until(lambda: not session.service_is_ready(SetBool, LAMP))
        await lamp.come_back()
        assert (await call).success
        lamp.assert_called(times=2)


class TestMessages:
    async def test_each_side_has_its_own(self, ros_graph: Graph, session: Session) -> None:
        kept = SetBool.Response(message="before")

        def change(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
            request.data = False
            return kept

        lamp = ros_graph.serve(SetBool, LAMP, change)
        request = SetBool.Request(data=True)
        response = await session.call(SetBool, LAMP, request)
        kept.message = "after"
        assert request.data
        assert response.message == "before"
        assert lamp.requests == [{"data": True}]
        (call,) = lamp.calls
        assert call.response is not None
        assert call.response.message == "before"

    async def test_what_the_middleware_reports(self, ros_graph: Graph, session: Session) -> None:
        infos = []

        def look(call: Any) -> SetBool.Response:
            infos.append(call.info)
            return call.response

        ros_graph.serve(SetBool, LAMP, look)
        before = time.time_ns()
        await switch(session)
        await switch(session)
        assert infos[0].sequence_number < infos[1].sequence_number
        for info in infos:
            assert before <= info.source_timestamp <= info.received_timestamp <= time.time_ns()

    async def test_the_wrong_kind_is_refused(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP, optional=True)
        for request in (Trigger.Request(), {"data": 1}, 3):
            with pytest.raises(TypeError):
                await session.call(SetBool, LAMP, request)
        with pytest.raises(ValueError, match="date"):
            await session.call(SetBool, LAMP, {"date": True})


class TestNames:
    @pytest.mark.parametrize("name", ["suite/lamp", LAMP])
    async def test_relative_and_absolute(
        self, ros_graph: Graph, session: Session, name: str
    ) -> None:
        lamp = ros_graph.stub(SetBool, name, {"success": True})
        assert lamp.srv_name == LAMP
        assert (await switch(session)).success
        assert (await session.call(SetBool, name)).success

    async def test_private(self, ros_graph: Graph) -> None:
        ros_graph.stub(SetBool, "/suite_node/lamp", {"success": True})
        async with ros_graph.session("suite_node", timeout=2 * LIMIT) as session:
            assert (await session.call(SetBool, "~/lamp")).success

    @pytest.mark.parametrize("name", ["", "/", "a b", "1a", "a//b", "/a/", "a-b", "ä"])
    async def test_what_ros_does_not_allow(
        self, ros_graph: Graph, session: Session, name: str
    ) -> None:
        with pytest.raises(InvalidServiceName):
            await session.call(SetBool, name)
        with pytest.raises(InvalidServiceName):
            ros_graph.stub(SetBool, name)
        assert ros_graph.servers == []

    async def test_what_is_no_name(self, session: Session) -> None:
        name: Any = 3
        with pytest.raises(TypeError, match="must be a str"):
            await session.call(SetBool, name)


class TestSeveralServers:
    async def test_of_one_name(self, ros_graph: Graph, session: Session) -> None:
        lamps = [ros_graph.stub(SetBool, LAMP, {"success": True}) for _ in range(2)]
        await until(lambda: session.service_is_ready(SetBool, LAMP))
        async with session.pool.lease(SetBool, LAMP) as client:
            while not all(lamp.calls for lamp in lamps):
                assert (await client.call({"data": True})).success
        await lamps[0].vanish()
        assert (await switch(session, False)).success
        assert lamps[1].requests[-1] == {"data": False}

    async def test_of_another_type(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(Trigger, LAMP, optional=True)
        # The middleware allows one type for each name in a process.
        error = UsageError if ros_graph.kind == "real" else ServiceUnavailable
        with pytest.raises(error, match=r"lamp.* type|served as std_srvs/srv/Trigger"):
            await switch(session, timeout=TICK)

    async def test_a_hundred_calls_at_once(self, ros_graph: Graph, session: Session) -> None:
        lamp = ros_graph.serve(SetBool, LAMP, asynchronous)
        wanted = [number % 3 == 0 for number in range(100)]
        answers = await asyncio.gather(*(switch(session, on) for on in wanted))
        assert [answer.success for answer in answers] == wanted
        lamp.assert_called(times=100)


async def test_parameters_of_a_stub(ros_graph: Graph, session: Session) -> None:
    value = {"type": 3, "double_value": 0.5}
    get = ros_graph.stub(GetParameters, "/suite_arm/get_parameters", {"values": [value]})
    arm = ParameterClient(session, "/suite_arm", timeout=LIMIT)
    assert await arm.get("speed") == 0.5
    get.assert_requests({"names": ["speed"]})


class TestProxiesAndThreads:
    async def test_a_proxy(self, ros_graph: Graph, session: Session) -> None:
        lamp = ros_graph.stub(SetBool, LAMP, {"success": True})
        proxy = AsyncServiceProxy(session, SetBool, LAMP)
        proxy.call_service(SetBool.Request(data=True))
        await lamp.wait_for_calls(1, timeout=LIMIT)
        await until(lambda: proxy.get_state().name == "RESPONSE_READY")
        response = proxy.get_response()
        assert response is not None
        assert response.success
        proxy.shutdown()

    async def test_another_thread(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP, {"success": True})
        request = SetBool.Request(data=True)
        response = await asyncio.to_thread(session.from_thread.call, SetBool, LAMP, request)
        assert response.success


async def test_the_end_of_the_session(ros_graph: Graph) -> None:
    lamp = ros_graph.stub(SetBool, LAMP, {"success": True})
    async with ros_graph.session() as session:
        with lamp.hold_responses():
            call = session.start(SetBool, LAMP, {"data": True})
            await lamp.wait_for_calls(1, timeout=LIMIT)
            await session.aclose()
            with pytest.raises(SessionClosed):
                await call


async def test_a_deadline_takes_no_time(
    ros_graph: Graph, session: Session, virtual_clock: VirtualClock
) -> None:
    lamp = ros_graph.stub(SetBool, LAMP, None)
    await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
    before = virtual_clock.time()
    with pytest.raises(ResponseTimeout, match=r"within [1-9]\d(\.\d)? s"):
        await virtual_clock.skip(switch(session, timeout=10.0))
    assert virtual_clock.time() >= before + 10
    lamp.assert_called(times=1)


async def test_a_recording(ros_graph: Graph, virtual_clock: VirtualClock, tmp_path: Path) -> None:
    recording = Recording()
    lamp = ros_graph.stub(SetBool, LAMP, {"message": "a"}, {"message": "b"}, None)
    async with ros_graph.session(recording=recording) as session:
        assert (await switch(session, timeout=LIMIT)).message == "a"
        assert (await switch(session, timeout=LIMIT)).message == "b"
        with pytest.raises(ResponseTimeout):
            await switch(session, False, timeout=4 * TICK)
    await lamp.vanish()
    recording.save(tmp_path / "lamp.yaml")
    assert (tmp_path / "lamp.yaml").read_text().startswith("rosasync-recording: 1\ncalls:\n")

    loaded = Recording.load(tmp_path / "lamp.yaml")
    assert loaded.calls == recording.calls
    replayed = ros_graph.replay(loaded)[LAMP]
    async with ros_graph.session() as session:
        answers = [await switch(session, timeout=LIMIT) for _ in range(3)]
        assert [answer.message for answer in answers] == ["a", "b", "b"]
        with pytest.raises(ResponseTimeout):
            await switch(session, False, timeout=4 * TICK)
    replayed.assert_called(times=4)


class TestStrictness:
    async def test_a_call_nobody_serves(self, ros_graph: Graph, session: Session) -> None:
        with pytest.raises(ServiceUnavailable):
            await switch(session, timeout=TICK)
        with pytest.raises(AssertionError, match=rf"{LAMP} \(std_srvs/srv/SetBool\) was called"):
            ros_graph.check()
        ros_graph.strict = False

    async def test_a_server_nobody_calls(self, ros_graph: Graph) -> None:
        ros_graph.stub(SetBool, LAMP, {})
        ros_graph.stub(SetBool, "/suite/spare", {}, optional=True)
        with pytest.raises(AssertionError) as failure:
            ros_graph.check()
        assert str(failure.value).splitlines()[1:] == [f"{LAMP} was never called"]
        ros_graph.strict = False

    async def test_a_lost_request_is_a_call(self, ros_graph: Graph, session: Session) -> None:
        lamp = ros_graph.stub(SetBool, LAMP, {})
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        with lamp.drop_requests(), pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        assert lamp.lost_requests == 1
        with pytest.raises(AssertionError, match=r"no request \(1 request lost on the way\)"):
            lamp.assert_called()
        ros_graph.check()

    async def test_a_server_that_comes_later(self, ros_graph: Graph, session: Session) -> None:
        call = session.start(SetBool, LAMP, {"data": True})
        await asyncio.sleep(4 * TICK)
        ros_graph.stub(SetBool, LAMP, {"success": True})
        assert (await call).success
        ros_graph.check()

    async def test_a_request_without_an_answer(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP).answer({}, match={"data": False})
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        with pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        with pytest.raises(AssertionError, match="has no answer left for {'data': True}"):
            ros_graph.check()
        ros_graph.strict = False
