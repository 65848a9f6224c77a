"""Handlers: their kinds, and handlers and hooks that raise."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

import pytest
from std_srvs.srv import SetBool

from rosasync import (
    RosasyncError,
    Session,
    UsageError,
)
from tests.support.clients import ClientProcess
from tests.support.echo import ECHO, request_of
from tests.support.serving import (
    FORMS,
    AnyCall,
    Response,
    ask,
    discard,
    echo_call,
    echo_of,
    serving,
    settled,
)
from tests.support.times import until

if TYPE_CHECKING:
    from tests.support.fake_graph import FakeGraph


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
            async def __call__(self, call: AnyCall) -> Any:
                return echo_of(call.request)

            def method(self, request: Any, response: Any) -> Any:
                return echo_of(request)

        def tagged(tag: str, call: AnyCall, mark: str = "!") -> Any:
            return Response(message=tag + call.request.load_namespace + mark)

        async def coroutine(call: AnyCall) -> Any:
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
        ids=["int", "str", "class", "none", "three", "keyword", "variadic"],
    )
    async def test_bad_handlers(self, session: Session, handler: Any) -> None:
        before = len(list(session.node.services))
        with pytest.raises(TypeError, match="handler"):
            session.serve(ECHO, "/bad", handler)
        assert session.statistics().servers == ()
        assert len(list(session.node.services)) == before

    async def test_generators_are_no_handlers(self, session: Session) -> None:
        def generator(call: AnyCall) -> Iterator[Any]:
            yield call.response

        async def async_generator(call: AnyCall) -> AsyncIterator[Any]:
            yield call.response

        for handler in (generator, async_generator):
            with pytest.raises(TypeError, match="yield"):
                session.serve(ECHO, "/bad", handler)

    async def test_a_handler_that_calls_another_service_of_the_session(
        self, session: Session
    ) -> None:
        async def relay(call: AnyCall) -> Any:
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


class TestErrors:
    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    async def test_a_handler_that_raises(
        self, session: Session, caplog: pytest.LogCaptureFixture, asynchronous: bool
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
        await discard(task)
        statistics = server.statistics()
        assert (statistics.taken, statistics.responded, statistics.unanswered) == (2, 1, 0)
        (record,) = caplog.records
        assert "/served" in record.message
        assert record.exc_info is not None
        assert "not today" in str(record.exc_info[1])

    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    async def test_on_error_answers(
        self, session: Session, caplog: pytest.LogCaptureFixture, asynchronous: bool
    ) -> None:
        def handler(call: AnyCall) -> Any:
            raise ValueError("not today")

        def on_error(call: AnyCall, error: Exception) -> Any:
            return Response(message=f"{call.request.load_namespace}: {error}")

        async def async_on_error(call: AnyCall, error: Exception) -> Any:
            await asyncio.sleep(0)
            return on_error(call, error)

        hook = async_on_error if asynchronous else on_error
        server = session.serve(ECHO, "/served", handler, on_error=hook)
        caplog.set_level("DEBUG", "rosasync")
        assert await ask(session, "/served", "text") == "text: not today"
        statistics = server.statistics()
        assert (statistics.failed, statistics.responded, statistics.unanswered) == (1, 1, 0)
        (record,) = (record for record in caplog.records if record.exc_info)
        assert record.levelname == "DEBUG"
        assert "raised an exception, and on_error has answered" in record.message

    @pytest.mark.parametrize("answer", [None, "no response"])
    async def test_on_error_does_not_answer(
        self, session: Session, caplog: pytest.LogCaptureFixture, answer: Any
    ) -> None:
        calls: list[AnyCall] = []

        def handler(call: AnyCall) -> Any:
            calls.append(call)
            raise ValueError("not today")

        server = session.serve(ECHO, "/served", handler, on_error=lambda call, error: answer)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().failed == 1)
        assert server.statistics().unanswered == 0
        with pytest.raises(UsageError, match="its handler failed"):
            calls[0].respond(Response())
        await discard(task)

    async def test_an_on_error_that_raises(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        async def on_error(call: AnyCall, error: Exception) -> Any:
            raise KeyError("worse")

        server = session.serve(ECHO, "/served", lambda call: 1 / 0, on_error=on_error)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: "worse" in caplog.text)
        assert server.statistics().unanswered == 0
        await discard(task)

    async def test_on_error_that_is_cancelled_hides_no_error(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        async def on_error(call: AnyCall, error: Exception) -> Any:
            raise asyncio.CancelledError

        server = session.serve(ECHO, "/served", lambda call: 1 / 0, on_error=on_error)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: "ZeroDivisionError" in caplog.text)
        assert (server.statistics().failed, server.statistics().unanswered) == (1, 0)
        await discard(task)

    @pytest.mark.parametrize("wrong", ["text", SetBool.Response(), True])
    async def test_a_handler_that_returns_the_wrong_type(
        self, session: Session, caplog: pytest.LogCaptureFixture, wrong: Any
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
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        server = session.serve(
            ECHO,
            "/served",
            lambda request, response: None,
            on_error=lambda call, error: Response(message=str(error)),
        )
        answer = await ask(session, "/served", "text")
        assert answer.startswith("the handler returned None")
        assert "`return response`" in answer
        assert server.statistics().failed == 1
        assert server.statistics().deferred == 0

    async def test_a_handler_that_responds_and_returns_a_response(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        errors: list[Exception] = []

        def handler(call: AnyCall) -> Any:
            call.respond(Response(message="first"))
            return Response(message="second")

        server = session.serve(
            ECHO, "/served", handler, on_error=lambda call, error: errors.append(error)
        )
        assert await ask(session, "/served", "text") == "first"
        assert (server.statistics().responded, server.statistics().failed) == (1, 1)
        assert "answered" in caplog.text
        assert errors == [], "there is nothing left to answer"

    async def test_a_handler_that_cancels_itself(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        async def handler(call: AnyCall) -> Any:
            raise asyncio.CancelledError

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().dropped == 1)
        assert [record.message for record in caplog.records] == [
            f"/served: the handler of {_repr_of(1)} was cancelled, so its client gets no response"
        ]
        await discard(task)

    @pytest.mark.parametrize("hook", [False, True], ids=["handler", "on_error"])
    async def test_a_task_that_is_cancelled_before_it_begins(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture, hook: bool
    ) -> None:
        """Its place in ``concurrency`` comes back, although nothing of it has run."""
        ran: list[str] = []

        async def answer(call: AnyCall, *error: Exception) -> Any:
            ran.append(call.request.load_namespace)
            return echo_of(call.request)

        async with fake_graph.session() as session:
            if hook:
                server = session.serve(
                    ECHO, "/served", lambda call: 1 / 0, concurrency=1, on_error=answer
                )
            else:
                server = session.serve(ECHO, "/served", answer, concurrency=1)
            on_request = server._on_request

            def deliver(request: Any, header: Any) -> None:
                before = asyncio.all_tasks()
                on_request(request, header)
                if request.load_namespace == "victim":
                    (task,) = asyncio.all_tasks() - before
                    task.cancel()

            server._port._deliver = deliver  # type: ignore[attr-defined]
            victim = ask(session, "/served", "victim", timeout=None)
            await until(lambda: server.statistics().dropped == 1)
            assert server.statistics().running == 0
            assert [await ask(session, "/served", text) for text in "ab"] == ["a", "b"]
            assert ran == ["a", "b"]
            assert "/served: the handler of" in caplog.text
            assert "was cancelled, so its client gets no response" in caplog.text
            if hook:
                assert "ZeroDivisionError" in caplog.text
            await discard(victim)


class TestAnswers:
    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    async def test_a_mapping(self, session: Session, asynchronous: bool) -> None:
        def handler(call: AnyCall) -> Any:
            return {"message": call.request.load_namespace}

        async def async_handler(request: Any, response: Any) -> Any:
            return {"message": request.load_namespace}

        server = session.serve(ECHO, "/served", async_handler if asynchronous else handler)
        assert await ask(session, "/served", "text") == "text"
        assert server.statistics().responded == 1

    async def test_respond_takes_a_mapping(self, session: Session) -> None:
        session.serve(ECHO, "/served", lambda call: call.respond({"message": "mapped"}))
        assert await ask(session, "/served", "text") == "mapped"

    @pytest.mark.parametrize(
        ("answer", "error"),
        [
            ({"massage": "x"}, "massage"),
            ({"message": 3}, "message"),
            ({"success": "yes"}, "success"),
            (Response(message="\ud800"), ""),
        ],
    )
    async def test_what_cannot_be_sent_does_not_count_as_answered(
        self, session: Session, caplog: pytest.LogCaptureFixture, answer: Any, error: str
    ) -> None:
        calls: list[AnyCall] = []
        errors: list[Exception] = []

        def handler(call: AnyCall) -> Any:
            calls.append(call)
            return answer

        def on_error(call: AnyCall, error: Exception) -> Any:
            assert not call.responded
            errors.append(error)
            return {"message": "instead"} if call.request.load_namespace == "again" else None

        server = session.serve(ECHO, "/served", handler, on_error=on_error)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().failed == 1)
        assert not calls[0].responded
        statistics = server.statistics()
        assert (statistics.responded, statistics.unanswered) == (0, 0)
        assert error in str(errors[0])
        assert error in caplog.text
        assert await ask(session, "/served", "again") == "instead"
        assert server.statistics().responded == 1
        await discard(task)

    async def test_a_response_that_the_middleware_refuses(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        async with fake_graph.session() as session:
            server = session.serve(
                ECHO,
                "/served",
                echo_call,
                on_error=lambda call, error: {"message": str(error)},
            )
            send = server._port.send

            def refuse(header: Any, response: Any) -> None:
                if response.message == "text":
                    raise RosasyncError("too large")
                send(header, response)

            server._port.send = refuse  # type: ignore[method-assign]
            assert await ask(session, "/served", "text") == "too large"
            statistics = server.statistics()
            assert (statistics.failed, statistics.responded) == (1, 1)
            assert statistics.undeliverable == 0


def _repr_of(number: int) -> str:
    return f"<ServiceCall /served #{number} given up: its handler was cancelled>"
