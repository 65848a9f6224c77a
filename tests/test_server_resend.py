"""Responses that the middleware cannot deliver, or not yet."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import (
    ServerGone,
    SessionClosed,
)
from tests.support.echo import ECHO
from tests.support.serving import (
    Holder,
    Response,
    ask,
    echo_of,
    fail_sends,
)
from tests.support.times import TICK, until

if TYPE_CHECKING:
    from rosasync.testing import FakeGraph


class TestFaults:
    """What the middleware may do to a response, with a port that does it on demand."""

    async def test_a_client_that_was_just_made_gets_its_answer_later(
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 2)
            tasks = [ask(session, "/held", str(number)) for number in range(2)]
            first, second = await holder.held(2)
            response = Response(message="first")
            first.respond(response)
            response.message = "changed"
            await asyncio.to_thread(second.respond, Response(message="second"))
            assert first.responded
            assert server.statistics().responded == 0
            assert server.statistics().unanswered == 2
            assert await asyncio.gather(*tasks) == ["first", "second"]
            assert server.statistics().responded == 2

    async def test_one_that_is_never_discovered(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync.service_call.RESEND", (0.0, TICK))
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 3)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)
            call.respond(Response())
            await until(lambda: server.statistics().undeliverable == 1)
            assert server.statistics().unanswered == server.statistics().responded == 0
            assert "reaches nobody" in caplog.text
            task.cancel()

    async def test_the_close_waits_for_the_next_attempt(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            async with session.serve(ECHO, "/held", holder) as server:
                fail_sends(server, 1)
                task = ask(session, "/held", "text")
                (call,) = await holder.held(1)
                call.respond(echo_of(call.request))
            assert server.statistics().responded == 1
            assert await task == "text"

    async def test_or_ends_it_after_the_deadline(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            fail_sends(server, 10)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            call.respond(echo_of(call.request))
            await server.aclose(0)
            assert server.statistics().dropped == 1
            assert server.statistics().unanswered == 0
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
        self, fake_graph: FakeGraph
    ) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            session.serve(ECHO, "/held", holder)
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            assert call.info.source_timestamp is None
            assert call.info.received_timestamp is None
            call.respond(echo_of(call.request))
            assert await task == "text"
