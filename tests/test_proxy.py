"""AsyncServiceProxy: every state with every event, and the defects of the proxy it replaces."""

from __future__ import annotations

import asyncio
import inspect
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any, Literal

import pytest

import rosasync
from rosasync import (
    AsyncServiceProxy,
    InvalidServiceName,
    Limits,
    PoolFull,
    ProxyState,
    ResponseTimeout,
    Retry,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from tests.support.checks import assert_clean
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess

IDLE = ProxyState.IDLE
WAITING = ProxyState.WAITING
AVAILABLE = ProxyState.SERVICE_AVAILABLE
RUNNING = ProxyState.RUNNING
READY = ProxyState.RESPONSE_READY
TIMEOUT = ProxyState.TIMEOUT
ABORTED = ProxyState.ABORTED
ERROR = ProxyState.ERROR

NAME = "/echo"

SOON = 3 * TICK
"""Seconds, for operations that are to time out."""


async def settled(proxy: AsyncServiceProxy) -> ProxyState:
    """Wait until nothing is pending; return the state."""
    await until(lambda: proxy.get_state() not in (WAITING, RUNNING))
    return proxy.get_state()


class Stage:
    """A proxy, its graph, and a server that answers when the test releases its responses."""

    def __init__(self, graph: FakeGraph, session: Session) -> None:
        self.graph = graph
        self.session = session
        self.proxy = AsyncServiceProxy(session, ECHO, NAME)
        self._held = ExitStack()
        self.server: FakeServer | None = None

    def serve(self) -> None:
        """Add a server that holds back its responses."""
        if self.server is None:
            self._held.enter_context(self.graph.hold_requests())
            self.server = self.graph.serve(ECHO, NAME, lambda _: "the answer")

    def vanish(self) -> None:
        if self.server is not None:
            self.server.close()
            self.server = None

    def answer(self) -> None:
        self._held.close()

    async def reach(self, state: ProxyState, timeout: float = LIMIT) -> None:
        """Bring the proxy into this state, with the response to its last call still held back.

        Args:
            state: to reach.
            timeout: seconds for the call or wait; TIMEOUT takes a short one.
        """
        proxy = self.proxy
        if state is WAITING:
            proxy.wait_for_service(timeout)
        if state is AVAILABLE:
            self.serve()
            proxy.wait_for_service(timeout)
        if state in (RUNNING, READY, TIMEOUT, ABORTED, ERROR):
            self.serve()
            await self.session.wait_for_service(ECHO, NAME)
            proxy.call_service(timeout=SOON if state is TIMEOUT else timeout)
            await until(lambda: self.session.pool.statistics().in_flight)
        if state is READY:
            self.answer()
        if state is ABORTED:
            proxy.stop_call()
        if state is ERROR:
            self.vanish()
        if state not in (WAITING, RUNNING):
            await settled(proxy)
        assert proxy.get_state() is state


@asynccontextmanager
async def staged() -> AsyncIterator[Stage]:
    graph = FakeGraph()
    async with graph.session() as session:
        yield Stage(graph, session)


# The state after each method, at once.
ASKED = {
    #          call     wait     stop     read     errors   shutdown
    IDLE: (RUNNING, WAITING, IDLE, IDLE, IDLE, IDLE),
    WAITING: (RUNNING, WAITING, ABORTED, WAITING, WAITING, ABORTED),
    AVAILABLE: (RUNNING, WAITING, AVAILABLE, AVAILABLE, AVAILABLE, AVAILABLE),
    RUNNING: (RUNNING, WAITING, ABORTED, RUNNING, RUNNING, ABORTED),
    READY: (RUNNING, WAITING, ABORTED, IDLE, READY, ABORTED),
    TIMEOUT: (RUNNING, WAITING, TIMEOUT, TIMEOUT, TIMEOUT, TIMEOUT),
    ABORTED: (RUNNING, WAITING, ABORTED, ABORTED, ABORTED, ABORTED),
    ERROR: (RUNNING, WAITING, ERROR, ERROR, ERROR, ERROR),
}
METHODS: tuple[Callable[[AsyncServiceProxy], object], ...] = (
    lambda proxy: proxy.call_service(),
    lambda proxy: proxy.wait_for_service(),
    lambda proxy: proxy.stop_call(),
    lambda proxy: proxy.get_response(),
    lambda proxy: proxy.get_errors(),
    lambda proxy: proxy.shutdown(),
)
METHOD_NAMES = ("call", "wait", "stop", "read", "errors", "shutdown")

# The state after each event in the loop.
TOLD = {
    #          answered  deadline  appeared   vanished  closed
    IDLE: (IDLE, IDLE, IDLE, IDLE, IDLE),
    WAITING: (WAITING, TIMEOUT, AVAILABLE, WAITING, ERROR),
    AVAILABLE: (AVAILABLE, AVAILABLE, AVAILABLE, AVAILABLE, AVAILABLE),
    RUNNING: (READY, TIMEOUT, RUNNING, ERROR, ERROR),
    READY: (READY, READY, READY, READY, READY),
    TIMEOUT: (TIMEOUT, TIMEOUT, TIMEOUT, TIMEOUT, TIMEOUT),
    ABORTED: (ABORTED, ABORTED, ABORTED, ABORTED, ABORTED),
    ERROR: (ERROR, ERROR, ERROR, ERROR, ERROR),
}


async def turns() -> None:
    """Run the loop for enough turns to finish everything that is due."""
    for _ in range(20):
        await asyncio.sleep(0)


async def answered(stage: Stage) -> None:
    stage.answer()
    await turns()


async def deadline(stage: Stage) -> None:
    await asyncio.sleep(1.5 * SOON)
    await turns()


async def appeared(stage: Stage) -> None:
    stage.serve()
    await turns()


async def vanished(stage: Stage) -> None:
    stage.vanish()
    await asyncio.sleep(0.6 * TICK)
    await turns()


async def closed(stage: Stage) -> None:
    await stage.session.aclose()


NEWS: tuple[Callable[[Stage], Awaitable[None]], ...] = (
    answered,
    deadline,
    appeared,
    vanished,
    closed,
)


def test_the_tables_are_complete() -> None:
    assert list(ASKED) == list(TOLD)
    assert set(ASKED) == set(ProxyState)
    methods = {name for name, _ in inspect.getmembers(AsyncServiceProxy, inspect.isfunction)}
    assert {name for name in methods if not name.startswith("_")} == {
        *("call_service", "wait_for_service", "stop_call", "shutdown", "make_request"),
        *("get_state", "get_response", "get_errors"),
    }


def at_once(method: Callable[[AsyncServiceProxy], object], proxy: AsyncServiceProxy) -> ProxyState:
    method(proxy)
    return proxy.get_state()


def in_thread(
    method: Callable[[AsyncServiceProxy], object], proxy: AsyncServiceProxy
) -> ProxyState:
    """Call a method in a thread, while the loop is blocked."""
    with ThreadPoolExecutor() as threads:
        return threads.submit(at_once, method, proxy).result()


@pytest.mark.parametrize("where", ["loop", "thread"])
@pytest.mark.parametrize("event", METHOD_NAMES)
@pytest.mark.parametrize("state", ProxyState)
async def test_each_method_in_each_state(
    state: ProxyState, event: str, where: Literal["loop", "thread"]
) -> None:
    number = METHOD_NAMES.index(event)
    async with staged() as stage:
        await stage.reach(state)
        after = (at_once if where == "loop" else in_thread)(METHODS[number], stage.proxy)
        assert after is ASKED[state][number]
        # A pending operation continues, and no result of an earlier one appears.
        await answered(stage)
        stage.serve()
        await answered(stage)
        expected = {RUNNING: READY, WAITING: AVAILABLE}.get(after, after)
        if after in (WAITING, RUNNING):
            await until(lambda: stage.proxy.get_state() is expected)
        assert stage.proxy.get_state() is expected


@pytest.mark.parametrize("news", NEWS)
@pytest.mark.parametrize("state", ProxyState)
async def test_each_piece_of_news_in_each_state(
    state: ProxyState, news: Callable[[Stage], Awaitable[None]]
) -> None:
    async with staged() as stage:
        pending = state in (WAITING, RUNNING)
        await stage.reach(state, SOON if pending and news is deadline else LIMIT)
        await news(stage)
        expected = TOLD[state][NEWS.index(news)]
        if expected is not state:
            await until(lambda: stage.proxy.get_state() is not state)
        assert stage.proxy.get_state() is expected


@pytest.mark.parametrize("state", ProxyState)
async def test_only_a_ready_response_is_read_and_only_once(state: ProxyState) -> None:
    async with staged() as stage:
        await stage.reach(state)
        assert stage.proxy.get_response() == ("the answer" if state is READY else None)
        assert stage.proxy.get_response() is None


@pytest.mark.parametrize("state", ProxyState)
async def test_errors_are_those_of_the_state(state: ProxyState) -> None:
    kinds: dict[ProxyState, list[type[Exception]]] = {
        TIMEOUT: [ResponseTimeout],
        ERROR: [ServerGone],
    }
    async with staged() as stage:
        await stage.reach(state)
        assert [type(error) for error in stage.proxy.get_errors()] == kinds.get(state, [])
        stage.serve()
        stage.proxy.call_service()
        assert stage.proxy.get_errors() == []


async def test_a_wait_that_times_out_says_what_was_seen_instead() -> None:
    async with staged() as stage:
        await stage.reach(WAITING, SOON)
        assert await settled(stage.proxy) is TIMEOUT
        (error,) = stage.proxy.get_errors()
        assert isinstance(error, ServiceUnavailable)
        assert "the graph has" in str(error)


async def test_without_waiting_an_absent_server_ends_the_call_at_once() -> None:
    async with staged() as stage:
        stage.proxy.call_service(wait=False)
        assert await settled(stage.proxy) is TIMEOUT
        assert [type(error) for error in stage.proxy.get_errors()] == [ServiceUnavailable]


async def test_a_retry_sends_again() -> None:
    graph = FakeGraph()
    graph.serve(ECHO, "/echo", lambda request: f"to {request.load_namespace}")
    async with graph.session() as session:
        proxy = AsyncServiceProxy(session, ECHO, "/echo", retry=Retry(after=TICK))
        with graph.drop_requests():
            proxy.call_service(request_of("a"))
            await until(lambda: session.pool.statistics().in_flight)
        await until(lambda: proxy.get_state() is not RUNNING)
        assert proxy.get_response() == "to a"
        assert session.pool.statistics().retried == 1
        with pytest.raises(TypeError, match="retry"):
            AsyncServiceProxy(session, ECHO, "/echo", retry=3)  # type: ignore[arg-type]


async def test_a_full_pool_is_an_error() -> None:
    graph = FakeGraph()
    graph.serve(ECHO, NAME, lambda _: None)
    async with graph.session(limits=Limits(in_flight=1, waiting=0)) as session:
        proxies = [AsyncServiceProxy(session, ECHO, NAME) for _ in range(2)]
        with graph.hold_requests():
            for proxy in proxies:
                proxy.call_service()
            await until(lambda: proxies[1].get_state() is not RUNNING)
            assert proxies[1].get_state() is ERROR
            assert [type(error) for error in proxies[1].get_errors()] == [PoolFull]
        assert await settled(proxies[0]) is READY


async def test_without_a_timeout_the_sessions_holds() -> None:
    graph = FakeGraph()
    graph.serve(ECHO, NAME, lambda _: None)
    async with graph.session(timeout=TICK) as session:
        proxy, other = (AsyncServiceProxy(session, ECHO, NAME) for _ in range(2))
        with graph.drop_requests():
            proxy.call_service()
            other.call_service(timeout=math.inf)
            assert await settled(proxy) is TIMEOUT
        assert other.get_state() is RUNNING


async def test_none_is_no_deadline_and_so_is_a_wait_without_a_timeout() -> None:
    graph = FakeGraph()
    graph.serve(ECHO, NAME, lambda _: None)
    async with graph.session(timeout=TICK) as session:
        call, wait = (AsyncServiceProxy(session, ECHO, NAME) for _ in range(2))
        first, last = (AsyncServiceProxy(session, ECHO, "/absent") for _ in range(2))
        with graph.drop_requests():
            call.call_service(None, None)
            wait.wait_for_service(None)
            first.wait_for_service()
            last.wait_for_service(...)
            assert await settled(last) is TIMEOUT
            assert call.get_state() is RUNNING
        assert first.get_state() is WAITING
        assert wait.get_state() is ProxyState.SERVICE_AVAILABLE


async def test_the_deadline_counts_from_the_tick_that_asked() -> None:
    async with staged() as stage:
        stage.serve()
        stage.proxy.call_service(timeout=TICK)
        busy_until = asyncio.get_running_loop().time() + 2 * TICK
        while asyncio.get_running_loop().time() < busy_until:
            pass
        await turns()
        assert stage.proxy.get_state() is TIMEOUT


async def test_calls_replaced_before_the_loop_sees_them_are_never_sent() -> None:
    async with staged() as stage:
        stage.serve()
        assert stage.server is not None
        received = stage.server.received

        def tick() -> None:
            for number in range(10):
                stage.proxy.call_service(request_of(str(number)))
            stage.proxy.stop_call()
            stage.proxy.call_service(request_of("last"))

        in_thread(lambda _: tick(), stage.proxy)
        stage.answer()
        assert await settled(stage.proxy) is READY
        assert [request.load_namespace for request in received] == ["last"]


async def test_calls_stopped_or_replaced_in_the_turn_in_which_the_server_comes_are_never_sent() -> (
    None
):
    async with staged() as stage:
        stage.proxy.call_service(request_of("replaced"))
        stage.proxy.call_service(request_of("stopped"))
        stage.proxy.stop_call()
        stage.proxy.call_service(request_of("replaced, too"))
        stage.proxy.call_service(request_of("last"))
        stage.serve()
        stage.answer()
        assert stage.server is not None
        assert await settled(stage.proxy) is READY
        assert [request.load_namespace for request in stage.server.received] == ["last"]


async def test_in_the_loop_the_request_is_sent_by_the_tick_that_asks() -> None:
    async with staged() as stage:
        stage.serve()
        await stage.session.wait_for_service(ECHO, NAME)
        for count in (1, 2):
            stage.proxy.call_service(request_of(str(count)))
            (client,) = stage.session.node.clients
            assert len(client.sent) == count
        stage.answer()
        assert await settled(stage.proxy) is READY
        statistics = stage.session.pool.statistics()
        assert (statistics.cancelled, statistics.late) == (1, 1)


async def test_in_the_loop_a_call_that_cannot_begin_has_ended_at_once() -> None:
    async with staged() as stage:
        stage.proxy.call_service(wait=False)
        assert stage.proxy.get_state() is TIMEOUT


async def test_bad_arguments_raise_at_once_and_change_nothing() -> None:
    async with staged() as stage:
        await stage.reach(RUNNING)
        proxy = stage.proxy
        with pytest.raises(TypeError, match="AddDiagnostics"):
            proxy.call_service("no request")
        with pytest.raises(ValueError, match="no_field"):
            proxy.call_service({"no_field": 1})
        with pytest.raises(ValueError, match="NaN"):
            proxy.call_service(timeout=math.nan)
        with pytest.raises(TypeError, match="number of seconds"):
            proxy.wait_for_service("soon")  # type: ignore[arg-type]
        assert proxy.get_state() is RUNNING
        stage.answer()
        assert await settled(proxy) is READY


async def test_bad_services_raise_when_the_proxy_is_made() -> None:
    async with FakeGraph().session() as session:
        with pytest.raises(InvalidServiceName):
            AsyncServiceProxy(session, ECHO, "no name")
        with pytest.raises(ValueError, match="no_pkg"):
            AsyncServiceProxy(session, "no_pkg/srv/Type", NAME)
        with pytest.raises(TypeError):
            AsyncServiceProxy(session, 5, NAME)  # type: ignore[arg-type]
    with pytest.raises(SessionClosed):
        AsyncServiceProxy(session, ECHO, NAME)
    with pytest.raises(UsageError, match="not open"):
        AsyncServiceProxy(rosasync.Session(), ECHO, NAME)


@pytest.mark.parametrize("where", ["loop", "thread"])
async def test_on_a_closed_session_a_call_is_an_error_and_no_exception(where: str) -> None:
    async with staged() as stage:
        pass
    for ask in (stage.proxy.call_service, stage.proxy.wait_for_service):
        ask() if where == "loop" else await asyncio.to_thread(ask)
        assert await settled(stage.proxy) is ERROR
        assert [type(error) for error in stage.proxy.get_errors()] == [SessionClosed]


async def test_after_shutdown_it_refuses() -> None:
    async with staged() as stage:
        stage.proxy.shutdown()
        stage.proxy.shutdown()
        for ask in (stage.proxy.call_service, stage.proxy.wait_for_service):
            with pytest.raises(UsageError, match="shut down"):
                ask()
        assert stage.proxy.get_state() is IDLE


async def test_repr_says_service_and_state() -> None:
    async with staged() as stage:
        await stage.reach(RUNNING)
        assert repr(stage.proxy) == "<AsyncServiceProxy /echo RUNNING>"


@pytest.mark.parametrize("state", [AVAILABLE, READY, TIMEOUT, ABORTED, ERROR])
async def test_nothing_is_kept_of_what_has_ended(state: ProxyState) -> None:
    async with staged() as stage:
        await stage.reach(state)
        await turns()
        assert stage.proxy._current.working is None
        assert stage.session.core.gateway.pending == 0


class TestForerunner:
    """The defects of the proxy that this one replaces; each docstring names one."""

    @pytest.fixture
    async def held(self, server: ServerProcess) -> ServerProcess:
        await server.serve(NAME, delay="hold")
        return server

    async def test_a_claimed_client_is_not_given_to_another(
        self, bridge: Bridge, held: ServerProcess
    ) -> None:
        """The filter for claimed clients was always true, so all calls shared the first."""
        async with Session(bridge=bridge, limits=Limits(clients=8, in_flight=1)) as session:
            proxies = [AsyncServiceProxy(session, ECHO, NAME) for _ in range(2)]
            for proxy in proxies:
                await asyncio.to_thread(proxy.call_service, request_of("a"))
            await held.received(NAME, 2)
            now = session.pool.statistics()
            assert (now.clients, now.idle, now.in_flight) == (2, 0, 2)
            await held.release(NAME)
            assert [await settled(proxy) for proxy in proxies] == [READY, READY]

    async def test_clients_made_on_demand_are_all_kept(
        self, bridge: Bridge, held: ServerProcess
    ) -> None:
        """The counter of ids stayed 0, so each new client replaced the one before."""
        async with Session(bridge=bridge, limits=Limits(clients=8, in_flight=1)) as session:
            proxies = [AsyncServiceProxy(session, ECHO, NAME) for _ in range(5)]
            for round_ in range(2):
                for number, proxy in enumerate(proxies):
                    proxy.call_service(request_of(f"{round_} {number}"))
                await held.received(NAME, 5 * (round_ + 1))
                await held.release(NAME)
                assert [await settled(proxy) for proxy in proxies] == 5 * [READY]
                answers = [answer_to(proxy.get_response()) for proxy in proxies]
                assert answers == [f"{round_} {number}" for number in range(5)]
            now = session.pool.statistics()
            assert (now.created, now.clients, now.idle) == (5, 5, 5)

    @pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
    @pytest.mark.parametrize("where", ["loop", "thread"])
    async def test_a_superseded_call_cannot_answer_for_the_new_one(
        self, session: Session, held: ServerProcess, where: str
    ) -> None:
        """The thread of a superseded call wrote its late answer over the state of the new one."""
        proxy = AsyncServiceProxy(session, ECHO, NAME)

        async def call(text: str) -> None:
            if where == "loop":
                proxy.call_service(request_of(text))
            else:
                await asyncio.to_thread(proxy.call_service, request_of(text))

        await call("old")
        await held.received(NAME, 1)
        await call("new")
        await held.received(NAME, 2)
        await held.release(NAME, 1)
        await until(lambda: session.pool.statistics().late == 1)
        assert proxy.get_state() is RUNNING
        assert proxy.get_response() is None
        await held.release(NAME)
        assert await settled(proxy) is READY
        assert answer_to(proxy.get_response()) == "new"
        assert proxy.get_response() is None
        await assert_clean(session)

    async def test_an_interrupted_wait_does_not_stay_in_its_state(self, session: Session) -> None:
        """An interrupt neither ended nor reported the wait, and left it RUNNING for ever."""
        proxy = AsyncServiceProxy(session, ECHO, "/absent")
        proxy.wait_for_service()
        await asyncio.sleep(0)
        proxy.stop_call()
        assert proxy.get_state() is ABORTED
        proxy.wait_for_service(TICK)
        assert await settled(proxy) is TIMEOUT
        await assert_clean(session)

    async def test_proxies_of_one_service_share_a_client(self, session: Session, echo: str) -> None:
        """The version for ROS 2 had no pool, but a client for each proxy."""
        proxies = [AsyncServiceProxy(session, ECHO, echo) for _ in range(50)]
        for number, proxy in enumerate(proxies):
            proxy.call_service(request_of(str(number)))
        for number, proxy in enumerate(proxies):
            assert await settled(proxy) is READY
            assert answer_to(proxy.get_response()) == str(number)
        assert session.pool.statistics().created == 1

    async def test_stopping_does_not_claim_to_have_aborted_what_had_ended(
        self, session: Session, echo: str
    ) -> None:
        """After a first call, stop_call replaced IDLE and each outcome by ABORTED."""
        proxy = AsyncServiceProxy(session, ECHO, echo)
        proxy.call_service(request_of("a"))
        assert await settled(proxy) is READY
        assert answer_to(proxy.get_response()) == "a"
        proxy.stop_call()
        assert proxy.get_state() is IDLE
        proxy.wait_for_service(LIMIT)
        assert await settled(proxy) is AVAILABLE
        proxy.stop_call()
        assert proxy.get_state() is AVAILABLE

    async def test_an_error_after_an_abort_stays_aborted(self, session: Session) -> None:
        """The error of the aborted thread replaced ABORTED."""
        proxy = AsyncServiceProxy(session, ECHO, "/absent")
        proxy.call_service(timeout=TICK)
        with ThreadPoolExecutor() as threads:
            # The loop is blocked during this, and then handles both the deadline and the abort.
            threads.submit(time.sleep, 2 * TICK).result()
        proxy.stop_call()
        await asyncio.sleep(TICK)
        assert proxy.get_state() is ABORTED
        assert proxy.get_errors() == []
        await session.aclose()
        assert proxy.get_state() is ABORTED

    async def test_shutdown_ends_a_call_that_is_out(
        self, session: Session, held: ServerProcess
    ) -> None:
        """shutdown released the client that its thread was still using, for others to claim."""
        proxy, other = (AsyncServiceProxy(session, ECHO, NAME) for _ in range(2))
        proxy.call_service(request_of("a"))
        await held.received(NAME, 1)
        proxy.shutdown()
        assert proxy.get_state() is ABORTED
        await until(lambda: session.pool.statistics().abandoned == 1)
        other.call_service(request_of("b"))
        await held.received(NAME, 2)
        await held.release(NAME)
        assert await settled(other) is READY
        assert answer_to(other.get_response()) == "b"
        assert proxy.get_state() is ABORTED
        assert session.pool.statistics().late == 1
        await assert_clean(session)


async def test_a_server_that_appears_gets_the_call_that_waits(
    session: Session, server: ServerProcess
) -> None:
    proxy, waiting = (AsyncServiceProxy(session, ECHO, "/later") for _ in range(2))
    proxy.call_service(request_of("a"), timeout=LIMIT)
    waiting.wait_for_service(timeout=LIMIT)
    await asyncio.sleep(0)
    await server.serve("/later")
    assert await settled(waiting) is AVAILABLE
    assert await settled(proxy) is READY
    assert answer_to(proxy.get_response()) == "a"


@pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
async def test_two_threads_and_the_loop_may_use_one_proxy(session: Session, echo: str) -> None:
    """In any order, the last call gets its own response, and nothing is left behind."""
    proxy = AsyncServiceProxy(session, ECHO, echo)

    def quarrel() -> None:
        for number in range(300):
            proxy.call_service(request_of(str(number)))
            proxy.get_response()
            proxy.stop_call()

    async with asyncio.TaskGroup() as group:
        for _ in range(2):
            group.create_task(asyncio.to_thread(quarrel))
        for number in range(300):
            proxy.call_service(request_of(str(number)))
            await asyncio.sleep(0)
    proxy.call_service(request_of("the last"))
    assert await settled(proxy) is READY
    response: Any = proxy.get_response()
    assert answer_to(response) == "the last"
    await assert_clean(session)
