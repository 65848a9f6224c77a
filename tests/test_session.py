"""A session and its calls to stock servers in another process."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from typing import TYPE_CHECKING, Any

import anyio
import pytest
from diagnostic_msgs.srv import AddDiagnostics
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from std_srvs.srv import Empty, SetBool, Trigger

from rosasync import (
    InvalidServiceName,
    ResponseTimeout,
    Retry,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from tests.support.checks import assert_clean, check_call
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.flood import flooding
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess


@pytest.mark.parametrize("calls", [300, pytest.param(1000, marks=pytest.mark.soak)])
async def test_many_calls_one_at_a_time(session: Session, echo: str, calls: int) -> None:
    for number in range(calls):
        await check_call(session, echo, str(number))
    statistics = session.pool.statistics()
    assert statistics.completed == calls
    assert statistics.created == statistics.clients == statistics.peak == 1
    await assert_clean(session)


@pytest.mark.parametrize("calls", [7, pytest.param(25, marks=pytest.mark.soak)])
async def test_calls_from_200_callers(session: Session, echo: str, calls: int) -> None:
    async def caller(name: int) -> None:
        for number in range(calls):
            await check_call(session, echo, f"{name}-{number}", timeout=4 * LIMIT)

    async with asyncio.TaskGroup() as group:
        for name in range(200):
            group.create_task(caller(name))
    statistics = session.pool.statistics()
    assert statistics.completed == 200 * calls
    assert statistics.clients == 1
    assert statistics.peak == 10
    assert statistics.late == statistics.timed_out == statistics.cancelled == 0
    await assert_clean(session)


async def test_types_and_requests_in_every_form(session: Session, server: ServerProcess) -> None:
    await server.serve("/bool", "std_srvs/srv/SetBool")
    await server.serve("/parameters", "rcl_interfaces/srv/GetParameters")
    await server.serve("/trigger", "std_srvs/srv/Trigger")
    await server.serve("/empty", "std_srvs/srv/Empty")

    response = await session.call(SetBool, "/bool", SetBool.Request(data=True))
    assert isinstance(response, SetBool.Response)
    assert response.message == "True"
    response = await session.call("std_srvs/srv/SetBool", "/bool", {"data": True})
    assert isinstance(response, SetBool.Response)
    assert response.message == "True"
    response = await session.call(SetBool, "/bool", SetBool.Request(data=True), timeout=None)
    assert response.message == "True"
    response = await session.call(GetParameters, "/parameters", {"names": ["a", "b"]})
    assert [value.string_value for value in response.values] == ["a", "b"]
    response = await session.call(Trigger, "/trigger")
    assert response.success
    response = await session.call(Empty, "/empty", None)
    assert isinstance(response, Empty.Response)
    assert session.pool.statistics().clients == 4


async def test_relative_and_private_names_share_the_client(
    session: Session, server: ServerProcess
) -> None:
    await server.serve("/echo")
    await server.serve("/test_client/mine")
    await check_call(session, "echo", "relative")
    await check_call(session, "/echo", "absolute")
    await check_call(session, "~/mine", "private")
    keys = session.pool.statistics().keys
    assert sorted(key.srv_name for key in keys) == ["/echo", "/test_client/mine"]
    assert {key.srv_type for key in keys} == {ECHO}
    assert keys[next(k for k in keys if k.srv_name == "/echo")].completed == 2


async def test_another_qos_is_another_client(session: Session, echo: str) -> None:
    await check_call(session, echo, "default")
    await check_call(session, echo, "deep", qos=QoSProfile(depth=50))
    await check_call(session, echo, "deep again", qos=QoSProfile(depth=50))
    assert session.pool.statistics().clients == 2


async def test_start_gives_a_task(session: Session, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    task = session.start(ECHO, "/echo", request_of("started"))
    assert isinstance(task, asyncio.Task)
    await server.received("/echo", 1)
    assert not task.done()
    await server.release("/echo")
    assert answer_to(await task) == "started"


async def test_a_bound_client(session: Session, server: ServerProcess) -> None:
    client = session.client(AddDiagnostics, "/echo", timeout=LIMIT)
    assert not client.ready
    with pytest.raises(ServiceUnavailable):
        await client.wait(TICK)
    await server.serve("/echo")
    assert await client.wait(LIMIT) is True
    assert client.ready
    assert answer_to(await client.call(request_of("called"))) == "called"
    assert answer_to(await client.start({"load_namespace": "started"})) == "started"
    assert session.pool.statistics().clients == 1


async def test_the_sessions_timeout_is_the_default(bridge: Bridge, server: ServerProcess) -> None:
    await server.serve("/echo", delay="never")
    async with Session("brief", bridge=bridge, timeout=4 * TICK) as session:
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        # Its own deadline is later, and none at all.
        patient = [session.start(ECHO, "/echo", timeout=seconds) for seconds in (4 * LIMIT, None)]
        with pytest.raises(ResponseTimeout):
            await session.call(ECHO, "/echo")
        with pytest.raises(ResponseTimeout):
            await session.client(ECHO, "/echo").call()
        assert not any(task.done() for task in patient)
    for task in patient:
        with pytest.raises(SessionClosed):
            await task


async def test_what_a_session_tells_of_itself(bridge: Bridge, echo: str) -> None:
    session = Session("teller", bridge=bridge)
    async with session as entered:
        assert entered is session
        assert session.bridge == bridge
        assert not session.closed
        assert session.node.get_name() == "teller"
        await check_call(session, echo, "text")
        assert session.statistics().pool == session.pool.statistics()
        assert session.statistics().bridge == bridge
    assert session.closed
    await session.aclose()


async def test_auto_takes_the_direct_bridge(echo: str) -> None:
    async with Session("auto") as session:
        assert session.bridge == "direct"
        await check_call(session, echo, "text")


async def test_opened_in_one_task_and_closed_in_another(bridge: Bridge, echo: str) -> None:
    session = Session("wanderer", bridge=bridge)
    assert await asyncio.create_task(session.open()) is session
    with pytest.raises(UsageError, match="only once"):
        await session.open()
    await asyncio.create_task(check_call(session, echo, "text"))
    await asyncio.create_task(session.aclose())
    assert session.closed


async def test_closed_by_two_tasks_at_once(bridge: Bridge, echo: str) -> None:
    session = Session("twice", bridge=bridge)
    await session.__aenter__()
    await check_call(session, echo, "text")
    await asyncio.gather(session.aclose(), session.aclose())
    assert session.closed


async def test_closing_goes_on_when_cancelled(bridge: Bridge, echo: str) -> None:
    session = Session("stubborn", bridge=bridge)
    await session.__aenter__()
    await check_call(session, echo, "text")
    threads = set(threading.enumerate())
    closing = asyncio.create_task(session.aclose())
    await asyncio.sleep(0)
    closing.cancel()
    await asyncio.wait([closing])
    assert session.closed
    assert set(threading.enumerate()) < threads
    await session.aclose()


@pytest.mark.parametrize("turns", [1, 3, 10])
def test_the_end_of_the_loop_does_not_cut_the_close_short(bridge: Bridge, turns: int) -> None:
    async def leave() -> Session:
        session = Session("interrupted", bridge=bridge)
        await session.__aenter__()
        server = session.serve(Trigger, "/late", lambda request, response: response)
        await session.wait_for_service(Trigger, "/late")
        closing.append(asyncio.create_task(session.aclose()))
        servers.append(server)
        for _ in range(turns):
            await asyncio.sleep(0)
        return session

    closing: list[asyncio.Task[None]] = []
    servers: list[Any] = []
    threads = set(threading.enumerate())
    # It cancels every task that is left, also the one that closes the session.
    session = asyncio.run(leave())
    assert session.closed
    assert closing[0].done()
    assert not session.statistics().servers
    assert session.pool.statistics().clients == 0
    assert set(threading.enumerate()) <= threads


async def test_two_sessions_in_one_process(bridge: Bridge, echo: str) -> None:
    async with Session("one", bridge=bridge) as one, Session("two", bridge=bridge) as two:

        async def caller(session: Session, name: str) -> None:
            for number in range(100):
                await check_call(session, echo, f"{name}-{number}")

        await asyncio.gather(caller(one, "one"), caller(two, "two"), caller(one, "three"))
        await one.aclose()
        await check_call(two, echo, "the other one is closed")


async def test_a_session_in_each_of_two_loops(bridge: Bridge, echo: str) -> None:
    async def program(name: str) -> None:
        async with Session(name, bridge=bridge) as session:
            for number in range(100):
                await check_call(session, echo, f"{name}-{number}")
            await assert_clean(session)

    async with asyncio.TaskGroup() as group:
        for name in ("one", "two"):
            group.create_task(asyncio.to_thread(asyncio.run, program(name)))


async def test_anyios_deadlines_and_task_groups(
    patient_session: Session, server: ServerProcess
) -> None:
    session = patient_session
    await server.serve("/echo")
    await server.serve("/never", delay="never")
    await check_call(session, "/echo", "warm")
    await session.wait_for_service(ECHO, "/never", timeout=LIMIT)
    with pytest.raises(TimeoutError):
        with anyio.fail_after(2 * TICK):
            await session.call(ECHO, "/never")
    with anyio.move_on_after(2 * TICK) as scope:
        await session.call(ECHO, "/never")
    assert scope.cancelled_caught

    async def five_and_a_failure() -> None:
        async with anyio.create_task_group() as group:
            for _ in range(5):
                group.start_soon(session.call, ECHO, "/never")
            await server.received("/never", 7)
            raise ZeroDivisionError

    with pytest.raises(ExceptionGroup) as caught:
        await five_and_a_failure()
    assert caught.group_contains(ZeroDivisionError)
    async with anyio.create_task_group() as group:
        for number in range(50):
            group.start_soon(check_call, session, "/echo", str(number))
    statistics = session.pool.statistics()
    assert statistics.cancelled == statistics.abandoned == 7
    assert statistics.completed == 51


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a b", r"must not contain characters .* \(at character 2\); 'a_b' is a valid one"),
        ("/a//b", r"repeated '/' \(at character 4\); '/a/b' is a valid one"),
        ("1a", r"a part of it must not start with a number \(at character 1\); '_1a' is"),
        ("/a/", r"must not end with a forward slash .*; '/a' is"),
        ("a{b}", r"unknown substitution"),
        ("", r"must not be empty"),
    ],
)
async def test_a_name_that_ros_does_not_allow(name: str, says: str) -> None:
    async with Session("names") as session:
        with pytest.raises(InvalidServiceName, match=f"is not a valid service name: .*{says}") as e:
            session.client(Trigger, name)
    assert ".c:" not in str(e.value)
    assert "\n" not in str(e.value)


async def test_ready_or_not(session: Session, server: ServerProcess) -> None:
    assert not session.service_is_ready(ECHO, "/echo")
    with pytest.raises(ServiceUnavailable):
        await session.wait_for_service(ECHO, "/echo", timeout=TICK)
    waiting = asyncio.create_task(session.wait_for_service(ECHO, "/echo"))
    await asyncio.sleep(0)
    await server.serve("/echo")
    assert await waiting is True
    assert session.service_is_ready(ECHO, "/echo")
    await server.stop("/echo")
    await until(lambda: not session.service_is_ready(ECHO, "/echo"))


class TestRetry:
    """Sending a request again if it is unanswered."""

    async def test_first_answer_wins_and_the_second_is_late(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        retry = Retry(attempts=2, after=2 * TICK)
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        call = session.start(ECHO, "/echo", request_of("twice"), retry=retry, timeout=LIMIT)
        assert await server.received("/echo", 2) == ["twice", "twice"]
        await server.release("/echo", 1, newest=True)
        assert answer_to(await call) == "twice"
        await server.release("/echo", 1)
        await server.answered("/echo", 2)
        await until(lambda: session.pool.statistics().late == 1)
        await assert_clean(session)
        statistics = session.pool.statistics()
        assert statistics.completed == 1
        assert statistics.retried == 1

    async def test_nothing_is_sent_again_before_its_time(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        retry = Retry(attempts=2, after=4 * LIMIT)
        call = session.start(ECHO, "/echo", request_of("once"), retry=retry)
        await server.received("/echo", 1)
        for number in range(2):
            later = session.start(ECHO, "/echo", request_of(str(number)))
            await server.received("/echo", 2 + number)
            await server.release("/echo", 1, newest=True)
            await later
        await server.release("/echo")
        assert answer_to(await call) == "once"
        assert await server.received("/echo") == ["once", "0", "1"]

    async def test_an_answer_to_the_first_attempt_counts_too(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="hold")
        retry = Retry(attempts=3, after=2 * TICK, backoff=1)
        call = session.start(ECHO, "/echo", request_of("slow"), retry=retry, timeout=LIMIT)
        await server.received("/echo", 2)
        await server.release("/echo", 1)
        assert answer_to(await call) == "slow"
        await server.release("/echo")
        await until(lambda: session.pool.statistics().late >= 1)
        await assert_clean(session)

    async def test_a_lost_request_is_answered_in_the_end(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", skip=2)
        retry = Retry(attempts=3, after=2 * TICK, backoff=2)
        await check_call(session, "/echo", "third time", retry=retry)
        assert await server.received("/echo") == ["third time"] * 3

    async def test_the_deadline_is_the_whole_calls(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay="never")
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        retry = Retry(attempts=100, after=TICK, backoff=1)
        with pytest.raises(ResponseTimeout):
            await session.call(ECHO, "/echo", retry=retry, timeout=6 * TICK)
        retried = session.pool.statistics().retried
        assert retried < 99
        assert len(await server.received("/echo", 1 + retried)) == 1 + retried

    async def test_never_without_being_asked_for(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo", delay=10 * TICK)
        await check_call(session, "/echo", "once")
        assert await server.received("/echo") == ["once"]

    async def test_answers_every_call_beside_a_flood_with_a_blocked_loop(
        self, session: Session, echo: str
    ) -> None:
        await session.wait_for_service(ECHO, echo, timeout=LIMIT)
        retry = Retry(attempts=100, after=4 * TICK, backoff=1)

        async def block() -> None:
            while True:
                time.sleep(TICK)  # noqa: ASYNC251
                await asyncio.sleep(TICK / 10)

        with flooding(echo):
            blocking = asyncio.create_task(block())
            for first in range(0, 60, 10):
                texts = [f"call {number}" for number in range(first, first + 10)]
                options = {"retry": retry, "timeout": 4 * LIMIT}
                await asyncio.gather(*(check_call(session, echo, t, **options) for t in texts))
            blocking.cancel()


class TestBadInput:
    """What is rejected at once, before anything is sent."""

    async def test_a_message_of_the_wrong_type(self, session: Session, echo: str) -> None:
        with pytest.raises(TypeError, match=r"(?s)AddDiagnostics.*SetBool|SetBool.*AddDiagnostics"):
            await session.call(ECHO, echo, SetBool.Request())

    async def test_a_response_as_the_request(self, session: Session, echo: str) -> None:
        with pytest.raises(TypeError, match=r"Response"):
            await session.call(ECHO, echo, AddDiagnostics.Response())

    @pytest.mark.parametrize("srv_type", ["std_srvs/srv/Nope", "nope_srvs/srv/SetBool", "nope", ""])
    async def test_an_unknown_type_name(self, session: Session, srv_type: str) -> None:
        with pytest.raises(ValueError, match=repr(srv_type)):
            await session.call(srv_type, "/echo")

    @pytest.mark.parametrize("srv_type", [None, 7, dict, AddDiagnostics.Request])
    async def test_what_is_no_service_type(self, session: Session, srv_type: Any) -> None:
        with pytest.raises(TypeError):
            await session.call(srv_type, "/echo")

    async def test_an_unknown_field(self, session: Session, echo: str) -> None:
        with pytest.raises(ValueError, match="load_namespaces"):
            await session.call(ECHO, echo, {"load_namespaces": "x"})

    async def test_a_field_of_the_wrong_type(self, session: Session, echo: str) -> None:
        with pytest.raises(TypeError, match="load_namespace"):
            await session.call(ECHO, echo, {"load_namespace": 7})

    async def test_a_value_out_of_range(self, session: Session) -> None:
        with pytest.raises(ValueError, match=r"transition\.id"):
            await session.call(
                "lifecycle_msgs/srv/ChangeState", "/change", {"transition": {"id": 256}}
            )

    @pytest.mark.parametrize("name", ["", "/", "two words", "/a//b", "9lives", "/a/", "/~x"])
    async def test_an_invalid_service_name(self, session: Session, name: str) -> None:
        with pytest.raises(InvalidServiceName) as caught:
            await session.call(ECHO, name)
        assert isinstance(caught.value, ValueError)
        with pytest.raises(InvalidServiceName):
            session.service_is_ready(ECHO, name)

    @pytest.mark.parametrize("timeout", [-1, -0.001, float("nan")])
    def test_a_default_timeout_that_has_run_out(self, timeout: float) -> None:
        with pytest.raises(ValueError, match="timeout"):
            Session(timeout=timeout)

    async def test_a_timeout_that_is_not_a_number(self, session: Session, echo: str) -> None:
        with pytest.raises(ValueError, match="timeout"):
            await session.call(ECHO, echo, timeout=math.nan)
        with pytest.raises(ValueError, match="timeout"):
            await session.wait_for_service(ECHO, echo, timeout=math.nan)

    @pytest.mark.parametrize("timeout", ["1", True, object()])
    async def test_a_timeout_that_is_no_number(
        self, session: Session, echo: str, timeout: Any
    ) -> None:
        with pytest.raises(TypeError, match="timeout"):
            await session.call(ECHO, echo, timeout=timeout)

    async def test_an_unknown_bridge(self) -> None:
        with pytest.raises(ValueError, match="bridge"):
            Session(bridge="ferry")  # type: ignore[arg-type]

    async def test_a_closed_session(self, bridge: Bridge, echo: str) -> None:
        async with Session("closed", bridge=bridge) as session:
            client = session.client(ECHO, echo)
            await client.call(request_of("open"))
        with pytest.raises(SessionClosed):
            await session.call(ECHO, echo)
        with pytest.raises(SessionClosed):
            await client.call()
        with pytest.raises(SessionClosed):
            await session.wait_for_service(ECHO, echo)
        with pytest.raises(SessionClosed):
            session.service_is_ready(ECHO, echo)
        with pytest.raises(SessionClosed):
            session.start(ECHO, echo)
        with pytest.raises(SessionClosed):
            await session.pool.warm(ECHO, echo)
        with pytest.raises(SessionClosed):
            async with session.pool.lease(ECHO, echo):
                pytest.fail("a closed session has no clients")

    async def test_a_session_not_opened_yet_or_twice(self, bridge: Bridge) -> None:
        session = Session("early", bridge=bridge)
        with pytest.raises(UsageError):
            await session.call(ECHO, "/echo")
        async with session:
            with pytest.raises(UsageError):
                await session.__aenter__()
        with pytest.raises((SessionClosed, UsageError)):
            await session.__aenter__()

    def test_opened_without_async(self) -> None:
        with (
            pytest.raises(UsageError, match="async with rosasync.Session"),
            Session("plain"),
        ):
            pytest.fail("it is not open")

    def test_in_two_loops_of_one_thread(self) -> None:
        session = FakeGraph().session()
        first = asyncio.new_event_loop()
        first.run_until_complete(session.__aenter__())
        with pytest.raises(UsageError, match="open a session in each loop"):
            asyncio.run(session.call(ECHO, "/echo"))
        with pytest.raises(UsageError, match="in a coroutine of its loop"):
            session.start(ECHO, "/echo")
        first.run_until_complete(session.aclose())
        first.close()

    async def test_from_another_loop(self, session: Session, echo: str) -> None:
        def elsewhere() -> None:
            with pytest.raises(UsageError, match="use session.from_thread"):
                asyncio.run(session.call(ECHO, echo))
            with pytest.raises(UsageError):
                asyncio.run(session.aclose())

        await asyncio.to_thread(elsewhere)
        await check_call(session, echo, "from its own loop")

    async def test_from_another_thread(self, session: Session, echo: str) -> None:
        def elsewhere() -> None:
            with pytest.raises(UsageError):
                session.start(ECHO, echo)

        await asyncio.to_thread(elsewhere)
        await check_call(session, echo, "from its own thread")

    async def test_nothing_of_it_was_sent_or_left(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve("/echo")
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        for request in (SetBool.Request(), {"nope": 1}, {"load_namespace": 7}, "text", 7):
            with pytest.raises((TypeError, ValueError)):
                await session.call(ECHO, "/echo", request)
        await check_call(session, "/echo", "good")
        assert await server.received("/echo") == ["good"]
        await assert_clean(session)
