"""Iterating over a server."""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Any

import anyio
import pytest

from rosasync import (
    ServerGone,
    Session,
    UsageError,
)
from tests.support.echo import ECHO
from tests.support.serving import (
    ask,
    echo_call,
    echo_of,
)
from tests.support.times import TICK, until

if TYPE_CHECKING:
    from tests.support.fake_graph import FakeGraph


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

    @pytest.mark.parametrize("first", ["the call", "the cancellation"])
    async def test_a_cancelled_task_loses_no_call(self, session: Session, first: str) -> None:
        server = session.serve(ECHO, "/served")
        victim = asyncio.create_task(anext(server))
        await asyncio.sleep(0)
        served = server._on_request
        done = asyncio.Event()

        def deliver(request: Any, header: Any) -> None:
            if first == "the cancellation":
                victim.cancel()
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

    async def test_cancelled_tasks_give_their_calls_back_in_order(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served")
            victims = [asyncio.create_task(anext(server)) for _ in range(3)]
            await asyncio.sleep(0)
            tasks = [ask(session, "/served", str(number)) for number in range(5)]
            served, arrived = server._on_request, 0

            def deliver(request: Any, header: Any) -> None:
                nonlocal arrived
                served(request, header)
                arrived += 1
                if arrived == 5:
                    for victim in reversed(victims):
                        victim.cancel()

            server._port._deliver = deliver  # type: ignore[attr-defined]
            await asyncio.wait(victims)
            assert all(victim.cancelled() for victim in victims)
            for number in range(5):
                call = await anext(server)
                assert call.request.load_namespace == str(number)
                call.respond(echo_of(call.request))
            await asyncio.gather(*tasks)

    async def test_a_call_given_back_goes_to_an_iterator_that_waits(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served")
            victim, other = (asyncio.create_task(anext(server)) for _ in range(2))
            await asyncio.sleep(0)
            served = server._on_request

            def deliver(request: Any, header: Any) -> None:
                served(request, header)
                victim.cancel()

            server._port._deliver = deliver  # type: ignore[attr-defined]
            task = ask(session, "/served", "text")
            call = await other
            call.respond(echo_of(call.request))
            assert await task == "text"
            assert victim.cancelled()

    async def test_iterators_that_come_and_go_while_requests_arrive(self, session: Session) -> None:
        server = session.serve(ECHO, "/served")
        texts = [str(number) for number in range(200)]
        tasks = [ask(session, "/served", text) for text in texts]
        chance = random.Random(1)
        iterators: set[asyncio.Task[None]] = set()

        async def take_one() -> None:
            async for call in server:
                call.respond(echo_of(call.request))
                return

        while server.statistics().responded < len(texts):
            iterators.add(asyncio.create_task(take_one()))
            await asyncio.sleep(0)
            for iterator in tuple(iterators):
                if chance.random() < 0.5:
                    iterator.cancel()
            ended = {iterator for iterator in iterators if iterator.done()}
            iterators -= ended
            assert not [e for e in ended if not e.cancelled() and e.exception() is not None]
        assert await asyncio.gather(*tasks) == texts
        await server.aclose()
        for ending in await asyncio.gather(*iterators, return_exceptions=True):
            assert ending is None or isinstance(ending, asyncio.CancelledError)

    async def test_an_iterator_that_is_closed_gets_no_call(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served")
            closed = server.__anext__()
            closed.send(None)
            closed.close()
            task = ask(session, "/served", "text")
            call = await anext(server)
            call.respond(echo_of(call.request))
            assert await task == "text"

    async def test_a_call_for_a_cancelled_task_is_dropped_at_the_close(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served")
            victim = asyncio.create_task(anext(server))
            await asyncio.sleep(0)
            served = server._on_request
            closing: list[asyncio.Task[None]] = []

            def deliver(request: Any, header: Any) -> None:
                served(request, header)
                victim.cancel()
                closing.append(asyncio.create_task(server.aclose()))

            server._port._deliver = deliver  # type: ignore[attr-defined]
            task = ask(session, "/served", "text", timeout=None)
            await asyncio.wait([victim])
            assert victim.cancelled()
            await closing[0]
            assert server.statistics().dropped == 1
            assert [call async for call in server] == []
            assert server.statistics().unanswered == 0
            with pytest.raises(ServerGone):
                await task

    async def test_in_another_loop(self, session: Session) -> None:
        server = session.serve(ECHO, "/served")
        with pytest.raises(UsageError, match="in the loop that serves"):
            await asyncio.to_thread(asyncio.run, server.__anext__())

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
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        server = session.serve(ECHO, "/served")
        tasks = [ask(session, "/served", str(n)) for n in range(3)]
        await until(lambda: server.statistics().waiting == 3)
        await server.aclose()
        assert [call async for call in server] == []
        assert server.statistics().dropped == 3
        assert "closed with 3 requests waiting" in caplog.text
        for task in tasks:
            with pytest.raises(ServerGone):
                await task

    async def test_iterating_over_a_server_with_a_handler(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        with pytest.raises(UsageError, match="handler"):
            await anext(server)
