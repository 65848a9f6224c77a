"""What is logged at DEBUG: each call in one line, and what the pool does."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import Limits, ResponseTimeout, Retry, ServiceUnavailable, Session
from rosasync.testing import VirtualClock
from rosasync.tracing import CallTrace, _duration
from tests.support.echo import ECHO
from tests.support.fake_graph import FakeGraph
from tests.support.serving import Holder, ask, discard, echo_call, echo_of
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess

TIME = r"[\d.]+ m?s"


@pytest.fixture
def debug(caplog: pytest.LogCaptureFixture) -> Iterator[pytest.LogCaptureFixture]:
    """The log at DEBUG."""
    with caplog.at_level(logging.DEBUG, "rosasync"):
        yield caplog


@pytest.fixture
async def logged(debug: pytest.LogCaptureFixture, bridge: Bridge) -> AsyncIterator[Session]:
    """An open session that logs at DEBUG, on each bridge."""
    async with Session("logged", bridge=bridge, timeout=2 * LIMIT) as session:
        yield session


def has(log: pytest.LogCaptureFixture, pattern: str) -> bool:
    """Return whether the whole of a message matches, in which T stands for a time."""
    return count(log, pattern) > 0


def count(log: pytest.LogCaptureFixture, pattern: str) -> int:
    """Return how many messages match."""
    expected = re.compile(re.sub(r"\bT\b", lambda _: TIME, pattern))
    return sum(bool(expected.fullmatch(message)) for message in log.messages)


class TestCalls:
    async def test_waiting_and_queued(
        self, logged: Session, debug: pytest.LogCaptureFixture, server: ServerProcess
    ) -> None:
        tasks = [ask(logged, "/echo", str(number)) for number in range(2)]
        await until(lambda: logged.pool.statistics().waiting == 2)
        await server.serve("/echo")
        await asyncio.gather(*tasks)
        waited = r"#\d+ /echo: waited T for a server; queued T; answered after T"
        assert count(debug, waited) == 2
        await ask(logged, "/echo", "x")
        assert has(debug, r"#\d+ /echo: answered after T")

    async def test_failures(
        self, logged: Session, debug: pytest.LogCaptureFixture, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        await logged.wait_for_service(ECHO, "/silent")
        with pytest.raises(ResponseTimeout):
            await ask(logged, "/silent", "x", timeout=40 * TICK, retry=Retry(2, after=TICK))
        assert has(debug, r"#\d+ /silent: sent again after T")
        assert has(
            debug,
            r"#\d+ /silent: sent again after T; timed out after T: ResponseTimeout: /silent: .*",
        )
        with pytest.raises(ServiceUnavailable):
            await ask(logged, "/none", "x", timeout=TICK)
        assert has(
            debug,
            r"#\d+ /none: waited T for a server; timed out: ServiceUnavailable: /none: no server.*",
        )
        task = ask(logged, "/silent", "x")
        await asyncio.sleep(0)
        await discard(task)
        assert has(debug, r"#\d+ /silent: (queued T; cancelled|cancelled after T): CancelledError")

    async def test_requests(self, logged: Session, debug: pytest.LogCaptureFixture) -> None:
        holder = Holder()

        async def failing(call: Any) -> Any:
            raise ValueError("no")

        logged.serve(ECHO, "/served", echo_call)
        logged.serve(ECHO, "/held", holder)
        logged.serve(ECHO, "/failing", failing)
        tasks = [ask(logged, name, "x") for name in ("/served", "/held", "/failing")]
        (call,) = await holder.held(1)
        call.respond(echo_of(call.request))
        await asyncio.gather(*tasks[:2])
        await until(lambda: has(debug, r"#\d+ serving /served: answered after T"))
        await until(lambda: has(debug, r"#\d+ serving /held: deferred after T; answered after T"))
        await until(lambda: has(debug, r"#\d+ serving /failing: failed after T: ValueError: no"))
        await discard(*tasks)


class TestThePool:
    async def test_growth_discovery_and_the_end_of_a_server(
        self, logged: Session, debug: pytest.LogCaptureFixture, server: ServerProcess
    ) -> None:
        await server.serve("/echo")
        await ask(logged, "/echo", "x")
        assert has(debug, "/echo: created client 1")
        assert has(debug, "/echo: a client is matched with a server")
        await until(lambda: has(debug, "/echo: the graph shows 1 server"))
        await server.stop("/echo")
        await until(lambda: has(debug, "/echo: the graph shows 0 servers"))

    async def test_eviction(
        self, debug: pytest.LogCaptureFixture, fake_graph: FakeGraph, virtual_clock: VirtualClock
    ) -> None:
        fake_graph.serve(ECHO, "/echo", echo_of)
        async with fake_graph.session(limits=Limits(idle=10.0)) as session:
            await ask(session, "/echo", "x")
            await virtual_clock.advance(11.0)
        assert has(debug, "/echo: destroyed a client that was idle for 10 s, 0 left")


class TestTheLevel:
    async def test_without_a_listener_no_trace_is_made(
        self, session: Session, echo: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        traces: list[CallTrace] = []
        init = CallTrace.__init__

        def keep(self: CallTrace, *args: Any) -> None:
            traces.append(self)
            init(self, *args)

        monkeypatch.setattr(CallTrace, "__init__", keep)
        session.serve(ECHO, "/served", echo_call)
        for name in (echo, "/served"):
            await ask(session, name, "x")
        assert not traces
        monkeypatch.setattr("rosasync.tracing.RECHECK_NS", 0)
        logging.getLogger("rosasync").setLevel(logging.DEBUG)
        try:
            async with asyncio.timeout(LIMIT):
                while not traces:
                    await ask(session, echo, "x")
        finally:
            logging.getLogger("rosasync").setLevel(logging.NOTSET)

    async def test_a_change_of_the_level_is_noticed(
        self, session: Session, echo: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        await ask(session, echo, "x")
        with caplog.at_level(logging.DEBUG, "rosasync"):
            async with asyncio.timeout(LIMIT):
                while not has(caplog, r"#\d+ /echo: answered after T"):
                    await ask(session, echo, "x")
        caplog.clear()
        await ask(session, echo, "x")
        assert not caplog.messages


@pytest.mark.parametrize(
    ("nanoseconds", "text"),
    [
        (0, "0.001 ms"),
        (51_400, "0.051 ms"),
        (213_000, "0.21 ms"),
        (9_960_000, "10 ms"),
        (99_400_000, "99 ms"),
        (99_600_000, "100 ms"),
        (999_400_000, "999 ms"),
        (999_600_000, "1 s"),
        (1_849_000_000, "1.85 s"),
        (999_600_000_000, "1000 s"),
        (86_400_000_000_000, "86400 s"),
    ],
)
def test_how_a_duration_is_written(nanoseconds: int, text: str) -> None:
    assert _duration(nanoseconds) == text
