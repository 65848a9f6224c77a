"""What a server with ``status=True`` tells its callers, and what it learns of them."""

from __future__ import annotations

import asyncio
import pickle
import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from rosasync import (
    HandlerFailed,
    Limits,
    ResponseTimeout,
    Retry,
    ServerGone,
    ServerOverloaded,
    Session,
)
from rosasync._client import matching
from rosasync._client.matching import GONE_DELAY
from rosasync._core.ports import TopicQos
from rosasync._status.wire import Outcome, Report, process_of, report_topic
from tests.conftest import Bridge
from tests.support.clients import ClientProcess
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.serving import AnyCall, Gate, Holder, ask, discard, echo_call, echo_of
from tests.support.times import LIMIT, TICK, until

MANY = Limits(in_flight=100, server_depth=None)


class World:
    """A serving session and a calling one, in memory or on real ROS."""

    def __init__(self, server: Session, client: Session) -> None:
        self.server = server
        self.client = client

    async def serve(self, handler: Any, **options: Any) -> Any:
        """Serve a name, and wait until the client has subscribed to its reports."""
        opened = self.server.serve(ECHO, "/told", handler, **{"status": True, **options})
        await self.client.wait_for_service(ECHO, "/told", timeout=LIMIT)
        await until(lambda: self.heard)
        return opened

    @property
    def heard(self) -> bool:
        """Whether both sides have found each other's topics."""
        pool = self.client.pool.service(ECHO, "/told", None)
        pool.match()
        servers = self.client.core.node.queries.find_servers(pool.service)
        return self.client.core.pool.listener.hears(servers)

    def call(self, text: str = "x", **options: Any) -> asyncio.Task[Any]:
        return self.client.start(ECHO, "/told", request_of(text), **{"timeout": LIMIT, **options})


@pytest.fixture(params=["fake", "direct", "executor"])
async def world(request: pytest.FixtureRequest) -> AsyncIterator[World]:
    if request.param == "fake":
        graph = FakeGraph()
        async with graph.session() as server, graph.session(limits=MANY) as client:
            yield World(server, client)
        return
    async with (
        Session("told_server", bridge=request.param) as server,
        Session("told_client", bridge=request.param, limits=MANY) as client,
    ):
        yield World(server, client)


async def fail(call: AnyCall) -> Any:
    raise LookupError(f"no {call.request.load_namespace} here")


async def test_the_error_of_a_handler_reaches_its_caller(world: World) -> None:
    await world.serve(fail)
    with pytest.raises(HandlerFailed, match="/told: the handler failed: LookupError: no x") as info:
        await world.call()
    error = info.value
    assert (error.error_type, error.error_message) == ("LookupError", "no x here")
    assert (error.srv_name, error.srv_type) == ("/told", ECHO)
    copy = pickle.loads(pickle.dumps(error))
    assert copy.__dict__ == error.__dict__
    assert world.client.pool.statistics().in_flight == 0


async def test_a_quiet_server_keeps_the_message(world: World) -> None:
    await world.serve(fail, status="quiet")
    with pytest.raises(HandlerFailed) as info:
        await world.call()
    assert (info.value.error_type, info.value.error_message) == ("LookupError", "")
    assert "no x" not in str(info.value)


async def test_a_handler_that_drops_its_call_is_reported(world: World) -> None:
    def drop(call: AnyCall) -> None:
        """Return None and forget the call."""

    await world.serve(drop)
    with (
        pytest.warns(ResourceWarning, match="dropped unanswered"),
        pytest.raises(HandlerFailed, match="dropped the call unanswered"),
    ):
        await world.call()


async def test_what_on_error_answers_is_no_failure(world: World) -> None:
    await world.serve(fail, on_error=lambda call, error: echo_of(call.request))
    assert answer_to(await world.call("answered")) == "answered"


async def test_a_dropped_request_is_reported(world: World) -> None:
    gate = Gate()
    await world.serve(gate, concurrency=1, backlog=1)
    running, dropped, waiting = (world.call(str(number)) for number in range(3))
    with pytest.raises(ServerOverloaded, match="the server dropped the request"):
        await dropped
    gate.set()
    assert [answer_to(await task) for task in (running, waiting)] == ["0", "2"]


async def test_a_dropped_request_is_sent_again_with_retry(world: World) -> None:
    gate = Gate()
    server = await world.serve(gate, concurrency=1, backlog=1)
    # What is sent again before the gate is open pushes the other one out.
    retry = Retry(attempts=100, after=0.2, backoff=1.0, budget=100)
    calls = [world.call(str(number), retry=retry) for number in range(3)]
    await until(lambda: server.statistics().rejected >= 1)
    gate.set()
    answers = await asyncio.gather(*calls)
    assert [answer_to(response) for response in answers] == ["0", "1", "2"]


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Callers end by what the server says: the graph does not end them before that arrives."""
    monkeypatch.setattr(matching, "GONE_DELAY", LIMIT)


@pytest.mark.usefixtures("patient")
async def test_a_server_that_closes_says_so(world: World) -> None:
    server = await world.serve(Holder())
    call = world.call()
    await until(lambda: server.statistics().taken == 1)
    await server.aclose(0)
    with pytest.raises(ServerGone, match="the server"):
        await call


@pytest.mark.usefixtures("patient")
async def test_a_server_that_closes_has_not_failed_because_it_cancels_its_handlers(
    world: World,
) -> None:
    server = await world.serve(Gate())
    call = world.call()
    await until(lambda: server.statistics().running == 1)
    await server.aclose(0)
    with pytest.raises(ServerGone, match="the server"):
        await call


@asynccontextmanager
async def two_servers(graph: FakeGraph) -> AsyncIterator[tuple[World, Holder]]:
    """Two processes that serve the name, and the calls of both."""
    async with (
        graph.session() as first,
        graph.session() as second,
        graph.session(limits=MANY) as client,
    ):
        holder = Holder()
        first.serve(ECHO, "/told", holder, status=True)
        world = World(second, client)
        await world.serve(holder)
        yield world, holder


async def test_a_server_reports_after_the_other_has_vanished(fake_graph: FakeGraph) -> None:
    async with two_servers(fake_graph) as (world, holder):
        task = world.call()
        _, call = await holder.held(2)
        fake_graph.servers[0].close()
        await asyncio.sleep(2 * GONE_DELAY)
        assert not task.done()
        call.give_up("failed", error=LookupError("no"))
        with pytest.raises(HandlerFailed, match="LookupError: no"):
            await task


async def test_a_server_vanishes_after_the_other_has_reported(fake_graph: FakeGraph) -> None:
    async with two_servers(fake_graph) as (world, holder):
        task = world.call()
        _, call = await holder.held(2)
        call.give_up("failed", error=LookupError("no"))
        await asyncio.sleep(2 * GONE_DELAY)
        assert not task.done()
        fake_graph.servers[0].close()
        with pytest.raises(HandlerFailed, match="LookupError: no"):
            await task


async def test_a_server_that_has_vanished_holds_no_place(fake_graph: FakeGraph) -> None:
    async with two_servers(fake_graph) as (world, holder):
        task = world.call()
        await holder.held(2)
        gone = fake_graph.servers[0]
        for publisher in tuple(fake_graph.topics.publishers):
            if process_of(publisher.identity) == process_of(gone.identity):
                publisher.close()
        gone.close()
        await asyncio.sleep(2 * GONE_DELAY)
        await discard(task)
        assert world.client.pool.statistics().abandoned == 0


async def test_a_server_reports_to_callers_that_have_waited_for_it(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as server, fake_graph.session() as client:
        task = client.start(ECHO, "/told", request_of("x"), timeout=LIMIT)
        await asyncio.sleep(TICK)
        server.serve(ECHO, "/told", fail, status=True)
        with pytest.raises(HandlerFailed):
            await task


async def test_waiting_requests_of_callers_that_left_are_not_run(world: World) -> None:
    gate = Gate()
    ran: list[str] = []

    async def handler(call: AnyCall) -> Any:
        ran.append(call.request.load_namespace)
        return await gate(call)

    server = await world.serve(handler, concurrency=1)
    calls = [world.call(str(number)) for number in range(20)]
    await until(lambda: server.statistics().waiting == 19)
    for call in calls[1::2]:
        call.cancel()
    await until(lambda: server.statistics().abandoned == 10)
    # The client learns later than the server that their places are free.
    await until(lambda: world.client.pool.statistics().abandoned == 0)
    gate.set()
    answers = await asyncio.gather(*calls[::2])
    assert [answer_to(response) for response in answers] == [str(n) for n in range(0, 20, 2)]
    assert ran == [str(number) for number in range(0, 20, 2)]
    assert server.statistics().waiting == 0


async def test_a_departure_that_comes_before_its_request(
    fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with fake_graph.session() as server, fake_graph.session(limits=MANY) as client:
        world = World(server, client)
        ran: list[str] = []

        def handler(call: AnyCall) -> Any:
            ran.append(call.request.load_namespace)
            return echo_of(call.request)

        served = await world.serve(handler)
        held: list[Any] = []
        with monkeypatch.context() as patch:
            patch.setattr(fake_graph, "carry_request", lambda *request: held.append(request))
            left, stays = world.call("left"), world.call("stays")
            left.cancel()
            await until(left.done)
            # Let the departure arrive.
            await asyncio.sleep(TICK)
        for request in held:
            fake_graph.carry_request(*request)
        assert answer_to(await stays) == "stays"
        assert ran == ["stays"]
        assert (served.statistics().abandoned, served.statistics().unanswered) == (1, 0)


async def test_an_async_handler_does_not_begin_for_a_caller_that_leaves_in_the_same_turn(
    fake_graph: FakeGraph,
) -> None:
    async with fake_graph.session() as server, fake_graph.session(limits=MANY) as client:
        world = World(server, client)
        ran: list[str] = []

        async def handler(call: AnyCall) -> Any:
            ran.append(call.request.load_namespace)
            return echo_of(call.request)

        served = await world.serve(handler)
        left, stays = world.call("left"), world.call("stays")
        pool = client.pool.service(ECHO, "/told", None)
        # It arrives in the turn in which the request does: right after it.
        client.core.pool.listener.depart(pool.clients[0].identity, 1, pool.clients[0].servers)
        assert answer_to(await stays) == "stays"
        assert ran == ["stays"]
        statistics = served.statistics()
        assert (statistics.abandoned, statistics.running, statistics.unanswered) == (1, 0, 0)
        await discard(left)


async def test_what_a_handler_has_begun_before_its_first_turn_goes_on(
    fake_graph: FakeGraph,
) -> None:
    async with fake_graph.session() as server, fake_graph.session(limits=MANY) as client:
        world = World(server, client)

        def handler(call: AnyCall) -> Any:
            return asyncio.ensure_future(asyncio.sleep(0, echo_of(call.request)))

        served = await world.serve(handler)
        call = world.call()
        pool = client.pool.service(ECHO, "/told", None)
        client.core.pool.listener.depart(pool.clients[0].identity, 1, pool.clients[0].servers)
        await call
        assert served.statistics().abandoned == 0


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
async def test_callers_that_leave_at_random(world: World, count: int) -> None:
    choose = random.Random(1)
    ran_for_nobody: list[str] = []
    runs = 0

    async def handler(call: AnyCall) -> Any:
        nonlocal runs
        runs += 1
        # If the server knows of it: a departure is under way for a moment.
        if call.abandoned:
            ran_for_nobody.append(call.request.load_namespace)
        await asyncio.sleep(choose.random() * TICK / 10)
        return echo_of(call.request)

    server = await world.serve(handler, concurrency=10)
    calls = {str(number): world.call(str(number)) for number in range(count)}
    for text in choose.sample(sorted(calls), count):
        if choose.random() < 0.5:
            calls[text].cancel()
        if choose.random() < 0.3:
            await asyncio.sleep(choose.random() * TICK / 10)
    done = await asyncio.gather(*calls.values(), return_exceptions=True)
    for text, result in zip(calls, done, strict=True):
        assert isinstance(result, asyncio.CancelledError) or answer_to(result) == text
    assert not ran_for_nobody
    await until(lambda: server.statistics().waiting == server.statistics().running == 0)
    await until(lambda: server.statistics().unanswered == 0)
    statistics = server.statistics()
    assert runs <= statistics.taken <= count
    pool = world.client.pool.service(ECHO, "/told", None)
    await until(lambda: all(client.window.taken == 0 for client in pool.clients))
    assert (pool.statistics().in_flight, pool.statistics().waiting) == (0, 0)
    assert answer_to(await world.call("after")) == "after"


async def test_a_running_call_learns_that_its_caller_has_left(world: World) -> None:
    holder = Holder()
    await world.serve(holder)
    task = world.call()
    (call,) = await holder.held(1)
    assert not call.abandoned
    task.cancel()
    await until(lambda: call.abandoned)
    call.respond(echo_of(call.request))


async def test_a_handler_is_cancelled_if_that_is_wished(world: World) -> None:
    ended: list[str] = []

    async def handler(call: AnyCall) -> Any:
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            ended.append(call.request.load_namespace)
            raise

    server = await world.serve(handler, cancel_abandoned=True)
    with pytest.raises(ResponseTimeout):
        await world.call("slow", timeout=20 * TICK)
    await until(lambda: ended == ["slow"])
    await until(lambda: server.statistics().running == 0)


async def test_a_thousand_callers_that_leave(world: World) -> None:
    gate = Gate()
    left_before: set[str] = set()
    ran_after: list[str] = []

    async def handler(call: AnyCall) -> Any:
        text = call.request.load_namespace
        if text in left_before:
            ran_after.append(text)
        return await gate(call)

    server = await world.serve(handler, concurrency=10)
    calls = {str(number): world.call(str(number)) for number in range(1000)}
    await until(lambda: server.statistics().taken == 100)
    for text, call in list(calls.items())[10::3]:
        call.cancel()
        left_before.add(text)
    # Of those, 30 had been sent. Until the server knows, it may run them.
    await until(lambda: server.statistics().abandoned == 30)
    gate.set()
    done = await asyncio.gather(*calls.values(), return_exceptions=True)
    answered = [text for text, result in zip(calls, done, strict=True) if text not in left_before]
    assert all(
        answer_to(result) == text
        for text, result in zip(calls, done, strict=True)
        if text not in left_before
    )
    assert len(answered) == 670
    assert not ran_after
    statistics = world.client.pool.statistics()
    assert (statistics.in_flight, statistics.waiting, statistics.abandoned) == (0, 0, 0)
    await until(lambda: server.statistics().waiting == server.statistics().running == 0)


async def test_a_forged_report_of_another_server_ends_nothing(world: World) -> None:
    gate = Gate()
    await world.serve(gate)
    task = world.call("real")
    pool = world.client.pool.service(ECHO, "/told", None)
    await until(lambda: pool.statistics().in_flight == 1)
    (server,) = world.client.core.node.queries.find_servers(pool.service)
    assert isinstance(server, bytes)
    forger = world.server.core.node.open_publisher(
        DiagnosticStatus, report_topic(str(process_of(server))), TopicQos(latched=True)
    )
    client = pool.clients[0].identity
    assert isinstance(client, bytes)
    for report in (
        Report("/told", bytes(16), client, 1, Outcome.FAILED),
        Report("/told", server, client, 2**62, Outcome.FAILED),
        Report("/told", server, bytes(16), 1, Outcome.FAILED),
    ):
        forger.publish(world.server.core.node.make_message(DiagnosticStatus, report.to_mapping()))
    forger.publish(DiagnosticStatus(message="no report"))
    await asyncio.sleep(0.1)
    gate.set()
    assert answer_to(await task) == "real"
    forger.close()


async def test_a_server_does_not_take_part_because_another_process_says_so(world: World) -> None:
    world.server.serve(ECHO, "/told", echo_call)
    await world.client.wait_for_service(ECHO, "/told", timeout=LIMIT)
    pool = world.client.pool.service(ECHO, "/told", None)
    (server,) = world.client.core.node.queries.find_servers(pool.service)
    # The client's own process is another than the server's.
    forger = world.client.core.node.open_publisher(
        DiagnosticStatus, report_topic(str(process_of(server))), TopicQos(latched=True)
    )
    topic = report_topic(str(process_of(server)))
    await until(lambda: world.client.core.node.queries.find_publishers(topic))
    world.client.core.pool.listener.on_servers(frozenset({server}))
    assert not world.client.core.pool.listener.hears(frozenset({server}))
    assert answer_to(await world.call("answered")) == "answered"
    forger.close()


async def test_nothing_is_created_without_status(session: Session, bridge: Bridge) -> None:
    async with Session("plain", bridge=bridge) as client:
        session.serve(ECHO, "/plain", echo_call)
        assert await ask(client, "/plain", "x", timeout=LIMIT) == "x"
        topics = {name for name, _ in client.node.get_topic_names_and_types()}
        assert not [name for name in topics if name.startswith("/_rosasync")]


async def test_a_stock_client_of_such_a_server_sees_no_difference(
    session: Session, client_process: ClientProcess
) -> None:
    session.serve(ECHO, "/told", echo_call, status=True)
    tally = await client_process.run("/told", 50, timeout=LIMIT)
    assert (tally.answered, tally.wrong, tally.lost) == (50, 0, 0)


async def test_a_stock_client_that_was_killed_has_left(session: Session) -> None:
    gate = Gate()
    server = session.serve(ECHO, "/told", gate, status=True, concurrency=1)
    async with ClientProcess(lease=4) as stock:
        await stock.start("/told", None, in_flight=5, timeout=3 * LIMIT)
        await until(lambda: server.statistics().waiting == 4)
        stock.kill()
        # The graph shows it until its lease has ended.
        await until(lambda: server.statistics().abandoned == 4, LIMIT)
    gate.set()


class TestVerify:
    """`Retry.verify` is asked before a request is sent again."""

    async def test_its_response_is_the_answer(self, world: World) -> None:
        holder = Holder()
        asked: list[int] = []

        async def verify() -> Any:
            # On a busy machine the request may take longer than the time after which it is asked.
            await holder.held(1)
            asked.append(len(holder.calls))
            return echo_of(request_of("had run"))

        await world.serve(holder)
        answer = await world.call(retry=Retry(after=0.05, verify=verify))
        assert answer_to(answer) == "had run"
        assert (asked, len(holder.calls)) == ([1], 1)

    async def test_none_sends_it_again(self, world: World) -> None:
        holder = Holder()

        async def verify() -> None:
            await asyncio.sleep(0)

        await world.serve(holder)
        task = world.call(retry=Retry(attempts=2, after=0.05, verify=verify))
        _, second = await holder.held(2)
        second.respond(echo_of(second.request))
        assert answer_to(await task) == "x"

    async def test_a_mapping_is_an_answer(self, world: World) -> None:
        async def verify() -> Any:
            return {"message": "had run"}

        await world.serve(Holder())
        assert answer_to(await world.call(retry=Retry(after=0.05, verify=verify))) == "had run"

    async def test_anything_else_is_an_error(self, world: World) -> None:
        async def verify() -> Any:
            return False

        await world.serve(Holder())
        with pytest.raises(TypeError, match=r"Retry\.verify returned no response: expected .*bool"):
            await world.call(retry=Retry(after=0.05, verify=verify))

    async def test_its_error_is_the_calls(self, world: World) -> None:
        async def verify() -> None:
            raise KeyError("sensor")

        await world.serve(Holder())
        with pytest.raises(KeyError, match="sensor"):
            await world.call(retry=Retry(after=0.05, verify=verify))

    async def test_it_ends_with_the_deadline(self, world: World) -> None:
        cancelled: list[bool] = []

        async def verify() -> None:
            try:
                await asyncio.Event().wait()
            finally:
                cancelled.append(True)

        await world.serve(Holder())
        with pytest.raises(ResponseTimeout):
            await world.call(timeout=1.0, retry=Retry(after=0.05, verify=verify))
        await until(lambda: bool(cancelled))

    def test_it_must_be_callable(self) -> None:
        with pytest.raises(TypeError, match="verify must be a coroutine function"):
            Retry(verify=3)  # type: ignore[arg-type]
