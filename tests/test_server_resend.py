"""Responses that the middleware cannot deliver, or not yet."""

from __future__ import annotations

import asyncio
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import (
    Limits,
    ServerGone,
    SessionClosed,
)
from tests.support.echo import ECHO
from tests.support.serving import (
    Holder,
    Response,
    UnmatchedClients,
    ask,
    discard,
    echo_of,
)
from tests.support.times import TICK, until

if TYPE_CHECKING:
    from tests.support.fake_graph import FakeGraph


class TestFaults:
    """What the middleware may do to a response, with a port that does it on demand."""

    async def test_a_client_that_was_just_made_gets_its_answer_later(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            clients = UnmatchedClients(server)
            tasks = [ask(session, "/held", str(number)) for number in range(2)]
            first, second = await holder.held(2)
            response = Response(message="first")
            first.respond(response)
            response.message = "changed"
            await asyncio.to_thread(second.respond, Response(message="second"))
            assert first.responded
            assert server.statistics().responded == 0
            assert server.statistics().unanswered == 2
            clients.unmatched = False
            assert await asyncio.gather(*tasks) == ["first", "second"]
            assert server.statistics().responded == 2

    async def test_one_that_is_never_discovered(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync._server.resending.RESEND", (0.0, TICK))
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            clients = UnmatchedClients(server)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)
            call.respond(Response())
            await until(lambda: server.statistics().undeliverable == 1)
            assert server.statistics().unanswered == server.statistics().responded == 0
            assert clients.attempts == 3
            assert "cannot be delivered: its client was not discovered in time" in caplog.text
            await discard(task)

    async def test_the_close_waits_for_the_next_attempt(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            async with session.serve(ECHO, "/held", holder) as server:
                clients = UnmatchedClients(server)
                task = ask(session, "/held", "text")
                (call,) = await holder.held(1)
                call.respond(echo_of(call.request))
                closing = asyncio.create_task(server.aclose())
                await until(lambda: server.closed)
                clients.unmatched = False
                await closing
            assert server.statistics().responded == 1
            assert await task == "text"

    async def test_or_ends_it_after_the_deadline(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            UnmatchedClients(server)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            call.respond(echo_of(call.request))
            await server.aclose(0)
            assert server.statistics().undeliverable == 1
            assert server.statistics().unanswered == server.statistics().dropped == 0
            assert "#1 cannot be delivered: the server closes" in caplog.text
            with pytest.raises(ServerGone):
                await task

    async def test_a_client_that_is_closed(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
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
        self, fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(time, "time_ns", lambda: 0)
        async with fake_graph.session() as session:
            holder = Holder()
            session.serve(ECHO, "/held", holder)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            assert call.info.source_timestamp is None
            assert call.info.received_timestamp is None
            call.respond(echo_of(call.request))
            assert await task == "text"

    async def test_one_task_sends_everything_again(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session(limits=Limits(in_flight=200)) as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            clients = UnmatchedClients(server)
            tasks = [ask(session, "/held", str(number)) for number in range(200)]
            calls = await holder.held(200)
            before = len(asyncio.all_tasks())
            for call in calls:
                call.respond(echo_of(call.request))
            assert len(asyncio.all_tasks()) == before + 1
            await until(lambda: clients.attempts > 200)
            clients.unmatched = False
            assert await asyncio.gather(*tasks) == [str(number) for number in range(200)]
            assert server.statistics().responded == 200

    async def test_no_more_than_the_limit_wait(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync._server.resending.MAX_UNSENT", 5)
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            clients = UnmatchedClients(server)
            tasks = [ask(session, "/held", str(number), timeout=None) for number in range(8)]
            for call in list(await holder.held(8)):
                call.respond(echo_of(call.request))
            assert server.statistics().undeliverable == 3
            assert "5 later ones wait to be sent again" in caplog.text
            clients.unmatched = False
            assert await asyncio.gather(*tasks[3:]) == ["3", "4", "5", "6", "7"]
            assert server.statistics().unanswered == 0
            await discard(*tasks[:3])

    async def test_a_response_that_fails_for_another_reason_ends_only_itself(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            clients = UnmatchedClients(server)
            tasks = [ask(session, "/held", str(number), timeout=None) for number in range(2)]
            calls = await holder.held(2)
            for call in calls:
                call.respond(echo_of(call.request))
            send = clients._send

            def fail_first(header: Any, response: Any) -> None:
                if response.message == "0":
                    raise OSError("broken")
                send(header, response)

            clients._send = fail_first
            clients.unmatched = False
            assert await tasks[1] == "1"
            assert server.statistics().undeliverable == 1
            assert "broken" in caplog.text
            await discard(tasks[0])

    async def test_a_loop_that_is_closed(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        """A thread may respond later than the loop lives; its response is counted."""
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            UnmatchedClients(server)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)

            def closed(*args: object) -> None:
                raise RuntimeError("Event loop is closed")

            loop = SimpleNamespace(call_soon_threadsafe=closed)
            server._sender._loop = loop  # type: ignore[assignment]
            await asyncio.to_thread(call.respond, Response())
            assert server.statistics().undeliverable == 1
            assert "the event loop is closed" in caplog.text
            await discard(task)
