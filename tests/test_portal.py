"""Calls from other threads: responses, cancellation, deadlines and errors."""

from __future__ import annotations

import asyncio
import concurrent.futures
import math
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.context import Context
from rclpy.signals import SignalHandlerOptions

import rosasync
from rosasync import (
    ContextShutdown,
    InvalidServiceName,
    ResponseTimeout,
    Retry,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from tests.support.checks import assert_clean, count_threads
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess

NAME = "/echo"


@pytest.fixture
async def held(server: ServerProcess) -> ServerProcess:
    """A server that answers when the test releases the responses."""
    await server.serve(NAME, delay="hold")
    return server


def has_completed(session: Session, calls: int) -> bool:
    return session.pool.statistics().completed >= calls


async def in_thread(function: Callable[..., Any], *args: Any, **options: Any) -> Any:
    return await asyncio.to_thread(function, *args, **options)


async def in_callback(session: Session, function: Callable[[], Any]) -> Any:
    """Call a function on the executor's thread, as a callback of the node."""
    outcome: Future[Any] = Future()

    def callback() -> None:
        try:
            outcome.set_result(function())
        except BaseException as error:
            outcome.set_exception(error)

    session.node.executor.create_task(callback)
    return await asyncio.wrap_future(outcome)


class TestCall:
    """``from_thread.call``."""

    async def test_it_returns_the_response(self, session: Session, echo: str) -> None:
        response = await in_thread(session.from_thread.call, ECHO, echo, request_of("a"))
        assert answer_to(response) == "a"
        await assert_clean(session)

    async def test_it_takes_a_mapping_and_a_retry(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve(NAME, skip=1)
        response = await in_thread(
            session.from_thread.call,
            ECHO,
            NAME,
            {"load_namespace": "a"},
            retry=Retry(after=TICK),
        )
        assert answer_to(response) == "a"

    async def test_the_loop_goes_on_meanwhile(self, session: Session, held: ServerProcess) -> None:
        thread = asyncio.create_task(
            in_thread(session.from_thread.call, ECHO, NAME, request_of("a"))
        )
        await held.received(NAME, 1)
        assert not thread.done()
        await held.release(NAME)
        assert answer_to(await thread) == "a"

    async def test_a_thread_with_a_loop_of_its_own_may_call(
        self, session: Session, echo: str
    ) -> None:
        async def other() -> Any:
            future = session.from_thread.submit(ECHO, echo, request_of("a"))
            return await asyncio.wrap_future(future)

        response = await in_thread(asyncio.run, other())
        assert answer_to(response) == "a"

    async def test_the_deadline_holds(self, session: Session, held: ServerProcess) -> None:
        await session.wait_for_service(ECHO, NAME)
        with pytest.raises(ResponseTimeout, match=NAME):
            await in_thread(session.from_thread.call, ECHO, NAME, timeout=20 * TICK)
        with pytest.raises(ServiceUnavailable, match="/absent"):
            await in_thread(session.from_thread.call, ECHO, "/absent", timeout=20 * TICK)
        with pytest.raises(ServiceUnavailable):
            await in_thread(session.from_thread.call, ECHO, "/absent", wait=False)

    async def test_the_sessions_timeout_holds_where_none_is_given(self) -> None:
        async with FakeGraph().session(timeout=20 * TICK) as session:
            with pytest.raises(ServiceUnavailable):
                await in_thread(session.from_thread.call, ECHO, NAME)

    async def test_the_deadline_holds_where_the_loop_is_stuck(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync._core.portal.MARGIN", TICK)
        graph = FakeGraph()
        graph.serve(ECHO, NAME, lambda _: None)
        async with graph.session() as session:
            with ThreadPoolExecutor() as threads:
                thread = threads.submit(session.from_thread.call, ECHO, NAME, timeout=TICK)
                with pytest.raises(ResponseTimeout, match=r"/echo: .*loop is stuck"):
                    thread.result(LIMIT)
            await until(lambda: not session.core.gateway.pending)
            assert session.pool.statistics().created == 0

    @pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
    async def test_threads_at_once_get_each_its_own_answers(
        self, session: Session, echo: str
    ) -> None:
        call = session.from_thread.call

        def caller(name: int) -> list[str]:
            return [answer_to(call(ECHO, echo, request_of(f"{name} {n}"))) for n in range(20)]

        with ThreadPoolExecutor(32) as threads:
            loop = asyncio.get_running_loop()
            answers = await asyncio.gather(
                *(loop.run_in_executor(threads, caller, name) for name in range(32))
            )
        assert answers == [[f"{name} {n}" for n in range(20)] for name in range(32)]
        await assert_clean(session)


class TestSubmit:
    """``from_thread.submit``."""

    async def test_the_future_brings_the_response(self, session: Session, echo: str) -> None:
        submit = session.from_thread.submit
        futures = await in_thread(
            lambda: [submit(ECHO, echo, request_of(str(n))) for n in range(100)]
        )
        done = await in_thread(lambda: [answer_to(f.result(LIMIT)) for f in futures])
        assert done == [str(n) for n in range(100)]

    async def test_it_works_in_a_callback_of_the_node(
        self, session: Session, held: ServerProcess
    ) -> None:
        submitted = await in_callback(
            session, lambda: session.from_thread.submit(ECHO, NAME, request_of("a"))
        )
        await held.received(NAME, 1)
        # The executor goes on meanwhile.
        assert await in_callback(session, lambda: 5) == 5
        await held.release(NAME)
        assert answer_to(await asyncio.wrap_future(submitted)) == "a"
        response = await in_callback(session, submitted.result)
        assert answer_to(response) == "a"

    async def test_one_wake_up_carries_a_batch(self, session: Session, echo: str) -> None:
        await session.wait_for_service(ECHO, echo)
        loop = asyncio.get_running_loop()
        wake_ups = []
        original = loop.call_soon_threadsafe

        def counted(callback: Callable[..., object], *args: Any, **options: Any) -> Any:
            wake_ups.append(threading.get_ident())
            return original(callback, *args, **options)

        submit = session.from_thread.submit

        def batch() -> tuple[int, list[Future[Any]]]:
            futures = [submit(ECHO, echo, request_of(str(n))) for n in range(50)]
            return threading.get_ident(), futures

        with pytest.MonkeyPatch.context() as patch, ThreadPoolExecutor() as threads:
            patch.setattr(loop, "call_soon_threadsafe", counted)
            # The loop is blocked during this.
            thread, futures = threads.submit(batch).result(LIMIT)
            # None if the executor's thread has just woken the loop.
            assert wake_ups.count(thread) <= 1
        assert len(await asyncio.gather(*map(asyncio.wrap_future, futures))) == 50

    async def test_cancelling_the_future_cancels_the_call(
        self, session: Session, held: ServerProcess
    ) -> None:
        future = await in_thread(session.from_thread.submit, ECHO, NAME, request_of("a"))
        await held.received(NAME, 1)
        assert future.cancel()
        assert future.cancel()
        assert future.cancelled()
        await until(lambda: session.pool.statistics().cancelled == 1)
        assert session.pool.statistics().abandoned == 1
        done, _ = await in_thread(concurrent.futures.wait, [future], LIMIT)
        assert done == {future}
        with pytest.raises(concurrent.futures.CancelledError):
            future.result()
        await held.release(NAME)
        await assert_clean(session)
        assert session.pool.statistics().late == 1

    async def test_cancelled_on_its_way_nothing_is_sent(
        self, session: Session, server: ServerProcess
    ) -> None:
        await server.serve(NAME)

        def submit_and_cancel() -> None:
            session.from_thread.submit(ECHO, NAME, request_of("cancelled")).cancel()

        with ThreadPoolExecutor() as threads:
            # The loop is blocked during this.
            threads.submit(submit_and_cancel).result(LIMIT)
        await session.call(ECHO, NAME, request_of("called"))
        assert await server.received(NAME) == ["called"]

    async def test_an_answered_call_cannot_be_cancelled(self, session: Session, echo: str) -> None:
        future = await in_thread(session.from_thread.submit, ECHO, echo, request_of("a"))
        await asyncio.wrap_future(future)
        assert not future.cancel()
        assert answer_to(future.result()) == "a"

    async def test_result_with_a_timeout_gives_up_waiting_and_not_the_call(
        self, session: Session, held: ServerProcess
    ) -> None:
        future = await in_thread(session.from_thread.submit, ECHO, NAME, request_of("a"))
        for look in (future.result, future.exception):
            with pytest.raises(TimeoutError):
                await in_thread(look, TICK)
        await held.received(NAME, 1)
        await held.release(NAME)
        assert answer_to(await in_thread(future.result)) == "a"
        assert future.exception() is None


class TestMisuse:
    """Mistakes that raise at once, in the calling thread, before anything is sent."""

    @pytest.mark.parametrize(
        ("way", "instead"), [("call", r"await session\.call"), ("submit", r"use session\.start")]
    )
    async def test_on_the_loops_thread(
        self, session: Session, echo: str, way: str, instead: str
    ) -> None:
        with pytest.raises(UsageError, match=instead):
            getattr(session.from_thread, way)(ECHO, echo)

    @pytest.mark.parametrize("way", ["result", "exception"])
    async def test_the_loop_waits_for_a_future(
        self, session: Session, held: ServerProcess, way: str
    ) -> None:
        future = await in_thread(session.from_thread.submit, ECHO, NAME, request_of("a"))
        with pytest.raises(UsageError, match=r"asyncio\.wrap_future"):
            getattr(future, way)()
        await held.received(NAME, 1)
        await held.release(NAME)
        assert answer_to(await asyncio.wrap_future(future)) == "a"
        assert answer_to(future.result()) == "a"

    def test_on_the_loops_thread_while_the_loop_does_not_run(self) -> None:
        with asyncio.Runner() as runner:
            session = runner.run(FakeGraph().session().__aenter__())
            with pytest.raises(UsageError):
                session.from_thread.call(ECHO, NAME)
            runner.run(session.aclose())

    async def test_a_blocking_call_on_the_executors_thread(
        self, session: Session, echo: str
    ) -> None:
        with pytest.raises(UsageError, match=r"executor's thread.*from_thread\.submit"):
            await in_callback(session, lambda: session.from_thread.call(ECHO, echo))

    async def test_the_session_itself_on_the_executors_thread(self, session: Session) -> None:
        """As an ``async def`` callback of rclpy would call it."""
        with pytest.raises(UsageError, match=r"callback of the node, .*from_thread\.submit"):
            await in_callback(session, lambda: session.start(ECHO, NAME))

    @pytest.mark.parametrize("way", ["result", "exception"])
    async def test_the_executors_thread_waits_for_a_future(
        self, session: Session, held: ServerProcess, way: str
    ) -> None:
        def callback() -> None:
            getattr(session.from_thread.submit(ECHO, NAME), way)(LIMIT)

        with pytest.raises(UsageError, match=r"executor's thread.*add_done_callback"):
            await in_callback(session, callback)
        await held.received(NAME, 1)
        await held.release(NAME)

    @pytest.mark.parametrize(
        ("error", "arguments", "options"),
        [
            (TypeError, (5, NAME), {}),
            (TypeError, ([], NAME), {}),
            (ValueError, ("no_pkg/srv/Type", NAME), {}),
            (InvalidServiceName, (ECHO, "no name"), {}),
            (TypeError, (ECHO, 5), {}),
            (TypeError, (ECHO, NAME, "no request"), {}),
            (ValueError, (ECHO, NAME, {"no_field": 1}), {}),
            (ValueError, (ECHO, NAME), {"timeout": float("nan")}),
            (TypeError, (ECHO, NAME), {"timeout": "soon"}),
            (TypeError, (ECHO, NAME), {"qos": 10}),
            (TypeError, (ECHO, NAME), {"retry": 3}),
        ],
    )
    @pytest.mark.parametrize("way", ["call", "submit"])
    async def test_bad_arguments(
        self,
        way: str,
        error: type[Exception],
        arguments: tuple[Any, ...],
        options: dict[str, Any],
    ) -> None:
        async with Session("misused") as session:
            with pytest.raises(error):
                await in_thread(getattr(session.from_thread, way), *arguments, **options)
            assert session.core.gateway.pending == 0
            assert session.pool.statistics().created == 0

    def test_before_the_session_is_open(self) -> None:
        with pytest.raises(UsageError, match="not open"):
            rosasync.Session().from_thread  # noqa: B018


class TestEndings:
    """Each call returns or raises, whatever ends."""

    @pytest.mark.parametrize("way", ["call", "submit"])
    async def test_on_a_closed_session(self, bridge: Bridge, way: str) -> None:
        async with Session(bridge=bridge) as session:
            pass
        with pytest.raises(SessionClosed):
            await in_thread(getattr(session.from_thread, way), ECHO, NAME)

    async def test_calls_that_are_out_when_the_session_closes(
        self, bridge: Bridge, held: ServerProcess
    ) -> None:
        async with Session(bridge=bridge) as session:
            futures = await in_thread(
                lambda: [session.from_thread.submit(ECHO, n, timeout=None) for n in ("/no", NAME)]
            )
            await held.received(NAME, 1)
        for future in futures:
            with pytest.raises(SessionClosed):
                future.result(LIMIT)

    async def test_a_call_still_queued_when_the_session_closes(self, bridge: Bridge) -> None:
        async with Session(bridge=bridge) as session:
            with ThreadPoolExecutor() as threads:
                # The loop is blocked during this, and has no turn before the session closes.
                future = threads.submit(
                    session.from_thread.submit, ECHO, NAME, timeout=None
                ).result(LIMIT)
        with pytest.raises(SessionClosed):
            await in_thread(future.result, LIMIT)

    @pytest.mark.parametrize("rounds", [2, pytest.param(10, marks=pytest.mark.soak)])
    async def test_the_session_closes_under_32_threads(
        self, bridge: Bridge, echo: str, rounds: int
    ) -> None:
        calling = threading.Barrier(32)

        def caller(session: Session) -> tuple[int, Exception]:
            calling.wait()
            for count in range(1_000_000):
                try:
                    response = session.from_thread.call(ECHO, echo, request_of(str(count)))
                except Exception as error:
                    return count, error
                assert answer_to(response) == str(count)
            raise AssertionError("the session never closed")

        with ThreadPoolExecutor(32) as threads:
            for _ in range(rounds):
                async with Session(bridge=bridge, timeout=4 * LIMIT) as session:
                    await session.wait_for_service(ECHO, echo)
                    calls = [threads.submit(caller, session) for _ in range(32)]
                    await until(partial(has_completed, session, 200))
                ends = await asyncio.gather(*map(asyncio.wrap_future, calls))
                assert {type(error) for _, error in ends} == {SessionClosed}
                assert session.statistics().pool.in_flight == 0

    async def test_the_context_goes_down(self, bridge: Bridge, held: ServerProcess) -> None:
        import rclpy

        context = Context()
        rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        async with Session(context=context, bridge=bridge) as session:
            out = await in_thread(session.from_thread.submit, ECHO, NAME, timeout=None)
            await held.received(NAME, 1)
            context.try_shutdown()
            with pytest.raises(ContextShutdown):
                await in_thread(out.result, LIMIT)
            with pytest.raises(ContextShutdown):
                await in_thread(session.from_thread.call, ECHO, NAME)
            with pytest.raises(ContextShutdown):
                await in_thread(session.from_thread.call, ECHO, "/another")

    def test_the_loop_is_closed_and_the_session_is_not(self) -> None:
        """The session cannot notify the thread, so the thread polls whether the loop is closed."""
        loop = asyncio.new_event_loop()
        graph = FakeGraph()
        session = loop.run_until_complete(graph.session().__aenter__())
        started = threading.Event()

        def caller() -> None:
            future = session.from_thread.submit(ECHO, NAME, timeout=math.inf)
            started.set()
            future.result()

        with ThreadPoolExecutor() as threads:
            thread = threads.submit(caller)
            assert started.wait(LIMIT)
            loop.close()
            with pytest.raises(SessionClosed, match="loop was closed"):
                thread.result(LIMIT)
            with pytest.raises(SessionClosed):
                threads.submit(session.from_thread.call, ECHO, NAME).result(LIMIT)
        session.core.closed = True

    def test_the_loops_tasks_are_cancelled_and_the_session_is_not_closed(self) -> None:
        """``asyncio.run`` cancels the remaining tasks at its end."""
        graph = FakeGraph()
        graph.serve(ECHO, NAME, lambda _: None)
        with asyncio.Runner() as runner, ThreadPoolExecutor() as threads, graph.drop_requests():
            session = runner.run(graph.session().__aenter__())
            future = threads.submit(session.from_thread.submit, ECHO, NAME, timeout=None).result(
                LIMIT
            )

            async def sent() -> None:
                await until(lambda: session.pool.statistics().in_flight == 1)
                for task in asyncio.all_tasks() - {asyncio.current_task()}:
                    task.cancel()

            runner.run(sent())
            with pytest.raises(SessionClosed):
                threads.submit(future.result).result(LIMIT)
            runner.run(session.aclose())

    async def test_no_thread_is_started(self, session: Session, held: ServerProcess) -> None:
        await session.wait_for_service(ECHO, NAME)
        with ThreadPoolExecutor(1) as threads:
            threads.submit(int).result()
            before = count_threads()
            futures = threads.submit(
                lambda: [session.from_thread.submit(ECHO, NAME) for _ in range(100)]
            ).result()
            await held.received(NAME, 10)
            assert count_threads() == before
        for future in futures:
            future.cancel()
        await held.release(NAME)
        await assert_clean(session)
