"""The trace hook: one start, the phases and one end of each call, on both sides."""

from __future__ import annotations

import asyncio
import contextvars
import gc
import random
import threading
import warnings
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import (
    AsyncServiceProxy,
    CallEnd,
    HandlerFailed,
    Limits,
    PoolFull,
    ProxyState,
    ResponseTimeout,
    Retry,
    RosasyncError,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    Trace,
    TracedCall,
)
from rosasync.testing import Graph
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.serving import (
    FORMS,
    AnyCall,
    Gate,
    Holder,
    Response,
    UnmatchedClients,
    ask,
    discard,
    echo_call,
    echo_of,
    serving,
)
from tests.support.times import LIMIT, TICK, until
from tests.support.traced import Recorder

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess


@pytest.fixture
def trace() -> Recorder:
    """A hook that keeps what it is told."""
    return Recorder()


@pytest.fixture
async def traced(bridge: Bridge, trace: Recorder) -> AsyncIterator[Session]:
    """An open session with the hook, on each bridge."""
    options: dict[str, Any] = {"bridge": bridge, "timeout": 2 * LIMIT, "trace": trace}
    async with Session("traced", **options) as session:
        yield session


class TestCalls:
    async def test_an_answer(self, traced: Session, trace: Recorder, server: ServerProcess) -> None:
        await server.serve("/echo")
        await traced.wait_for_service(ECHO, "/echo")
        assert answer_to(await traced.call(ECHO, "/echo", request_of("x"))) == "x"
        assert answer_to(await traced.client(ECHO, "/echo").start(request_of("y"))) == "y"
        assert trace.of("client") == ["sent > answered"] * 2
        first, second = trace.calls
        assert (first.side, first.srv_name, first.srv_type) == ("client", "/echo", ECHO)
        assert first.number < second.number
        assert first.time_ns < second.time_ns
        assert trace.ends[first.number].error is None

    async def test_waiting_for_a_server(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        tasks = [ask(traced, "/echo", str(number)) for number in range(3)]
        await until(lambda: trace.of("client") == ["waiting > ..."] * 3)
        await server.serve("/echo")
        assert await asyncio.gather(*tasks) == ["0", "1", "2"]
        assert trace.of("client") == ["waiting > queued > sent > answered"] * 3

    async def test_waiting_for_a_place(
        self, bridge: Bridge, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/held", delay="hold")
        limits = Limits(in_flight=1)
        async with Session("traced", bridge=bridge, limits=limits, trace=trace) as session:
            await session.wait_for_service(ECHO, "/held")
            tasks = [ask(session, "/held", str(number), timeout=None) for number in range(2)]
            await server.received("/held", 1)
            assert trace.of("client") == ["sent > ...", "queued > ..."]
            await server.change("/held", None)
            await server.release("/held")
            assert await asyncio.gather(*tasks) == ["0", "1"]
            assert trace.of("client") == ["sent > answered", "queued > sent > answered"]

    async def test_no_answer_and_retries(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        await traced.wait_for_service(ECHO, "/silent")
        with pytest.raises(ResponseTimeout) as caught:
            await traced.call(
                ECHO, "/silent", timeout=40 * TICK, retry=Retry(after=TICK, backoff=1.0)
            )
        assert trace.of("client") == ["sent > sent again > sent again > timed out"]
        assert trace.error("client") is caught.value

    @pytest.mark.parametrize("wait", [True, False])
    async def test_no_server(self, traced: Session, trace: Recorder, wait: bool) -> None:
        with pytest.raises(ServiceUnavailable) as caught:
            await traced.call(ECHO, "/none", timeout=TICK, wait=wait)
        assert trace.of("client") == ["waiting > timed out"]
        assert trace.error("client") is caught.value

    async def test_cancellations(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        await traced.wait_for_service(ECHO, "/silent")
        tasks = [ask(traced, "/silent", "x"), ask(traced, "/none", "x")]
        await until(lambda: trace.of("client") == ["sent > ...", "waiting > ..."])
        await discard(*tasks)
        assert trace.of("client") == ["sent > cancelled", "waiting > cancelled"]
        # What is said of a call that has ended is ignored.
        await server.serve("/none")
        assert await ask(traced, "/none", "later") == "later"

    async def test_a_lease(self, traced: Session, trace: Recorder, server: ServerProcess) -> None:
        await server.serve("/echo")
        async with traced.pool.lease(ECHO, "/echo", timeout=LIMIT) as client:
            await client.call(request_of("x"))
            await server.stop("/echo")
            await until(lambda: not traced.service_is_ready(ECHO, "/echo"))
            task = asyncio.create_task(client.call(request_of("y")))
            await until(lambda: len(trace.calls) == 2)
            await server.serve("/echo")
            await task
        assert trace.of("client") == ["sent > answered", "waiting > queued > sent > answered"]

    async def test_the_end_of_the_session(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        tasks = [ask(traced, "/silent", "x"), ask(traced, "/none", "x")]
        await server.received("/silent", 1)
        await traced.aclose()
        for task in tasks:
            with pytest.raises(SessionClosed):
                await task
        assert [end.outcome for end in trace.ends.values()] == ["failed"] * 2
        assert all(isinstance(end.error, SessionClosed) for end in trace.ends.values())

    async def test_a_server_that_vanishes(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        task = ask(traced, "/silent", "x")
        await server.received("/silent", 1)
        await server.stop("/silent")
        with pytest.raises(ServerGone):
            await task
        assert isinstance(trace.error("client"), ServerGone)

    async def test_a_full_queue(self, fake_graph: FakeGraph, trace: Recorder) -> None:
        limits = Limits(waiting=0, in_flight=1)
        fake_graph.serve(ECHO, "/echo", echo_of)
        async with fake_graph.session(limits=limits, trace=trace) as session:
            await ask(session, "/echo", "x")
            with fake_graph.drop_requests():
                task = ask(session, "/echo", "lost")
                await asyncio.sleep(0)
                with pytest.raises(PoolFull):
                    await ask(session, "/echo", "x")
            await discard(task)
            assert trace.of("client")[1:] == ["sent > cancelled", "queued > failed"]

    async def test_wrong_arguments_are_no_call(
        self, fake_graph: FakeGraph, trace: Recorder
    ) -> None:
        async with fake_graph.session(trace=trace) as session:
            with pytest.raises(TypeError):
                await session.call(ECHO, "/echo", timeout="1")  # type: ignore[call-overload]
        assert not trace.calls

    async def test_other_threads_and_proxies(
        self, traced: Session, trace: Recorder, server: ServerProcess
    ) -> None:
        await server.serve("/echo")
        await traced.wait_for_service(ECHO, "/echo")
        await asyncio.to_thread(traced.from_thread.call, ECHO, "/echo", request_of("x"))
        proxy = AsyncServiceProxy(traced, ECHO, "/echo")
        proxy.call_service(request_of("y"))
        await until(lambda: proxy.get_state() is ProxyState.RESPONSE_READY)
        proxy.shutdown()
        assert trace.of("client") == ["sent > answered"] * 2

    async def test_other_threads_keep_their_context(
        self, fake_graph: FakeGraph, trace: Recorder
    ) -> None:
        variable = contextvars.ContextVar("variable", default="")
        seen: list[str] = []

        class Hook(Recorder):
            def start(self, call: TracedCall) -> None:
                seen.append(variable.get())

            def phase(self, *event: Any) -> None: ...
            def end(self, *event: Any) -> None: ...

        def call_from_thread() -> None:
            variable.set("the thread's")
            session.from_thread.call(ECHO, "/echo")

        fake_graph.serve(ECHO, "/echo", echo_of)
        async with fake_graph.session(trace=Hook()) as session:
            variable.set("the task's")
            await session.call(ECHO, "/echo")
            await asyncio.to_thread(call_from_thread)
        assert seen == ["the task's", "the thread's"]


class TestRequests:
    @pytest.mark.parametrize("form", FORMS)
    async def test_every_form_of_a_server(
        self, traced: Session, trace: Recorder, form: str
    ) -> None:
        async with serving(traced, "/served", form):
            assert await ask(traced, "/served", "x") == "x"
            await trace.all_ended(2)
        (phases,) = trace.of("server")
        expected = {
            "async, respond after the return": "handling > deferred > answered",
            "iteration": "queued > handling > answered",
        }
        assert phases == expected.get(form, "handling > answered")

    async def test_waiting_for_a_handler(self, traced: Session, trace: Recorder) -> None:
        gate = Gate()

        traced.serve(ECHO, "/served", gate, concurrency=1)
        tasks = [ask(traced, "/served", str(number)) for number in range(2)]
        await until(lambda: trace.of("server") == ["handling > ...", "queued > ..."])
        gate.set()
        await asyncio.gather(*tasks)
        await trace.all_ended(4)
        assert trace.of("server") == ["handling > answered", "queued > handling > answered"]

    async def test_an_answer_from_another_thread(self, traced: Session, trace: Recorder) -> None:
        holder = Holder()
        traced.serve(ECHO, "/served", holder)
        task = ask(traced, "/served", "x")
        (call,) = await holder.held(1)
        await asyncio.to_thread(call.respond, echo_of(call.request))
        assert await task == "x"
        await trace.all_ended(2)
        assert trace.of("server") == ["handling > deferred > answered"]

    async def test_an_answer_from_another_thread_just_before_the_end(
        self, fake_graph: FakeGraph, trace: Recorder
    ) -> None:
        holder = Holder()
        async with fake_graph.session(trace=trace) as session:
            server = session.serve(ECHO, "/served", holder)
            task = ask(session, "/served", "x")
            (call,) = await holder.held(1)
            thread = threading.Thread(target=call.respond, args=(echo_of(call.request),))
            thread.start()
            thread.join()
            # The loop has not run since, so it has not heard of the answer yet.
            server.end(lambda: SessionClosed("closed"))
            await task
        assert trace.of("server") == ["handling > deferred > answered"]

    @pytest.mark.parametrize("asynchronous", [True, False])
    async def test_a_handler_that_raises(
        self, traced: Session, trace: Recorder, asynchronous: bool
    ) -> None:
        error = ZeroDivisionError()

        async def handler(call: AnyCall) -> Any:
            raise error

        def plain_handler(call: AnyCall) -> Any:
            raise error

        traced.serve(ECHO, "/served", handler if asynchronous else plain_handler)
        task = ask(traced, "/served", "x")
        await until(lambda: trace.of("server") == ["handling > failed > failed"])
        assert trace.error("server") is error
        await discard(task)

    async def test_a_handler_that_raises_and_a_hook_that_answers(
        self, traced: Session, trace: Recorder
    ) -> None:
        error = ZeroDivisionError()

        def handler(call: AnyCall) -> Any:
            raise error

        traced.serve(
            ECHO, "/served", handler, on_error=lambda call, error: Response(message="sorry")
        )
        assert await ask(traced, "/served", "x") == "sorry"
        await trace.all_ended(2)
        assert trace.of("server") == ["handling > failed > answered"]
        assert trace.error("server") is error

    async def test_a_handler_that_is_cancelled(self, traced: Session, trace: Recorder) -> None:
        async def handler(call: AnyCall) -> Any:
            await asyncio.Event().wait()

        server = traced.serve(ECHO, "/served", handler)
        task = ask(traced, "/served", "x")
        await until(lambda: trace.of("server") == ["handling > ..."])
        await server.aclose(0)
        assert trace.of("server") == ["handling > failed > cancelled"]
        assert isinstance(trace.error("server"), asyncio.CancelledError)
        await discard(task)

    async def test_more_requests_than_the_backlog(self, traced: Session, trace: Recorder) -> None:
        traced.serve(ECHO, "/served", backlog=0)
        task = ask(traced, "/served", "x")
        await until(lambda: trace.of("server") == ["dropped"])
        await discard(task)

    async def test_a_call_that_nobody_keeps(self, traced: Session, trace: Recorder) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)
            traced.serve(ECHO, "/served", lambda call: None)
            task = ask(traced, "/served", "x")
            await until(lambda: trace.of("server"))
            gc.collect()
            await until(lambda: trace.of("server") == ["handling > deferred > dropped"])
        await discard(task)

    async def test_the_end_of_the_server(self, traced: Session, trace: Recorder) -> None:
        holder = Holder()
        server = traced.serve(ECHO, "/served", holder)
        waiting = traced.serve(ECHO, "/waiting")
        tasks = [ask(traced, "/served", "x"), ask(traced, "/waiting", "x")]
        (call,) = await holder.held(1)
        await until(lambda: waiting.statistics().waiting)
        await server.aclose()
        await waiting.aclose()
        assert sorted(trace.of("server")) == ["handling > deferred > dropped", "queued > dropped"]
        with pytest.raises(SessionClosed):
            call.respond(Response())
        await discard(*tasks)

    async def test_a_client_that_is_gone(
        self, fake_graph: FakeGraph, trace: Recorder, caplog: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        async with fake_graph.session(trace=trace) as session:
            session.serve(ECHO, "/served", holder)
            async with fake_graph.session() as other:
                task = ask(other, "/served", "x")
                (call,) = await holder.held(1)
            call.respond(Response())
            assert trace.of("server") == ["handling > deferred > undeliverable"]
            await discard(task)

    async def test_an_answer_that_is_sent_later(
        self, fake_graph: FakeGraph, trace: Recorder
    ) -> None:
        holder = Holder()
        async with fake_graph.session(trace=trace) as session:
            clients = UnmatchedClients(session.serve(ECHO, "/served", holder))
            task = ask(session, "/served", "x")
            (call,) = await holder.held(1)
            call.respond(echo_of(call.request))
            assert trace.of("server") == ["handling > deferred > ..."]
            clients.unmatched = False
            assert await task == "x"
            assert trace.of("server") == ["handling > deferred > answered"]

    @pytest.mark.parametrize("form", [form for form in FORMS if form != "iteration"])
    async def test_the_handler_runs_in_the_context_of_the_hook(
        self, traced: Session, trace: Recorder, monkeypatch: pytest.MonkeyPatch, form: str
    ) -> None:
        variable = contextvars.ContextVar("variable", default=0)

        def start(call: TracedCall) -> contextvars.Context:
            Recorder.start(trace, call)
            context = contextvars.copy_context()
            context.run(variable.set, call.number)
            return context

        def seen(*args: Any) -> Any:
            numbers.append(variable.get())
            handler: Any = FORMS[form]
            return handler(*args)

        async def seen_later(*args: Any) -> Any:
            await asyncio.sleep(0)
            return await seen(*args)

        numbers: list[int] = []
        handler: Any = seen_later if form.startswith("async") else seen
        if "request and response" in form:
            pair: Any = handler
            handler = lambda request, response: pair(request, response)  # noqa: E731
        else:
            one: Any = handler
            handler = lambda call: one(call)  # noqa: E731
        monkeypatch.setattr(trace, "start", start)
        traced.serve(ECHO, "/served", handler)
        assert await ask(traced, "/served", "x") == "x"
        assert await ask(traced, "/served", "y") == "y"
        assert numbers == [call.number for call in trace.calls if call.side == "server"]
        assert variable.get() == 0


class Broken:
    """A hook of which one method raises."""

    def __init__(self, method: str, error: BaseException) -> None:
        self._method = method
        self._error = error

    def start(self, call: TracedCall) -> None:
        self._run("start")

    def phase(self, *event: Any) -> None:
        self._run("phase")

    def end(self, *event: Any) -> None:
        self._run("end")

    def _run(self, method: str) -> None:
        if method == self._method:
            raise self._error


@pytest.mark.parametrize("method", ["start", "phase", "end"])
@pytest.mark.parametrize("error", [ZeroDivisionError("hook"), asyncio.CancelledError("hook")])
async def test_a_hook_that_raises_disturbs_no_call(
    bridge: Bridge, method: str, error: BaseException, caplog: pytest.LogCaptureFixture
) -> None:
    async with Session("traced", bridge=bridge, trace=Broken(method, error)) as session:
        server = session.serve(ECHO, "/served", echo_call)
        assert await ask(session, "/served", "x", timeout=LIMIT) == "x"
        await until(lambda: server.statistics().responded)
        assert session.pool.statistics().completed == 1
    assert "the trace hook" in caplog.text
    assert type(error).__name__ in caplog.text


@pytest.mark.parametrize("result", [contextvars.copy_context(), True, object()])
async def test_whatever_a_hook_returns_the_handler_runs(
    session: Session, trace: Recorder, result: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def handler(call: AnyCall) -> Any:
        await asyncio.sleep(TICK)
        return echo_of(call.request)

    monkeypatch.setattr(trace, "start", lambda call: Recorder.start(trace, call) or result)
    async with Session("traced", bridge="executor", trace=trace) as traced:
        traced.serve(ECHO, "/served", handler)
        tasks = [ask(session, "/served", str(number), timeout=LIMIT) for number in range(3)]
        assert await asyncio.gather(*tasks) == ["0", "1", "2"]
        await trace.all_ended(3)
    assert trace.of("server") == ["handling > answered"] * 3


@pytest.mark.parametrize("wrong", [object(), Recorder, "trace", 1, CallEnd])
def test_what_is_no_hook(wrong: Any) -> None:
    with pytest.raises(TypeError, match=r"rosasync\.Trace"):
        Session("traced", trace=wrong)


def test_a_hook_fits_the_protocol(trace: Recorder) -> None:
    hook: Trace = trace
    assert isinstance(hook, Trace)


@pytest.mark.parametrize("kind", ["memory", "real"])
async def test_the_testing_graph_passes_it_along(kind: Any) -> None:
    trace = Recorder()
    async with Graph(kind) as graph:
        graph.serve(ECHO, "/served", echo_call)
        async with graph.session(trace=trace) as session:
            assert await ask(session, "/served", "x", timeout=LIMIT) == "x"
    (phases,) = trace.of("client")
    assert phases.endswith("sent > answered")


@pytest.mark.parametrize("seed", range(5))
async def test_every_start_has_one_end(fake_graph: FakeGraph, seed: int) -> None:
    dice = random.Random(seed)
    trace = Recorder()

    async def handler(call: AnyCall) -> Any:
        for _ in range(dice.randrange(3)):
            await asyncio.sleep(0)
        match dice.randrange(4):
            case 0:
                raise ValueError("no")
            case 1:
                asyncio.get_running_loop().call_soon(call.respond, echo_of(call.request))
                return None
            case 2:
                await asyncio.to_thread(call.respond, echo_of(call.request))
                return None
        return echo_of(call.request)

    async def caller(number: int) -> None:
        retry = Retry(after=TICK / 10) if dice.randrange(2) else None
        task = ask(session, "/served", str(number), timeout=dice.choice([TICK, 0.0]), retry=retry)
        for _ in range(dice.randrange(20)):
            await asyncio.sleep(0)
        if dice.randrange(3) == 0:
            task.cancel()
        with suppress(RosasyncError, asyncio.CancelledError):
            await task

    async with fake_graph.session(trace=trace, limits=Limits(waiting=20)) as session:
        server = session.serve(ECHO, "/served", handler, concurrency=2, backlog=2)
        async with asyncio.TaskGroup() as group:
            for number in range(100):
                group.create_task(caller(number))
                await asyncio.sleep(0)
        await server.aclose()
    # A task that is cancelled before it begins makes no call.
    assert len(trace.of("client")) > 80
    assert len(trace.of("server")) > 10
    assert not [calls for calls in (*trace.of("client"), *trace.of("server")) if "..." in calls]
    statistics = session.pool.statistics()
    outcomes = [calls.split(" > ")[-1] for calls in trace.of("client")]
    assert outcomes.count("answered") == statistics.completed
    assert outcomes.count("timed out") == statistics.timed_out
    assert outcomes.count("cancelled") == statistics.cancelled
    assert outcomes.count("failed") == statistics.failed


async def test_what_a_server_reports_is_the_end_of_a_call(
    fake_graph: FakeGraph, trace: Recorder
) -> None:
    def fail(call: AnyCall) -> Any:
        raise LookupError("no")

    async with fake_graph.session() as server, fake_graph.session(trace=trace) as client:
        server.serve(ECHO, "/served", fail, status=True)
        # The first call may fail before both sides have found each other's topics.
        with pytest.raises(HandlerFailed):
            await ask(client, "/served", "x", timeout=LIMIT)
    assert trace.of("client")[-1].endswith("sent > failed")
    error = trace.error("client")
    assert isinstance(error, HandlerFailed)
    assert error.error_type == "LookupError"
