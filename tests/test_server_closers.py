"""Handlers that close their own server or session, and services that end under their server."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import ContextShutdown, Limits, ServerGone, Session, SessionClosed
from rosasync._core.ports import PortDestroyed
from tests.support.echo import ECHO
from tests.support.serving import (
    AnyCall,
    AnyServer,
    Holder,
    Response,
    UnmatchedClients,
    ask,
    discard,
    echo_call,
    echo_of,
)
from tests.support.times import LIMIT, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.fake_graph import FakeGraph

FACTORIES: dict[str, Any] = {"lazy": None}
if sys.version_info >= (3, 12):
    FACTORIES["eager"] = asyncio.eager_task_factory

Close = Callable[[AnyCall], Awaitable[object]]


async def in_this_task(closing: Awaitable[object]) -> None:
    await closing


async def in_a_task_of_its_own(closing: Awaitable[object]) -> None:
    await asyncio.gather(closing)


async def after_a_pause(closing: Awaitable[object]) -> None:
    """Suspend first: the server does not know an eager task before that."""
    await asyncio.sleep(0)
    await closing


WAYS = [in_this_task, in_a_task_of_its_own, after_a_pause]


@pytest.fixture(params=FACTORIES)
async def tasks(request: pytest.FixtureRequest) -> str:
    """How the loop starts tasks; eagerly too from Python 3.12 on."""
    kind: str = request.param
    asyncio.get_running_loop().set_task_factory(FACTORIES[kind])
    return kind


@pytest.mark.usefixtures("tasks")
class TestHandlersThatClose:
    """The server does not wait for them: without a timeout, the wait would never end."""

    @pytest.mark.parametrize("way", WAYS)
    async def test_their_server(
        self, session: Session, caplog: pytest.LogCaptureFixture, way: Any
    ) -> None:
        closed = asyncio.Event()

        async def handler(call: AnyCall) -> None:
            call.respond(echo_of(call.request))
            await way(call.server.aclose(None))
            closed.set()

        server = session.serve(ECHO, "/served", handler)
        assert await ask(session, "/served", "text") == "text"
        await asyncio.wait_for(closed.wait(), LIMIT)
        assert server.closed
        assert not warnings_of(caplog)

    @pytest.mark.parametrize("way", WAYS)
    async def test_their_session(
        self, bridge: Bridge, caplog: pytest.LogCaptureFixture, way: Any
    ) -> None:
        closed = asyncio.Event()
        async with (
            Session("client", bridge=bridge) as client,
            Session("closing", bridge=bridge) as session,
        ):

            async def handler(call: AnyCall) -> None:
                call.respond(echo_of(call.request))
                await way(session.aclose())
                closed.set()

            session.serve(ECHO, "/served", handler)
            assert await ask(client, "/served", "text") == "text"
            await asyncio.wait_for(closed.wait(), LIMIT)
        assert not warnings_of(caplog)

    async def test_their_session_while_another_handler_closes_it(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        closed: list[str] = []
        gate = asyncio.Event()
        async with fake_graph.session() as client, fake_graph.session() as session:

            async def handler(call: AnyCall) -> None:
                name = call.request.load_namespace
                call.respond(echo_of(call.request))
                if name == "second":
                    await gate.wait()
                await session.aclose()
                closed.append(name)

            server = session.serve(ECHO, "/served", handler)
            for name in ("second", "first"):
                assert await ask(client, "/served", name) == name
            await until(lambda: server.closed)
            gate.set()
            await until(lambda: len(closed) == 2)
        assert not warnings_of(caplog)

    async def test_from_a_hook(self, session: Session, caplog: pytest.LogCaptureFixture) -> None:
        closed = asyncio.Event()

        async def on_error(call: AnyCall, error: Exception) -> None:
            await call.server.aclose(None)
            closed.set()

        session.serve(ECHO, "/served", lambda call: 1 / 0, on_error=on_error)
        task = ask(session, "/served", "text")
        await asyncio.wait_for(closed.wait(), LIMIT)
        with pytest.raises(ServerGone):
            await task

    async def test_when_they_are_cancelled(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        closed = asyncio.Event()

        async def handler(call: AnyCall) -> None:
            try:
                await asyncio.Event().wait()
            finally:
                await call.server.aclose(None)
                closed.set()

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().running == 1)
        await server.aclose(0)
        await closed.wait()
        assert "left behind" not in caplog.text
        with pytest.raises(ServerGone):
            await task

    async def test_others_are_waited_for(self, session: Session) -> None:
        gate = asyncio.Event()

        async def handler(call: AnyCall) -> Any:
            if call.request.load_namespace == "closer":
                call.respond(echo_of(call.request))
                await call.server.aclose(None)
                return None
            await gate.wait()
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler)
        other = ask(session, "/served", "other")
        assert await ask(session, "/served", "closer") == "closer"
        await until(lambda: server.closed)
        gate.set()
        assert await other == "other"

    async def test_a_handler_that_ends_in_the_turn_it_starts_in(self, session: Session) -> None:
        async def handler(call: AnyCall) -> Any:
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler)
        assert await ask(session, "/served", "text") == "text"
        assert server.statistics().running == 0

    async def test_a_long_backlog_of_such(self, fake_graph: FakeGraph) -> None:
        """Eager tasks that start one another would exceed the recursion limit."""
        count = sys.getrecursionlimit()
        gate = asyncio.Event()

        async def handler(call: AnyCall) -> Any:
            if not gate.is_set():
                await gate.wait()
            return echo_of(call.request)

        async with fake_graph.session(limits=Limits(in_flight=count)) as session:
            server = session.serve(ECHO, "/served", handler, concurrency=1, backlog=count)
            tasks = [ask(session, "/served", str(number)) for number in range(count)]
            await until(lambda: server.statistics().waiting == count - 1)
            gate.set()
            assert await asyncio.gather(*tasks) == [str(number) for number in range(count)]
            assert server.statistics().responded == count


class TestDestroyedServices:
    """Something other than rosasync destroys the rclpy service."""

    async def test_the_server_ends(self, session: Session) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        task = ask(session, "/held", "text", timeout=None)
        (call,) = await holder.held(1)
        session.node.destroy_service(server.handle)
        await until(lambda: server.closed)
        with pytest.raises(ContextShutdown, match="/held: the rclpy service was destroyed"):
            call.respond(Response())
        with pytest.raises(ContextShutdown):
            await asyncio.to_thread(call.respond, Response())
        with pytest.raises(ContextShutdown):
            _ = server.handle
        assert session.statistics().servers == ()
        assert (server.statistics().dropped, server.statistics().unanswered) == (1, 0)
        await server.aclose()
        await discard(task)

    async def test_without_a_response_it_ends_too(self, session: Session) -> None:
        server = session.serve(ECHO, "/iterated")
        waiting = asyncio.create_task(anext(server))
        await asyncio.sleep(0)
        session.node.destroy_service(server.handle)
        with pytest.raises(ContextShutdown, match="/iterated"):
            await asyncio.wait_for(waiting, LIMIT)
        assert server.closed
        with pytest.raises(ContextShutdown):
            await anext(server)

    @pytest.mark.parametrize("thread", [False, True], ids=["loop", "thread"])
    async def test_a_response_finds_it_destroyed(self, fake_graph: FakeGraph, thread: bool) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)
            destroy(server)

            async def respond() -> None:
                call.respond(Response())

            responding = asyncio.to_thread(call.respond, Response()) if thread else respond()
            with pytest.raises(ContextShutdown, match="/held: the rclpy service was destroyed"):
                await responding
            await until(lambda: server.closed)
            assert (server.statistics().dropped, server.statistics().unanswered) == (1, 0)
            await discard(task)

    async def test_a_handler_whose_response_finds_it_destroyed_has_not_failed(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        async def handler(call: AnyCall) -> Any:
            destroy(server)
            return echo_of(call.request)

        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served", handler)
            task = ask(session, "/served", "text", timeout=None)
            await until(lambda: server.closed)
            assert server.statistics().failed == 0
            assert "outlasted the server" in caplog.text
            await discard(task)

    async def test_responses_that_wait_to_be_sent_again(self, fake_graph: FakeGraph) -> None:
        async with fake_graph.session() as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            UnmatchedClients(server)
            task = ask(session, "/held", "text", timeout=None)
            (call,) = await holder.held(1)
            call.respond(Response())
            destroy(server)
            await until(lambda: server.closed)
            assert (server.statistics().dropped, server.statistics().unanswered) == (1, 0)
            await discard(task)


class TestSiblings:
    """A failure of one part does not affect the others."""

    async def test_a_request_in_the_turn_of_the_close(self, fake_graph: FakeGraph) -> None:
        """The handler has not begun; it is cancelled and counted nevertheless."""
        begun: list[str] = []

        async def handler(call: AnyCall) -> Any:
            begun.append("handler")
            await asyncio.Event().wait()

        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served", handler)
            served = server._on_request

            def deliver(request: Any, header: Any) -> None:
                served(request, header)
                server.end(lambda: SessionClosed("ended"))

            server._port._deliver = deliver  # type: ignore[attr-defined]
            task = ask(session, "/served", "text", timeout=None)
            await until(lambda: server.closed and server.statistics().running == 0)
            assert begun == ["handler"]
            assert (server.statistics().dropped, server.statistics().unanswered) == (1, 0)
            await discard(task)

    async def test_an_owner_that_cannot_forget_the_server(
        self, fake_graph: FakeGraph, caplog: pytest.LogCaptureFixture
    ) -> None:
        async with fake_graph.session() as session:
            server = session.serve(ECHO, "/served", echo_call)

            def on_end(server: object) -> None:
                raise KeyError("unknown")

            on_end_of_session, server._on_end = server._on_end, on_end
            await server.aclose()
            assert "could not forget" in caplog.text
            on_end_of_session(server)

    @pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
    @pytest.mark.parametrize("asynchronous", [False, True], ids=["plain", "async"])
    def test_what_ends_the_program_gets_out(
        self, fake_graph: FakeGraph, error: type[BaseException], asynchronous: bool
    ) -> None:
        def handler(call: AnyCall) -> Any:
            raise error

        async def async_handler(call: AnyCall) -> Any:
            raise error

        async def main() -> None:
            async with fake_graph.session() as session:
                session.serve(ECHO, "/served", async_handler if asynchronous else handler)
                await ask(session, "/served", "text", timeout=None)

        with pytest.raises(error):
            asyncio.run(main())


def destroy(server: AnyServer) -> None:
    """Have the server's next response find that its service was destroyed."""

    def send(header: Any, response: Any) -> None:
        raise PortDestroyed

    server._port.send = send  # type: ignore[method-assign]


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the warnings that the library has logged."""
    return [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
