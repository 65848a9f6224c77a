"""Servers that end: closed, with the session, with the context, with the service."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.qos import QoSProfile
from rclpy.service import Service
from std_srvs.srv import Trigger

from rosasync import (
    ContextShutdown,
    ServerGone,
    ServerStatistics,
    ServiceServer,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync._client import matching
from rosasync._core.ports import PortDestroyed
from rosasync._ros.profile import HEARTBEAT, STOCK_HEARTBEAT, SWITCH
from tests.support.checks import count_threads
from tests.support.echo import ECHO
from tests.support.serving import (
    AnyCall,
    Gate,
    Holder,
    Response,
    ask,
    echo_call,
    echo_of,
)
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.clients import ClientProcess


class TestClose:
    async def test_handlers_finish(self, session: Session) -> None:
        gate = Gate()

        server = session.serve(ECHO, "/served", gate, concurrency=2)
        tasks = [ask(session, "/served", str(n)) for n in range(5)]
        await until(lambda: server.statistics().taken == 5)
        closing = [asyncio.create_task(server.aclose()) for _ in range(2)]
        await asyncio.sleep(TICK)
        assert server.closed
        assert not closing[0].done()
        gate.set()
        assert await asyncio.gather(*tasks) == [str(n) for n in range(5)]
        await asyncio.gather(*closing)
        await server.aclose()
        assert server.statistics().responded == 5
        assert session.statistics().servers == ()

    async def test_all_answers_arrive_that_were_sent_before_the_end(
        self, session: Session, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The last ones were lost if the executor's thread was too busy to take them at once."""
        # Far longer than each of them takes, also on a busy machine, and far shorter than all five.
        monkeypatch.setattr(matching, "GONE_DELAY", 10 * TICK)
        gate = Gate()

        server = session.serve(ECHO, "/served", gate, concurrency=5)
        tasks = [ask(session, "/served", str(n)) for n in range(5)]
        await until(lambda: server.statistics().taken == 5)
        session.node.create_timer(TICK / 50, lambda: time.sleep(4 * TICK))
        gate.set()
        await server.aclose()
        assert await asyncio.gather(*tasks) == [str(n) for n in range(5)]

    async def test_the_rest_is_cancelled_after_the_deadline(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        cancelled: list[str] = []

        async def handler(call: AnyCall) -> Any:
            try:
                await asyncio.Event().wait()
            except asyncio.CancelledError:
                cancelled.append(call.request.load_namespace)
                raise

        server = session.serve(ECHO, "/served", handler, concurrency=2)
        tasks = [ask(session, "/served", str(n)) for n in range(3)]
        await until(lambda: server.statistics().taken == 3)
        await server.aclose(2 * TICK)
        assert sorted(cancelled) == ["0", "1"]
        assert server.statistics().dropped == 3
        for task in tasks:
            with pytest.raises(ServerGone):
                await task
        assert sum("was cancelled" in message for message in caplog.messages) == 2
        assert sum("1 request waiting" in message for message in caplog.messages) == 1

    async def test_no_request_is_taken_meanwhile(self, session: Session) -> None:
        gate = Gate()

        server = session.serve(ECHO, "/served", gate)
        task = ask(session, "/served", "first")
        await until(lambda: server.statistics().taken == 1)
        closing = asyncio.create_task(server.aclose())
        await asyncio.sleep(0)
        late = ask(session, "/served", "late")
        await asyncio.sleep(TICK)
        assert server.statistics().taken == 1
        gate.set()
        assert await task == "first"
        await closing
        with pytest.raises(ServerGone):
            await late

    async def test_a_handler_that_closes_its_server(self, session: Session) -> None:
        closed = asyncio.Event()

        async def handler(call: AnyCall) -> None:
            call.respond(echo_of(call.request))
            await call.server.aclose(None)
            closed.set()

        session.serve(ECHO, "/served", handler)
        assert await ask(session, "/served", "text") == "text"
        await asyncio.wait_for(closed.wait(), LIMIT)

    async def test_a_handler_that_ignores_its_cancellation(
        self, session: Session, caplog: pytest.LogCaptureFixture, monkeypatch: Any
    ) -> None:
        monkeypatch.setattr("rosasync._server.server.CANCEL_TIMEOUT", TICK)
        gate = asyncio.Event()
        ended: list[object] = []

        async def handler(call: AnyCall) -> Any:
            while not gate.is_set():
                try:
                    await gate.wait()
                except asyncio.CancelledError:
                    continue
            try:
                call.respond(echo_of(call.request))
            except SessionClosed as error:
                ended.append(error)
                raise

        server = session.serve(ECHO, "/served", handler)
        task = ask(session, "/served", "text")
        await until(lambda: server.statistics().running == 1)
        await server.aclose(0)
        assert "1 handlers still run although they were cancelled" in caplog.text
        gate.set()
        await until(lambda: server.statistics().running == 0)
        assert len(ended) == 1
        assert server.statistics().failed == 0
        with pytest.raises(ServerGone):
            await task

    async def test_what_it_tells_afterwards(self, session: Session) -> None:
        async with session.serve(Trigger, "served", lambda call: call.response) as server:
            assert isinstance(server, ServiceServer)
            assert isinstance(server.handle, Service)
            assert not server.closed
            assert server.qos.depth == 1000
        assert server.closed
        assert server.srv_name == "/served"
        assert server.srv_type == "std_srvs/srv/Trigger"
        assert isinstance(server.qos, QoSProfile)
        assert server.qos.depth == 1000
        assert repr(server) == "<ServiceServer /served [std_srvs/srv/Trigger] closed>"
        assert server.statistics() == ServerStatistics("/served")
        with pytest.raises(SessionClosed):
            _ = server.handle

    async def test_its_qos(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call, qos=QoSProfile(depth=7))
        assert server.qos.depth == 7

    async def test_from_elsewhere(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        with pytest.raises(UsageError):
            await asyncio.to_thread(asyncio.run, server.aclose())
        assert not server.closed

    async def test_its_end_waits_for_a_send_under_way(self, session: Session) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        port = server._port
        send, close = port.send, port.close
        sending, go_on = threading.Event(), threading.Event()
        order: list[str] = []

        def slow_send(header: Any, response: Any) -> None:
            sending.set()
            assert go_on.wait(LIMIT)
            order.append("sent")
            send(header, response)

        def noted_close() -> None:
            order.append("closed")
            close()

        port.send, port.close = slow_send, noted_close  # type: ignore[method-assign]
        sender = asyncio.create_task(asyncio.to_thread(call.respond, echo_of(call.request)))
        await asyncio.to_thread(sending.wait, LIMIT)

        def release() -> None:
            deadline = time.monotonic() + LIMIT
            while server._sender.ending is None and time.monotonic() < deadline:
                time.sleep(TICK / 10)
            order.append("closing")
            go_on.set()

        releaser = threading.Thread(target=release)
        releaser.start()
        await server.aclose()
        releaser.join()
        await sender
        assert order == ["closing", "sent", "closed"]
        assert await task == "text"

    async def test_with_the_session_its_handlers_may_still_call(self, bridge: Bridge) -> None:
        async with Session("client", bridge=bridge) as client:
            async with Session("closing", bridge=bridge) as session:
                gate = asyncio.Event()

                async def handler(call: AnyCall) -> Any:
                    await gate.wait()
                    return await session.call(ECHO, "/elsewhere", call.request)

                client.serve(ECHO, "/elsewhere", echo_call)
                server = session.serve(ECHO, "/served", handler)
                task = ask(client, "/served", "text")
                await until(lambda: server.statistics().running == 1)
                closing = asyncio.create_task(session.aclose())
                await asyncio.sleep(0)
                with pytest.raises(SessionClosed):
                    session.serve(ECHO, "/late", echo_call)
                gate.set()
                assert await task == "text"
                await closing
            assert server.closed

    async def test_with_the_context(self, bridge: Bridge) -> None:
        async with Session("doomed", bridge=bridge) as session:
            holder = Holder()
            server = session.serve(ECHO, "/held", holder)
            iterated = session.serve(ECHO, "/iterated")
            waiting = asyncio.create_task(anext(iterated))
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
            await asyncio.to_thread(session.node.context.try_shutdown)
            with pytest.raises(ContextShutdown):
                await task
            with pytest.raises(ContextShutdown):
                await asyncio.wait_for(waiting, LIMIT)
            await until(lambda: server.closed)
            with pytest.raises(ContextShutdown):
                call.respond(Response())
            with pytest.raises(ContextShutdown):
                session.serve(ECHO, "/late", echo_call)
            await server.aclose()

    async def test_with_a_session_that_is_dropped(self, bridge: Bridge) -> None:
        session = Session("dropped", bridge=bridge)
        await session.__aenter__()
        server = session.serve(ECHO, "/served", echo_call)
        assert await ask(session, "/served", "text") == "text"
        sessions = [session]
        del session
        with pytest.warns(ResourceWarning, match="unclosed"):
            sessions.clear()
        await until(lambda: server.closed)
        assert server.statistics().responded == 1

    async def test_with_a_session_that_is_dropped_if_the_warning_is_an_error(
        self, bridge: Bridge, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """As pytest's ``filterwarnings = error`` makes it."""
        raised: list[Any] = []
        monkeypatch.setattr("sys.unraisablehook", lambda hook: raised.append(hook.exc_type))
        # The middleware starts some threads once, and keeps them.
        async with Session("first", bridge=bridge) as first:
            first.serve(ECHO, "/served", echo_call)
            assert await ask(first, "/served", "text") == "text"
        before = count_threads()
        session = Session("dropped", bridge=bridge)
        await session.__aenter__()
        server = session.serve(ECHO, "/served", echo_call)
        sessions = [session]
        del session
        sessions.clear()
        assert raised == [ResourceWarning]
        await until(lambda: server.closed)
        await until(lambda: count_threads() <= before)


class TestLastResponses:
    @pytest.mark.parametrize(("delivery", "repair"), [(LIMIT, None), (0.0, LIMIT)])
    async def test_the_end_waits_until_they_are_received(
        self,
        session: Session,
        monkeypatch: pytest.MonkeyPatch,
        delivery: float,
        repair: float | None,
    ) -> None:
        """Also if they were lost, and have to be repaired."""
        monkeypatch.setattr("rosasync._server.sending.DELIVERY_TIME", delivery)
        server = session.serve(ECHO, "/served", echo_call)
        received = asyncio.Event()
        monkeypatch.setattr(server._port, "delivered", received.is_set)
        if repair is not None:
            monkeypatch.setattr(server._port, "repair_time", repair)
        assert await ask(session, "/served", "text") == "text"
        closing = asyncio.create_task(server.aclose(None))
        await asyncio.sleep(2 * TICK)
        assert not closing.done()
        received.set()
        await closing

    async def test_a_repair_takes_a_heartbeat_of_the_service(
        self, session: Session, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        served = session.serve(ECHO, "/served", echo_call)
        assert served._port.repair_time == HEARTBEAT
        monkeypatch.setenv(SWITCH, "off")
        other = session.serve(ECHO, "/other", echo_call)
        assert other._port.repair_time == STOCK_HEARTBEAT

    async def test_the_deadline_ends_the_wait(
        self, session: Session, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync._server.sending.DELIVERY_TIME", 10 * LIMIT)
        server = session.serve(ECHO, "/served", echo_call)
        monkeypatch.setattr(server._port, "delivered", lambda: False)
        assert await ask(session, "/served", "text") == "text"
        await asyncio.wait_for(server.aclose(TICK), LIMIT)

    async def test_no_wait_for_old_ones(
        self, session: Session, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync._server.sending.DELIVERY_TIME", TICK)
        server = session.serve(ECHO, "/served", echo_call)
        monkeypatch.setattr(server._port, "delivered", lambda: pytest.fail("asked"))
        assert await ask(session, "/served", "text") == "text"
        await asyncio.sleep(2 * TICK)
        await server.aclose()

    async def test_no_wait_if_no_client_is_left(
        self, session: Session, bridge: Bridge, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync._server.sending.DELIVERY_TIME", 10 * LIMIT)
        server = session.serve(ECHO, "/served", echo_call)
        monkeypatch.setattr(server._port, "delivered", lambda: False)
        async with Session("leaving", bridge=bridge) as client:
            assert await ask(client, "/served", "text") == "text"
        await asyncio.wait_for(server.aclose(None), LIMIT)

    async def test_the_middleware_tells_when_they_are_received(
        self, session: Session, client_process: ClientProcess
    ) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        assert (await client_process.run("/served", 10)).answered == 10
        await until(server._port.delivered)

    async def test_nothing_is_asked_of_a_destroyed_service(self, session: Session) -> None:
        server = session.serve(ECHO, "/served", echo_call)
        session.node.destroy_service(server.handle)
        with pytest.raises(PortDestroyed):
            server._port.delivered()

    async def test_a_session_that_answers_and_ends(
        self, bridge: Bridge, client_process: ClientProcess, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync._server.sending.DELIVERY_TIME", LIMIT)
        for _ in range(3):
            async with Session("answering", bridge=bridge) as session:
                holder = Holder()
                session.serve(ECHO, "/served", holder)
                await client_process.start("/served", 1, clients=10)
                for call in await holder.held(10):
                    call.respond(echo_of(call.request))
            assert (await client_process.result()).answered == 10
