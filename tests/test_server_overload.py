"""Servers that get more requests than they can handle: order, log, statistics, hooks."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Any, Literal

import pytest

from rosasync import Limits, Session
from rosasync._server.backlog import INTERVAL, TARGET
from rosasync._server.handlers import LONG
from rosasync._server.overload import CALM
from tests.support.echo import ECHO
from tests.support.serving import AnyCall, Response, ask, echo_of, settled
from tests.support.times import until

if TYPE_CHECKING:
    from rosasync.testing import VirtualClock
    from tests.conftest import Bridge
    from tests.support.fake_graph import FakeGraph

MANY = Limits(in_flight=100, server_depth=None)
STANDING = TARGET + INTERVAL


class Queue:
    """A handler that runs one request for each `step`, and notes the order."""

    def __init__(self) -> None:
        self.order: list[str] = []
        self.steps = asyncio.Semaphore(0)

    async def __call__(self, call: AnyCall) -> Any:
        self.order.append(call.request.load_namespace)
        await self.steps.acquire()
        return echo_of(call.request)

    def finish(self) -> None:
        """Let every request run through."""
        for _ in range(1000):
            self.steps.release()


@pytest.mark.parametrize(
    ("order", "served"),
    [
        ("fair", ["a0", "b0", "a5", "a4", "a3", "a2", "a1"]),
        ("arrival", ["a0", "a1", "a2", "a3", "a4", "a5", "b0"]),
    ],
)
async def test_the_order(
    fake_graph: FakeGraph,
    virtual_clock: VirtualClock,
    order: Literal["fair", "arrival"],
    served: list[str],
) -> None:
    handler = Queue()
    async with fake_graph.session(limits=MANY) as a, fake_graph.session(limits=MANY) as b:
        server = a.serve(ECHO, "/served", handler, concurrency=1, order=order)
        tasks = [ask(a, "/served", f"a{number}", timeout=None) for number in range(6)]
        await until(lambda: server.statistics().taken == 6)
        tasks.append(ask(b, "/served", "b0", timeout=None))
        await until(lambda: server.statistics().taken == 7)
        await virtual_clock.advance(STANDING)
        handler.finish()
        await asyncio.gather(*tasks)
        assert handler.order == served


async def test_a_flood_of_one_process_does_not_delay_another(
    session: Session, bridge: Bridge
) -> None:
    """On the real middleware, where the header tells the clients apart."""
    handler = Queue()
    server = session.serve(ECHO, "/served", handler, concurrency=1)
    async with (
        Session("flood", bridge=bridge, limits=MANY) as flood,
        Session("polite", bridge=bridge) as polite,
    ):
        tasks = [ask(flood, "/served", f"flood {number}", timeout=None) for number in range(50)]
        await until(lambda: server.statistics().taken == 50)
        await until(lambda: server.statistics().oldest_age >= STANDING)
        answer = ask(polite, "/served", "polite", timeout=None)
        await until(lambda: server.statistics().taken == 51)
        assert server.statistics().overloaded
        handler.finish()
        assert await answer == "polite"
        await asyncio.gather(*tasks)
        assert handler.order[1] == "polite"


async def test_what_it_logs_and_counts(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, caplog: pytest.LogCaptureFixture
) -> None:
    handler = Queue()
    async with fake_graph.session(limits=MANY) as session:
        server = session.serve(ECHO, "/served", handler, concurrency=1, backlog=5)

        async def overload() -> None:
            tasks = [ask(session, "/served", str(number), timeout=1.0) for number in range(10)]
            await until(lambda: server.statistics().dropped % 4 == 0)
            await until(lambda: server.statistics().waiting == 5)
            statistics = server.statistics()
            assert statistics.overloaded
            await virtual_clock.advance(0.5)
            assert server.statistics().oldest_age == pytest.approx(0.5, abs=0.1)
            for _ in range(6):
                handler.steps.release()
            await settled(server)
            await asyncio.gather(*tasks, return_exceptions=True)

        await overload()
        statistics = server.statistics()
        assert (statistics.overloads, statistics.rejected, statistics.dropped) == (1, 4, 4)
        assert statistics.last_age == pytest.approx(0.5, abs=0.1)
        assert statistics.oldest_age == 0.0
        await virtual_clock.advance(2 * CALM)
        assert not server.statistics().overloaded
        begun, over = caplog.messages
        assert begun.startswith(
            "/served: overloaded, with 5 requests waiting, the oldest for 0.0 s"
        )
        assert "the newest request of each is served first" in begun
        assert over.startswith("/served: no longer overloaded, after 1.")
        assert over.endswith("s, with 4 requests dropped")
        handler.steps.release()
        await ask(session, "/served", "one that does not wait")
        assert server.statistics().last_age == 0.0
        await overload()
        assert server.statistics().overloads == 2


async def test_two_overloads_soon_after_each_other_are_one(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, caplog: pytest.LogCaptureFixture
) -> None:
    handler = Queue()
    handler.finish()
    async with fake_graph.session(limits=MANY) as session:
        server = session.serve(ECHO, "/served", handler, concurrency=1, backlog=1)
        for _ in range(3):
            await asyncio.gather(
                *(ask(session, "/served", str(number), timeout=0.1) for number in range(10)),
                return_exceptions=True,
            )
            await virtual_clock.advance(CALM / 2)
        assert server.statistics().overloads == 1
        assert len(caplog.messages) == 1


async def test_the_end_of_a_server_is_the_end_of_its_overload(
    fake_graph: FakeGraph, virtual_clock: VirtualClock, caplog: pytest.LogCaptureFixture
) -> None:
    handler = Queue()
    handler.finish()
    async with fake_graph.session(limits=MANY) as session:
        async with session.serve(ECHO, "/served", handler, concurrency=1, backlog=1):
            await asyncio.gather(
                *(ask(session, "/served", str(number), timeout=0.5) for number in range(10)),
                return_exceptions=True,
            )
        caplog.clear()
        await virtual_clock.advance(2 * CALM)
        assert caplog.messages == []


async def test_on_overload_answers_the_oldest(
    fake_graph: FakeGraph, virtual_clock: VirtualClock
) -> None:
    handler = Queue()
    async with fake_graph.session(limits=MANY) as session:
        session.serve(
            ECHO,
            "/served",
            handler,
            concurrency=1,
            backlog=2,
            on_overload=lambda call: {"message": f"busy: {call.request.load_namespace}"},
        )
        tasks = [ask(session, "/served", str(number)) for number in range(5)]
        assert await asyncio.gather(*tasks[1:3]) == ["busy: 1", "busy: 2"]
        handler.finish()
        assert await asyncio.gather(*tasks[:1], *tasks[3:]) == ["0", "3", "4"]


async def test_iterators_get_the_newest_too(
    fake_graph: FakeGraph, virtual_clock: VirtualClock
) -> None:
    async with fake_graph.session(limits=MANY) as session:
        server = session.serve(ECHO, "/served")
        tasks = [ask(session, "/served", str(number), timeout=None) for number in range(4)]
        await until(lambda: server.statistics().waiting == 4)
        await virtual_clock.advance(STANDING)
        order = []
        for _ in range(4):
            call = await anext(server)
            order.append(call.request.load_namespace)
            call.respond(Response(message=call.request.load_namespace))
        assert order == ["3", "2", "1", "0"]
        await asyncio.gather(*tasks)


async def test_plain_handlers_get_the_newest_too(fake_graph: FakeGraph) -> None:
    """They block the loop, so that requests wait in the middleware, which knows no turns."""
    order: list[str] = []

    def handler(call: AnyCall) -> Any:
        time.sleep(STANDING if not order else 2 * LONG)
        order.append(call.request.load_namespace)
        return echo_of(call.request)

    async with fake_graph.session(limits=MANY) as session:
        server = session.serve(ECHO, "/served", handler)
        tasks = [ask(session, "/served", str(number), timeout=None) for number in range(5)]
        await until(lambda: order)
        await server.aclose()
        assert order == ["0", "4", "3", "2", "1"]
        assert await asyncio.gather(*tasks) == ["0", "1", "2", "3", "4"]
