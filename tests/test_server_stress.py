"""Servers under load: bursts, responses from threads, and repeated closing under calls."""

from __future__ import annotations

import asyncio
import itertools
import queue
import random
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from rosasync import Retry, Session, SessionClosed
from rosasync._ros.inspect import all_discovered
from tests.support.checks import count_descriptors, count_threads
from tests.support.clients import ClientProcess, Tally
from tests.support.echo import ECHO
from tests.support.serving import FORMS, AnyCall, ask, echo_of, serving, settled
from tests.support.times import LIMIT, TICK, until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_domain")]

numbers = itertools.count()

CLIENTS = 50
PROCESSES = 4
EACH = 10


def rounds(few: int, *, soak: int) -> list[Any]:
    """Repetitions of a test; those after the first few run only under the marker ``soak``."""
    more = [pytest.param(number, marks=pytest.mark.soak) for number in range(few, soak)]
    return [*range(few), *more]


@pytest.fixture(scope="module")
def crowd(own_domain: None) -> Iterator[list[ClientProcess]]:
    """Four processes of stock clients."""
    with ExitStack() as stack:
        yield [stack.enter_context(ClientProcess()) for _ in range(PROCESSES)]


@pytest.fixture
def name() -> str:
    """A name of this test alone: clients made now may still know the servers of the last one."""
    return f"/stressed_{next(numbers)}"


async def start_burst(crowd: list[ClientProcess], name: str, **options: Any) -> None:
    """Have 50 clients in four processes make ten calls each, all at once."""
    shares = [len(range(number, CLIENTS, PROCESSES)) for number in range(PROCESSES)]
    for process, clients in zip(crowd, shares, strict=True):
        await process.start(name, EACH, clients=clients, in_flight=EACH, **options)


async def results(crowd: list[ClientProcess]) -> dict[str, int]:
    """Wait for the ends of all calls of a burst, and count them."""
    tallies = await asyncio.gather(*(process.result() for process in crowd))
    return {
        "answered": sum(tally.answered for tally in tallies),
        "wrong": sum(tally.wrong for tally in tallies),
        "lost": sum(tally.lost for tally in tallies),
    }


async def join(process: ClientProcess, name: str, seen: set[str], **options: Any) -> None:
    """Have a process call continuously, and wait until one of its calls arrives."""
    await process.start(name, None, depth=1000, **options)
    await until(lambda: str(process.pid) in seen)


def caller_of(request: Any) -> str:
    """The process that sent a request: its clients begin every text with its id."""
    return str(request.load_namespace).partition("-")[0]


@pytest.mark.parametrize("form", ["async, request and response", "plain, call", "iteration"])
async def test_a_burst_of_500_requests_is_answered(
    session: Session, crowd: list[ClientProcess], name: str, form: str
) -> None:
    async with serving(session, name, form) as server:
        await start_burst(crowd, name, depth=1000)
        result = await results(crowd)
        assert result == {"answered": CLIENTS * EACH, "wrong": 0, "lost": 0}
        await settled(server)
        assert server.statistics().taken == server.statistics().responded == CLIENTS * EACH


async def test_a_burst_of_stock_clients_is_taken_and_answered(
    session: Session, crowd: list[ClientProcess], name: str
) -> None:
    """The clients' queues of ten may lose responses. Those do not count against the server."""
    async with serving(session, name, "async, request and response") as server:
        await start_burst(crowd, name)
        await until(lambda: server.statistics().responded == CLIENTS * EACH)
        for process in crowd:
            await process.give_up()
        result = await results(crowd)
        assert result["wrong"] == 0
        assert result["answered"] + result["lost"] == CLIENTS * EACH
        await settled(server)
        statistics = server.statistics()
        assert statistics.taken == statistics.responded == CLIENTS * EACH
        assert statistics.rejected == statistics.dropped == statistics.undeliverable == 0


class Answerers:
    """Four threads that answer calls, in a shuffled order."""

    def __init__(self) -> None:
        self.refused = 0
        self.seen: set[str] = set()
        self.calls: queue.SimpleQueue[AnyCall | None] = queue.SimpleQueue()
        self._chance = random.Random(5)
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._answer) for _ in range(4)]

    @contextmanager
    def working(self) -> Iterator[None]:
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            for _ in self._threads:
                self.calls.put(None)
            for thread in self._threads:
                thread.join()

    def take(self, call: AnyCall) -> None:
        """The handler."""
        self.seen.add(caller_of(call.request))
        self.calls.put(call)

    def _answer(self) -> None:
        held: list[AnyCall] = []
        while True:
            try:
                call = self.calls.get(timeout=TICK / 10)
            except queue.Empty:
                pass
            else:
                if call is None:
                    break
                held.append(call)
                if len(held) < 20:
                    continue
            self._answer_all(held)
        self._answer_all(held)

    def _answer_all(self, held: list[AnyCall]) -> None:
        self._chance.shuffle(held)
        while held:
            call = held.pop()
            try:
                call.respond(echo_of(call.request))
            except SessionClosed:
                with self._lock:
                    self.refused += 1


async def test_a_thousand_answers_from_four_threads(
    session: Session, crowd: list[ClientProcess], name: str
) -> None:
    answerers = Answerers()
    with answerers.working():
        async with session.serve(ECHO, name, answerers.take) as server:
            for process in crowd:
                # Longer than two heartbeats of 3 s, by which the middleware repairs a loss.
                await process.start(name, 50, clients=5, in_flight=EACH, depth=1000, timeout=LIMIT)
            tallies = await asyncio.gather(*(process.result() for process in crowd))
            assert tallies == [Tally(answered=250)] * PROCESSES
            await settled(server)
            statistics = server.statistics()
            assert statistics.taken == statistics.responded == 1000
            assert answerers.refused == statistics.dropped == 0


@pytest.mark.parametrize("round_", rounds(1, soak=3))
async def test_the_server_closes_while_four_threads_answer(
    session: Session, crowd: list[ClientProcess], name: str, round_: int
) -> None:
    in_flight = PROCESSES * 5 * EACH
    answerers = Answerers()
    with answerers.working():
        server = session.serve(ECHO, name, answerers.take)
        for process in crowd:
            await join(process, name, answerers.seen, clients=5, in_flight=EACH)
        enough = server.statistics().responded + 5 * in_flight
        await until(lambda: server.statistics().responded > enough)
        await server.aclose()
    statistics = server.statistics()
    assert statistics.taken == statistics.responded + statistics.dropped
    assert answerers.refused == statistics.dropped
    for process in crowd:
        await process.give_up()
    tallies = await asyncio.gather(*(process.result() for process in crowd))
    assert sum(tally.wrong for tally in tallies) == 0
    # The middleware drops the responses that a destroyed writer has not delivered: at most as many
    # as the clients had in flight.
    answered = sum(tally.answered for tally in tallies)
    assert statistics.responded - in_flight <= answered <= statistics.responded


@pytest.mark.parametrize("times", [40, pytest.param(200, marks=pytest.mark.soak)])
async def test_closed_and_opened_again(
    session: Session, crowd: list[ClientProcess], times: int
) -> None:
    seen: set[str] = set()

    async def handler(call: AnyCall) -> Any:
        seen.add(caller_of(call.request))
        await asyncio.sleep(0)
        return echo_of(call.request)

    async def cycle(*, foreign: bool = False) -> None:
        async with session.serve(ECHO, "/reopened", handler):
            seen.clear()
            # The graph may still show the server of the last cycle, and the request go there.
            await ask(session, "/reopened", "own", timeout=LIMIT, retry=Retry(after=LIMIT / 4))
            await until(lambda: not foreign or seen > {"own"})

    for _ in range(20):
        await cycle()
    async with session.serve(ECHO, "/reopened", handler):
        for process in crowd:
            # One request at a time. More of them, repeated every 50 ms, are more than a server can
            # answer on a loaded machine: it drops what exceeds its backlog, the session's too.
            await join(process, "/reopened", seen, timeout=TICK)
    # Each process that is discovered takes descriptors.
    await until(lambda: all_discovered(session.node))
    before = count_threads(), count_descriptors()
    for number in range(times):
        await cycle(foreign=number % 20 == 0)
    assert count_threads() <= before[0]
    assert count_descriptors() <= before[1]
    for process in crowd:
        tally = await process.result()
        assert tally.wrong == 0
        assert tally.calls > 0
    assert session.statistics().servers == ()
    assert len([s for s in session.node.services if s.srv_name == "/reopened"]) == 0


async def test_100_calls_through_a_chain_of_servers(session: Session) -> None:
    def link(number: int) -> Any:
        async def handler(call: AnyCall) -> Any:
            return await session.call(ECHO, f"/link_{number + 1}", call.request)

        return handler

    servers = [session.serve(ECHO, f"/link_{number}", link(number)) for number in range(4)]
    servers.append(session.serve(ECHO, "/link_4", FORMS["plain, call"]))
    texts = [str(number) for number in range(100)]
    assert await asyncio.gather(*(ask(session, "/link_0", text) for text in texts)) == texts
    for server in servers:
        await settled(server)
        assert server.statistics().responded == 100
