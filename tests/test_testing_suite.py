"""What a user tests with `rosasync.testing`: one suite, in memory and on real ROS."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from std_srvs.srv import SetBool, Trigger

from rosasync import (
    AsyncServiceProxy,
    ResponseTimeout,
    Retry,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
)
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
        assert [call.response.success for call in lamp.calls] == [True, False]

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
            ros_graph.serve(SetBool, LAMP, lambda: None)
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
        lamp.come_back()
        lamp.come_back()
        assert (await call).success
        lamp.assert_requests({"data": True}, {"data": False})

    async def test_one_server_alone(self, ros_graph: Graph, lamp: Any, session: Session) -> None:
        other = ros_graph.stub(Trigger, "/suite/other", {"message": "here"})
        with lamp.drop_responses():
            assert (await session.call(Trigger, "/suite/other")).message == "here"
        assert (await switch(session)).success
        other.assert_called(times=1)


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
    with pytest.raises(ResponseTimeout, match="within 10 s"):
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

    async def test_a_request_without_an_answer(self, ros_graph: Graph, session: Session) -> None:
        ros_graph.stub(SetBool, LAMP).answer({}, match={"data": False})
        await session.wait_for_service(SetBool, LAMP, timeout=LIMIT)
        with pytest.raises(ResponseTimeout):
            await switch(session, timeout=4 * TICK)
        with pytest.raises(AssertionError, match="has no answer left for {'data': True}"):
            ros_graph.check()
        ros_graph.strict = False
