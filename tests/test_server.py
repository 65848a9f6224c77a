"""Servers: handlers in every form, deferred responses, limits, errors, endings."""

from __future__ import annotations

import asyncio
import functools
import gc
import logging
import threading
import time
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

import anyio
import pytest
import rclpy
from diagnostic_msgs.srv import AddDiagnostics
from rclpy.executors import MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from rosasync import (
    ContextShutdown,
    InvalidServiceName,
    ResponseTimeout,
    ServerGone,
    ServerStatistics,
    ServiceCall,
    ServiceServer,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync.ports import Unmatched
from rosasync.ros.services import take_requests
from tests.support.clients import ClientProcess
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.serving import FORMS, Holder, ask, echo_of, serving, settled
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from rosasync.testing import FakeGraph
    from tests.conftest import Bridge

Response = AddDiagnostics.Response
RCLError: type[Exception] = rclpy_implementation.RCLError


def echo_call(call: ServiceCall) -> Any:
    return echo_of(call.request)


@pytest.fixture
async def holder(session: Session) -> AsyncIterator[Holder]:
    """A server ``/held`` that keeps its calls."""
    holder = Holder()
    async with session.serve(ECHO, "/held", holder):
        yield holder


@pytest.fixture
def server_log(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    """What the library logs."""
    with caplog.at_level(logging.WARNING, "rosasync"):
        yield caplog


class TestForms:
    @pytest.mark.parametrize("form", FORMS)
    async def test_stock_clients_get_their_answers(
        self, session: Session, client_process: ClientProcess, form: str
    ) -> None:
        # A name of its own: clients made now may still know the server of the last test.
        name = f"/{session.bridge}_{list(FORMS).index(form)}"
        async with serving(session, name, form) as server:
            called = await client_process.run(name, 20, way="call")
            sent = await client_process.run(name, 100, way="call_async", in_flight=8)
            assert (called.answered, sent.answered) == (20, 100)
            await settled(server)
            statistics = server.statistics()
            assert statistics.taken == statistics.responded == 120
            assert statistics.failed == statistics.dropped == statistics.undeliverable == 0

    async def test_handlers_that_are_no_functions(self, session: Session) -> None:
        class Object:
            async def __call__(self, call: ServiceCall) -> Any:
                return echo_of(call.request)

            def method(self, request: Any, response: Any) -> Any:
                return echo_of(request)

        def tagged(tag: str, call: ServiceCall, mark: str = "!") -> Any:
            return Response(message=tag + call.request.load_namespace + mark)

        async def coroutine(call: ServiceCall) -> Any:
            return echo_of(call.request)

        handlers: dict[str, Any] = {
            "object": Object(),
            "method": Object().method,
            "partial": functools.partial(tagged, ""),
            "by keyword": functools.partial(tagged, "", mark=""),
            "lambda": lambda call: coroutine(call),
        }
        for number, (kind, handler) in enumerate(handlers.items()):
            session.serve(ECHO, f"/handler_{number}", handler)
            answer = await ask(session, f"/handler_{number}", kind)
            assert answer.removesuffix("!") == kind

    @pytest.mark.parametrize(
        "handler",
        [
            42,
            "echo",
            Response,
            lambda: None,
            lambda one, two, three: None,
            lambda *, call: None,
            lambda *calls: None,
        ],
        ids=repr,
    )
    async def test_bad_handlers(self, session: Session, handler: Any) -> None:
        before = len(list(session.node.services))
        with pytest.raises(TypeError, match="handler"):
            session.serve(ECHO, "/bad", handler)
        assert session.statistics().servers == ()
        assert len(list(session.node.services)) == before

    async def test_generators_are_no_handlers(self, session: Session) -> None:
        def generator(call: ServiceCall) -> Iterator[Any]:
            yield call.response

        async def async_generator(call: ServiceCall) -> AsyncIterator[Any]:
            yield call.response

        for handler in (generator, async_generator):
            with pytest.raises(TypeError, match="yield"):
                session.serve(ECHO, "/bad", handler)

    async def test_other_bad_arguments(self, session: Session) -> None:
        with pytest.raises(TypeError, match="on_error"):
            session.serve(ECHO, "/bad", echo_call, on_error=3)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="on_overload"):
            session.serve(ECHO, "/bad", echo_call, on_overload="x")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="concurrency"):
            session.serve(ECHO, "/bad", echo_call, concurrency=0)
        with pytest.raises(ValueError, match="backlog"):
            session.serve(ECHO, "/bad", echo_call, backlog=-1)
        with pytest.raises(TypeError, match="qos"):
            session.serve(ECHO, "/bad", echo_call, qos=10)
        with pytest.raises(InvalidServiceName):
            session.serve(ECHO, "/b a d", echo_call)
        with pytest.raises((TypeError, ValueError)):
            session.serve("no/srv/Such", "/bad", echo_call)
        assert session.statistics().servers == ()

    async def test_iterating_over_a_server_with_a_handler(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        with pytest.raises(UsageError, match="handler"):
            await anext(server)

    async def test_a_handler_that_calls_another_service_of_the_session(
        self, session: Session
    ) -> None:
        async def relay(call: ServiceCall) -> Any:
            return await session.call(ECHO, "/inner", call.request)

        session.serve(ECHO, "/inner", echo_call)
        session.serve(ECHO, "/outer", relay)
        answers = await asyncio.gather(*(ask(session, "/outer", str(n)) for n in range(50)))
        assert answers == [str(n) for n in range(50)]

    async def test_a_handler_that_calls_its_own_server(self, session: Session) -> None:
        async def countdown(request: Any, response: Any) -> Any:
            left = int(request.load_namespace)
            if left:
                return await session.call(ECHO, "/own", request_of(str(left - 1)))
            return Response(message="landed")

        session.serve(ECHO, "/own", countdown)
        assert await ask(session, "/own", "5") == "landed"

    async def test_many_at_once_that_call_their_own_server(
        self, session: Session, client_process: ClientProcess
    ) -> None:
        async def handler(request: Any, response: Any) -> Any:
            text = request.load_namespace
            if text.endswith("!"):
                return Response(message=text.removesuffix("!"))
            return await session.call(ECHO, f"/own_{session.bridge}", request_of(text + "!"))

        session.serve(ECHO, f"/own_{session.bridge}", handler)
        tally = await client_process.run(
            f"/own_{session.bridge}", 50, clients=4, in_flight=10, depth=1000
        )
        assert (tally.answered, tally.wrong, tally.lost) == (200, 0, 0)


class TestCall:
    async def test_what_it_tells(self, session: Session) -> None:
        calls: list[ServiceCall] = []

        def handler(call: ServiceCall) -> Any:
            calls.append(call)
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler)
        before = time.time_ns()
        for number in range(3):
            await ask(session, "/served", str(number))
        infos = [call.info for call in calls]
        first = infos[0].sequence_number
        assert [info.sequence_number for info in infos] == [first, first + 1, first + 2]
        for info in infos:
            assert info.source_timestamp is not None
            assert info.received_timestamp is not None
            assert before <= info.source_timestamp <= info.received_timestamp <= time.time_ns()
        call = calls[0]
        assert call.server is server
        assert call.request.load_namespace == "0"
        assert call.responded
        assert call.response is call.response
        assert isinstance(call.response, Response)
        assert repr(call) == f"<ServiceCall /served #{first} answered>"

    async def test_answered_later_and_in_another_order(
        self, session: Session, holder: Holder
    ) -> None:
        tasks = [ask(session, "/held", str(number)) for number in range(5)]
        calls = await holder.held(5)
        assert not any(call.responded for call in calls)
        for call in reversed(calls):
            call.respond(echo_of(call.request))
            assert call.responded
        assert await asyncio.gather(*tasks) == [str(number) for number in range(5)]
        (statistics,) = session.statistics().servers
        assert statistics.deferred == statistics.taken == statistics.responded == 5
        assert statistics.unanswered == 0

    async def test_answered_from_another_thread(self, session: Session, holder: Holder) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        await asyncio.to_thread(call.respond, echo_of(call.request))
        assert await task == "text"

    async def test_the_message_may_be_changed_afterwards(
        self, session: Session, holder: Holder
    ) -> None:
        tasks = [ask(session, "/held", str(number)) for number in range(3)]
        response = Response()
        for number, call in enumerate(await holder.held(3)):
            response.message = f"answer {number}"
            call.respond(response)
            response.message = "changed"
        assert sorted(await asyncio.gather(*tasks)) == [f"answer {n}" for n in range(3)]

    async def test_twice(self, session: Session, holder: Holder) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        call.respond(echo_of(call.request))
        with pytest.raises(UsageError, match="/held: this call was answered"):
            call.respond(Response(message="second"))
        assert await task == "text"
        (statistics,) = session.statistics().servers
        assert statistics.responded == 1

    @pytest.mark.parametrize("wrong", [None, "text", {"message": "text"}, SetBool.Response()])
    async def test_of_the_wrong_type(self, session: Session, holder: Holder, wrong: Any) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        with pytest.raises(TypeError, match="AddDiagnostics_Response"):
            call.respond(wrong)
        assert not call.responded
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_one_that_cannot_be_converted_may_be_mended(
        self, session: Session, holder: Holder
    ) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        with pytest.raises(UnicodeEncodeError):
            call.respond(Response(message="\ud800"))
        assert not call.responded
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_after_the_close(self, session: Session) -> None:
        holder = Holder()
        async with session.serve(ECHO, "/held", holder) as server:
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
        with pytest.raises(SessionClosed, match="/held"):
            call.respond(Response())
        with pytest.raises(SessionClosed):
            await asyncio.to_thread(call.respond, Response())
        with pytest.raises(ServerGone):
            await task
        assert server.statistics().dropped == 1
        assert server.statistics().unanswered == 0

    async def test_dropped_unanswered(self, session: Session) -> None:
        server = session.serve(ECHO, "/mute", lambda call: None)
        task = ask(session, "/mute", "text", timeout=2 * TICK)
        with pytest.warns(ResourceWarning, match="/mute: a call was dropped unanswered"):
            await asyncio.wait([task])
        assert isinstance(task.exception(), ResponseTimeout)
        statistics = server.statistics()
        assert (statistics.taken, statistics.deferred, statistics.dropped) == (1, 1, 1)
        assert statistics.unanswered == statistics.responded == 0

    async def test_dropped_unanswered_in_another_thread(
        self, session: Session, holder: Holder
    ) -> None:
        task = ask(session, "/held", "text", timeout=LIMIT)
        await holder.held(1)

        def drop() -> None:
            with pytest.warns(ResourceWarning, match="/held"):
                holder.calls.clear()

        await asyncio.to_thread(drop)
        await until(lambda: session.statistics().servers[0].dropped == 1)
        task.cancel()

    async def test_dropped_after_the_close_is_nobodys_fault(self, session: Session) -> None:
        holder = Holder()
        async with session.serve(ECHO, "/held", holder):
            task = ask(session, "/held", "text")
            await holder.held(1)
        holder.calls.clear()
        gc.collect()
        with pytest.raises(ServerGone):
            await task


class TestIteration:
    async def test_two_tasks_share_the_calls(self, session: Session) -> None:
        server = session.serve(ECHO, "/served")
        who: dict[str, list[str]] = {"one": [], "two": []}

        async def iterate(name: str) -> None:
            async for call in server:
                who[name].append(call.request.load_namespace)
                await asyncio.sleep(0)
                call.respond(echo_of(call.request))

        tasks = [asyncio.create_task(iterate(name)) for name in who]
        await asyncio.gather(*(ask(session, "/served", str(n)) for n in range(10)))
        assert all(who.values())
        await server.aclose()
        await asyncio.gather(*tasks)

    async def test_a_call_granted_to_a_cancelled_task_goes_to_the_next(
        self, session: Session
    ) -> None:
        server = session.serve(ECHO, "/served")
        victim = asyncio.create_task(anext(server))
        await asyncio.sleep(0)
        served = server._on_request
        done = asyncio.Event()

        def deliver(request: Any, header: Any) -> None:
            served(request, header)
            victim.cancel()
            done.set()

        server._port._deliver = deliver  # type: ignore[attr-defined]
        task = ask(session, "/served", "text")
        await done.wait()
        with pytest.raises(asyncio.CancelledError):
            await victim
        call = await anext(server)
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_a_cancelled_task_is_passed_over(self, session: Session) -> None:
        server = session.serve(ECHO, "/served")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(TICK):
                await anext(server)
        with pytest.raises(TimeoutError):
            with anyio.fail_after(TICK):
                await anext(server)
        task = ask(session, "/served", "text")
        call = await anext(server)
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_what_waits_at_the_close_is_dropped(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        server = session.serve(ECHO, "/served")
        tasks = [ask(session, "/served", str(n)) for n in range(3)]
        await until(lambda: server.statistics().waiting == 3)
        await server.aclose()
        assert [call async for call in server] == []
        assert server.statistics().dropped == 3
        assert "closed with 3 requests waiting" in server_log.text
        for task in tasks:
            with pytest.raises(ServerGone):
                await task


class TestLimits:
    async def test_never_more_than_three_run_and_the_rest_in_order(self, session: Session) -> None:
        running = most = 0
        order: list[str] = []
        step = asyncio.Semaphore(0)

        async def handler(request: Any, response: Any) -> Any:
            nonlocal running, most
            order.append(request.load_namespace)
            running += 1
            most = max(most, running)
            await step.acquire()
            running -= 1
            return echo_of(request)

        server = session.serve(ECHO, "/served", handler, concurrency=3)
        texts = [f"{n:02}" for n in range(10)]
        tasks = [ask(session, "/served", text) for text in texts]
        await until(lambda: server.statistics().taken == 10)
        assert (server.statistics().running, server.statistics().waiting) == (3, 7)
        assert repr(server) == f"<ServiceServer /served [{ECHO}] 3 running, 7 waiting>"
        for _ in texts:
            step.release()
            await asyncio.sleep(0)
        assert await asyncio.gather(*tasks) == texts
        assert order == texts
        assert most == 3

    async def test_beyond_the_backlog_somebody_answers(self, session: Session) -> None:
        gate = asyncio.Event()

        async def handler(call: ServiceCall) -> Any:
            await gate.wait()
            return echo_of(call.request)

        async def busy(call: ServiceCall) -> Any:
            await asyncio.sleep(0)
            return Response(message="busy")

        for number, on_overload in enumerate((lambda call: Response(message="busy"), busy)):
            gate.clear()
            name = f"/served_{number}"
            server = session.serve(
                ECHO, name, handler, concurrency=1, backlog=2, on_overload=on_overload
            )
            tasks = [ask(session, name, str(n)) for n in range(5)]
            assert await asyncio.gather(*tasks[3:]) == ["busy", "busy"]
            gate.set()
            assert await asyncio.gather(*tasks[:3]) == ["0", "1", "2"]
            statistics = server.statistics()
            assert (statistics.rejected, statistics.dropped, statistics.responded) == (2, 0, 5)

    async def test_beyond_the_backlog_nobody_answers(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        gate = asyncio.Event()

        async def handler(call: ServiceCall) -> Any:
            holder(call)
            await gate.wait()
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler, concurrency=1, backlog=1)
        tasks = [ask(session, "/served", str(n), timeout=None) for n in range(6)]
        await until(lambda: server.statistics().rejected == 4)
        assert server.statistics().dropped == 4
        assert len(server_log.messages) == 1
        assert "/served: 1 requests wait already" in server_log.text
        gate.set()
        assert await asyncio.gather(*tasks[:2]) == ["0", "1"]
        await settled(server)
        assert server.statistics().responded == 2
        for task in tasks[2:]:
            task.cancel()

    async def test_an_on_overload_that_raises(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        def on_overload(call: ServiceCall) -> None:
            raise ValueError("overtaxed")

        server = session.serve(ECHO, "/served", backlog=0, on_overload=on_overload)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().dropped == 1)
        assert "overtaxed" in server_log.text
        task.cancel()


class TestErrors:
    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    async def test_a_handler_that_raises(
        self, session: Session, server_log: pytest.LogCaptureFixture, asynchronous: bool
    ) -> None:
        def handler(request: Any, response: Any) -> Any:
            if request.load_namespace == "bad":
                raise ValueError("not today")
            return echo_of(request)

        async def async_handler(request: Any, response: Any) -> Any:
            await asyncio.sleep(0)
            return handler(request, response)

        server = session.serve(ECHO, "/served", async_handler if asynchronous else handler)
        task = ask(session, "/served", "bad", timeout=None)
        await until(lambda: server.statistics().failed == 1)
        assert await ask(session, "/served", "good") == "good"
        assert not task.done()
        task.cancel()
        statistics = server.statistics()
        assert (statistics.taken, statistics.responded, statistics.unanswered) == (2, 1, 0)
        (record,) = server_log.records
        assert "/served" in record.message
        assert record.exc_info is not None
        assert "not today" in str(record.exc_info[1])

    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    async def test_on_error_answers(
        self, session: Session, server_log: pytest.LogCaptureFixture, asynchronous: bool
    ) -> None:
        def handler(call: ServiceCall) -> Any:
            raise ValueError("not today")

        def on_error(call: ServiceCall, error: Exception) -> Any:
            return Response(message=f"{call.request.load_namespace}: {error}")

        async def async_on_error(call: ServiceCall, error: Exception) -> Any:
            await asyncio.sleep(0)
            return on_error(call, error)

        hook = async_on_error if asynchronous else on_error
        server = session.serve(ECHO, "/served", handler, on_error=hook)
        assert await ask(session, "/served", "text") == "text: not today"
        statistics = server.statistics()
        assert (statistics.failed, statistics.responded, statistics.unanswered) == (1, 1, 0)

    @pytest.mark.parametrize("answer", [None, "no response"])
    async def test_on_error_does_not_answer(
        self, session: Session, server_log: pytest.LogCaptureFixture, answer: Any
    ) -> None:
        calls: list[ServiceCall] = []

        def handler(call: ServiceCall) -> Any:
            calls.append(call)
            raise ValueError("not today")

        server = session.serve(ECHO, "/served", handler, on_error=lambda call, error: answer)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().failed == 1)
        assert server.statistics().unanswered == 0
        with pytest.raises(UsageError, match="its handler failed"):
            calls[0].respond(Response())
        task.cancel()

    async def test_an_on_error_that_raises(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        async def on_error(call: ServiceCall, error: Exception) -> Any:
            raise KeyError("worse")

        server = session.serve(ECHO, "/served", lambda call: 1 / 0, on_error=on_error)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: "worse" in server_log.text)
        assert server.statistics().unanswered == 0
        task.cancel()

    @pytest.mark.parametrize("wrong", ["text", SetBool.Response(), True])
    async def test_a_handler_that_returns_the_wrong_type(
        self, session: Session, server_log: pytest.LogCaptureFixture, wrong: Any
    ) -> None:
        server = session.serve(
            ECHO,
            "/served",
            lambda call: wrong,
            on_error=lambda call, error: Response(message=type(error).__name__),
        )
        assert await ask(session, "/served", "text") == "TypeError"
        assert server.statistics().failed == 1

    async def test_one_of_request_and_response_may_not_return_none(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        server = session.serve(
            ECHO,
            "/served",
            lambda request, response: None,
            on_error=lambda call, error: Response(message=str(error)),
        )
        assert "None" in await ask(session, "/served", "text")
        assert server.statistics().failed == 1
        assert server.statistics().deferred == 0

    async def test_a_handler_that_responds_and_returns_a_response(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        errors: list[Exception] = []

        def handler(call: ServiceCall) -> Any:
            call.respond(Response(message="first"))
            return Response(message="second")

        server = session.serve(
            ECHO, "/served", handler, on_error=lambda call, error: errors.append(error)
        )
        assert await ask(session, "/served", "text") == "first"
        assert (server.statistics().responded, server.statistics().failed) == (1, 1)
        assert "answered" in server_log.text
        assert errors == [], "there is nothing left to answer"

    async def test_a_handler_that_cancels_itself(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        async def handler(call: ServiceCall) -> Any:
            raise asyncio.CancelledError

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().dropped == 1)
        assert [record.message for record in server_log.records] == [
            f"/served: the handler of {_repr_of(1)} was cancelled"
        ]
        task.cancel()


def _repr_of(number: int) -> str:
    return f"<ServiceCall /served #{number} given up: its handler was cancelled>"


class TestClose:
    async def test_handlers_finish(self, session: Session) -> None:
        gate = asyncio.Event()

        async def handler(call: ServiceCall) -> Any:
            await gate.wait()
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler, concurrency=2)
        tasks = [ask(session, "/served", str(n)) for n in range(5)]
        await until(lambda: server.statistics().taken == 5)
        closing = [asyncio.create_task(server.aclose()) for _ in range(2)]
        await asyncio.sleep(TICK)
        assert server.closed
        assert not closing[0].done()
        gate.set()
        assert await asyncio.gather(*tasks) == [str(n) for n in range(5)]
        await asyncio.gather(*closing)
        await server.aclose()
        assert server.statistics().responded == 5
        assert session.statistics().servers == ()

    async def test_the_rest_is_cancelled_after_the_deadline(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        cancelled: list[str] = []

        async def handler(call: ServiceCall) -> Any:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                cancelled.append(call.request.load_namespace)
                raise

        server = session.serve(ECHO, "/served", handler, concurrency=2)
        tasks = [ask(session, "/served", str(n)) for n in range(3)]
        await until(lambda: server.statistics().taken == 3)
        await server.aclose(2 * TICK)
        assert sorted(cancelled) == ["0", "1"]
        assert server.statistics().dropped == 3
        for task in tasks:
            with pytest.raises(ServerGone):
                await task
        assert sum("was cancelled" in message for message in server_log.messages) == 2
        assert sum("1 requests waiting" in message for message in server_log.messages) == 1

    async def test_no_request_is_taken_meanwhile(self, session: Session) -> None:
        gate = asyncio.Event()

        async def handler(call: ServiceCall) -> Any:
            await gate.wait()
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "first")
        await until(lambda: server.statistics().taken == 1)
        closing = asyncio.create_task(server.aclose())
        await asyncio.sleep(0)
        late = ask(session, "/served", "late")
        await asyncio.sleep(TICK)
        assert server.statistics().taken == 1
        gate.set()
        assert await task == "first"
        await closing
        with pytest.raises(ServerGone):
            await late

    async def test_a_handler_that_closes_its_server(self, session: Session) -> None:
        closed = asyncio.Event()

        async def handler(call: ServiceCall) -> None:
            call.respond(echo_of(call.request))
            await call.server.aclose()
            closed.set()

        session.serve(ECHO, "/served", handler)
        assert await ask(session, "/served", "text") == "text"
        await asyncio.wait_for(closed.wait(), 10 * TICK)

    async def test_a_handler_that_ignores_its_cancellation(
        self, session: Session, server_log: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync.server.LAST_STEPS", TICK)
        gate = asyncio.Event()
        ended: list[object] = []

        async def handler(call: ServiceCall) -> Any:
            while not gate.is_set():
                try:
                    await gate.wait()
                except asyncio.CancelledError:
                    continue
            try:
                call.respond(echo_of(call.request))
            except SessionClosed as error:
                ended.append(error)
                raise

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "text")
        await until(lambda: server.statistics().running == 1)
        await server.aclose(0)
        assert "1 handlers ignore their cancellation" in server_log.text
        gate.set()
        await until(lambda: server.statistics().running == 0)
        assert len(ended) == 1
        assert server.statistics().failed == 0
        with pytest.raises(ServerGone):
            await task

    async def test_what_it_tells_afterwards(self, session: Session) -> None:
        async with session.serve(Trigger, "served", lambda call: call.response) as server:
            assert isinstance(server, ServiceServer)
            assert isinstance(server.handle, Service)
            assert not server.closed
            assert server.qos.depth == 1000
        assert server.closed
        assert server.srv_name == "/served"
        assert server.srv_type == "std_srvs/srv/Trigger"
        assert isinstance(server.qos, QoSProfile)
        assert server.qos.depth == 1000
        assert repr(server) == "<ServiceServer /served [std_srvs/srv/Trigger] closed>"
        assert server.statistics() == ServerStatistics("/served")
        with pytest.raises(SessionClosed):
            _ = server.handle

    async def test_its_qos(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call, qos=QoSProfile(depth=7))
        assert server.qos.depth == 7

    async def test_from_elsewhere(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        with pytest.raises(UsageError):
            await asyncio.to_thread(asyncio.run, server.aclose())
        assert not server.closed

    async def test_its_end_waits_for_a_send_under_way(self, session: Session) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        port = server._port
        send, close = port.send, port.close
        sending, go_on = threading.Event(), threading.Event()
        order: list[str] = []

        def slow_send(header: Any, response: Any) -> None:
            sending.set()
            assert go_on.wait(LIMIT)
            order.append("sent")
            send(header, response)

        def noted_close() -> None:
            order.append("closed")
            close()

        port.send, port.close = slow_send, noted_close  # type: ignore[method-assign]
        sender = asyncio.create_task(asyncio.to_thread(call.respond, echo_of(call.request)))
        await asyncio.to_thread(sending.wait, LIMIT)

        def release() -> None:
            deadline = time.monotonic() + LIMIT
            while server._outlet.ending is None and time.monotonic() < deadline:
                time.sleep(TICK / 10)
            order.append("closing")
            go_on.set()

        releaser = threading.Thread(target=release)
        releaser.start()
        await server.aclose()
        releaser.join()
        await sender
        assert order == ["closing", "sent", "closed"]
        assert await task == "text"

    async def test_with_the_session_its_handlers_may_still_call(self, bridge: Bridge) -> None:
        async with Session("client", bridge=bridge) as client:
            async with Session("closing", bridge=bridge) as session:
                gate = asyncio.Event()

                async def handler(call: ServiceCall) -> Any:
                    await gate.wait()
                    return await session.call(ECHO, "/elsewhere", call.request)

                client.serve(ECHO, "/elsewhere", echo_call)
                server = session.serve(ECHO, "/served", handler)
                task = ask(client, "/served", "text")
                await until(lambda: server.statistics().running == 1)
                closing = asyncio.create_task(session.aclose())
                await asyncio.sleep(0)
                with pytest.raises(SessionClosed):
                    session.serve(ECHO, "/late", echo_call)
                gate.set()
                assert await task == "text"
                await closing
            assert server.closed

    async def test_with_the_context(self, bridge: Bridge) -> None:
        async with Session("doomed", bridge=bridge) as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            iterated = session.serve(ECHO, "/iterated")
            waiting = asyncio.create_task(anext(iterated))
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            await asyncio.to_thread(session.node.context.try_shutdown)
            with pytest.raises(ContextShutdown):
                await task
            with pytest.raises(ContextShutdown):
                await asyncio.wait_for(waiting, LIMIT)
            await until(lambda: server.closed)
            with pytest.raises(ContextShutdown):
                call.respond(Response())
            with pytest.raises(ContextShutdown):
                session.serve(ECHO, "/late", echo_call)
            await server.aclose()

    async def test_with_a_session_that_is_dropped(self, bridge: Bridge) -> None:
        session = Session("dropped", bridge=bridge)
        await session.__aenter__()
        server = session.serve(ECHO, "/served", echo_call)
        assert await ask(session, "/served", "text") == "text"
        sessions = [session]
        del session
        with pytest.warns(ResourceWarning, match="unclosed"):
            sessions.clear()
        await until(lambda: server.closed)
        assert server.statistics().responded == 1


class TestClients:
    async def test_the_same_sequence_numbers(self, session: Session) -> None:
        holder = Holder()
        session.serve(ECHO, "/held", holder)
        async with ClientProcess() as one, ClientProcess() as two:
            for process, tag in ((one, "one"), (two, "two")):
                await process.start("/held", 10, in_flight=10, depth=1000, tag=tag)
            calls = await holder.held(20)
            numbers = sorted(call.info.sequence_number for call in calls)
            assert numbers == sorted([*range(1, 11), *range(1, 11)])
            for call in reversed(calls):
                call.respond(echo_of(call.request))
            for process in (one, two):
                tally = await process.result()
                assert (tally.answered, tally.wrong, tally.lost) == (10, 0, 0)

    async def test_one_that_has_gone(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        async with ClientProcess() as process:
            await process.start("/held", 3, in_flight=3, timeout=LIMIT)
            calls = await holder.held(3)
            await asyncio.to_thread(process.kill)
        assert session.bridge in ("direct", "executor")
        calls[0].respond(echo_of(calls[0].request))
        assert server.statistics().responded + server.statistics().undeliverable == 1
        assert await self.answered(session, holder) == "still serving"

    async def answered(self, session: Session, holder: Holder) -> str:
        task = ask(session, "/held", "still serving")
        call = (await holder.held(len(holder.calls) + 1))[-1]
        call.respond(echo_of(call.request))
        return await task

    async def test_the_last_one_has_gone(
        self, session: Session, server_log: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        async with ClientProcess() as process:
            await process.start("/held", 1, timeout=4 * TICK)
            (call,) = await holder.held(1)
            assert (await process.result()).lost == 1
        await until(lambda: not server._port.has_clients())
        call.respond(echo_of(call.request))
        assert server.statistics().undeliverable == 1
        assert server.statistics().responded == 0
        assert "reaches nobody" in server_log.text
        assert call.responded


class TestFaults:
    """What the middleware may do to a response, with a port that does it on demand."""

    async def test_a_client_that_was_just_made_gets_its_answer_later(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 2)
            tasks = [ask(session, "/held", str(number)) for number in range(2)]
            first, second = await holder.held(2)
            response = Response(message="first")
            first.respond(response)
            response.message = "changed"
            await asyncio.to_thread(second.respond, Response(message="second"))
            assert first.responded
            assert server.statistics().responded == 0
            assert server.statistics().unanswered == 2
            assert await asyncio.gather(*tasks) == ["first", "second"]
            assert server.statistics().responded == 2

    async def test_one_that_is_never_discovered(
        self, fake_graph: FakeGraph, server_log: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync.server.RESEND", (0.0, TICK))
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 3)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)
            call.respond(Response())
            await until(lambda: server.statistics().undeliverable == 1)
            assert server.statistics().unanswered == server.statistics().responded == 0
            assert "reaches nobody" in server_log.text
            task.cancel()

    async def test_the_close_waits_for_the_next_attempt(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            async with session.serve(ECHO, "/held", holder) as server:
                fail_sends(server, 1)
                task = ask(session, "/held", "text")
                (call,) = await holder.held(1)
                call.respond(echo_of(call.request))
            assert server.statistics().responded == 1
            assert await task == "text"

    async def test_or_ends_it_after_the_deadline(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 10)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            call.respond(echo_of(call.request))
            await server.aclose(0)
            assert server.statistics().dropped == 1
            assert server.statistics().unanswered == 0
            with pytest.raises(ServerGone):
                await task

    async def test_a_client_that_is_closed(
        self, fake_graph: FakeGraph, server_log: pytest.LogCaptureFixture
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            async with fake_graph.session() as other:
                task = ask(other, "/held", "text")
                (call,) = await holder.held(1)
            with pytest.raises(SessionClosed):
                await task
            call.respond(Response())
            assert server.statistics().undeliverable == 1
            assert server.statistics().responded == server.statistics().unanswered == 0

    async def test_timestamps_that_the_middleware_does_not_give(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            session.serve(ECHO, "/held", holder)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            assert call.info.source_timestamp is None
            assert call.info.received_timestamp is None
            call.respond(echo_of(call.request))
            assert await task == "text"


def test_a_request_that_cannot_be_read_hides_none(server_log: pytest.LogCaptureFixture) -> None:
    header = object()
    queue: list[Any] = [("first", header), RCLError("unreadable"), (None, None), ("last", header)]

    def take(request_type: type) -> Any:
        found = queue.pop(0) if queue else (None, None)
        if isinstance(found, Exception):
            raise found
        return found

    assert take_requests(take, str, 5) == [("first", header), ("last", header)]
    assert "unreadable" in server_log.text


def fail_sends(server: ServiceServer, times: int) -> None:
    """Have the next so many responses find their client not there yet."""
    port = server._port
    send = port.send
    left = times

    def failing(header: Any, response: Any) -> None:
        nonlocal left
        left -= 1
        if left >= 0:
            raise Unmatched("not yet")
        send(header, response)

    port.send = failing  # type: ignore[method-assign]


async def test_a_callback_in_a_multithreaded_executor_of_ones_own(bridge: Bridge) -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("lender")
    executor = MultiThreadedExecutor(2)
    stopping = threading.Event()

    def spin() -> None:
        while not stopping.is_set():
            executor.spin_once()

    try:
        async with Session(node, executor=executor, bridge=bridge) as session:
            spinner = threading.Thread(target=spin)
            spinner.start()
            order: list[str] = []

            async def handler(call: ServiceCall) -> Any:
                order.append(call.request.load_namespace)
                return echo_of(call.request)

            session.serve(ECHO, "/served", handler)
            texts = [f"{n:03}" for n in range(100)]
            answers = await asyncio.gather(*(ask(session, "/served", text) for text in texts))
            assert answers == order == texts
        stopping.set()
        executor.create_task(lambda: None)
        await asyncio.to_thread(spinner.join)
        executor.shutdown()
    finally:
        rclpy.shutdown()
        node.destroy_node()


class TestIntrospection:
    @pytest.mark.parametrize("state", ["metadata", "contents"])
    async def test_four_events_for_a_call(self, bridge: Bridge, state: Any) -> None:
        events: list[Any] = []
        async with Session("seen", bridge=bridge, introspection=state) as session:
            session.serve(SetBool, "/seen", lambda request, response: response)
            async with Session("watcher", bridge=bridge) as watcher:
                watcher.node.create_subscription(
                    SetBool.Event, "/seen/_service_event", events.append, 100
                )
                await session.wait_for_service(SetBool, "/seen", timeout=LIMIT)
                await until(
                    lambda: (
                        len(watcher.node.get_publishers_info_by_topic("/seen/_service_event")) == 2
                    )
                )
                await until(lambda: session.node.count_subscribers("/seen/_service_event") == 1)
                while len(events) < 4:
                    events.clear()
                    await session.call(SetBool, "/seen", {"data": True})
                    await asyncio.sleep(2 * TICK)
        assert sorted(event.info.event_type for event in events) == [0, 1, 2, 3]
        filled = 2 if state == "contents" else 0
        assert sum(len(event.request) for event in events) == filled
        assert sum(len(event.response) for event in events) == filled

    async def test_off_by_default(self, session: Session) -> None:
        session.serve(Trigger, "/unseen", lambda call: call.response)
        await session.call(Trigger, "/unseen")
        assert session.node.count_publishers("/unseen/_service_event") == 0

    def test_anything_else(self) -> None:
        with pytest.raises(ValueError, match="introspection"):
            Session("seen", introspection="all")  # type: ignore[arg-type]


async def test_serving_on_a_session_that_is_not_open() -> None:
    session = Session("unopened")
    with pytest.raises(UsageError):
        session.serve(ECHO, "/served", echo_call)
    async with session:
        pass
    with pytest.raises(SessionClosed):
        session.serve(ECHO, "/served", echo_call)


async def test_calls_answer_the_right_requests(session: Session) -> None:
    session.serve(ECHO, "/served", echo_call)
    response = await session.call(ECHO, "/served", {"load_namespace": "mapped"})
    assert answer_to(response) == "mapped"
