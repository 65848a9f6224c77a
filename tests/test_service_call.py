"""ServiceCall: its attributes, and responding at once, later, or not at all."""

from __future__ import annotations

import asyncio
import gc
import time
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any

import pytest
from std_srvs.srv import SetBool

from rosasync import (
    ResponseTimeout,
    ServerGone,
    Session,
    SessionClosed,
    UsageError,
)
from tests.support.clients import ClientProcess
from tests.support.echo import ECHO
from tests.support.serving import (
    AnyCall,
    Holder,
    Response,
    ask,
    discard,
    echo_of,
)
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    pass


@pytest.fixture
async def holder(session: Session) -> AsyncIterator[Holder]:
    """A server ``/held`` that keeps its calls."""
    holder = Holder()
    async with session.serve(ECHO, "/held", holder):
        yield holder


class TestCall:
    async def test_what_it_tells(self, session: Session) -> None:
        calls: list[AnyCall] = []

        def handler(call: AnyCall) -> Any:
            calls.append(call)
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler)
        before = time.time_ns()
        for number in range(3):
            await ask(session, "/served", str(number))
        infos = [call.info for call in calls]
        first = infos[0].sequence_number
        assert [info.sequence_number for info in infos] == [first, first + 1, first + 2]
        for info in infos:
            assert info.source_timestamp is not None
            assert info.received_timestamp is not None
            assert before <= info.source_timestamp <= info.received_timestamp <= time.time_ns()
        call = calls[0]
        assert call.server is server
        assert call.request.load_namespace == "0"
        assert call.responded
        assert call.response is call.response
        assert isinstance(call.response, Response)
        assert repr(call) == f"<ServiceCall /served #{first} answered>"

    async def test_answered_later_and_in_another_order(
        self, session: Session, holder: Holder
    ) -> None:
        tasks = [ask(session, "/held", str(number)) for number in range(5)]
        calls = await holder.held(5)
        assert not any(call.responded for call in calls)
        for call in reversed(calls):
            call.respond(echo_of(call.request))
            assert call.responded
        assert await asyncio.gather(*tasks) == [str(number) for number in range(5)]
        (statistics,) = session.statistics().servers
        assert statistics.deferred == statistics.taken == statistics.responded == 5
        assert statistics.unanswered == 0

    async def test_answered_from_another_thread(self, session: Session, holder: Holder) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        await asyncio.to_thread(call.respond, echo_of(call.request))
        assert await task == "text"

    async def test_the_message_may_be_changed_afterwards(
        self, session: Session, holder: Holder
    ) -> None:
        tasks = [ask(session, "/held", str(number)) for number in range(3)]
        response = Response()
        for number, call in enumerate(await holder.held(3)):
            response.message = f"answer {number}"
            call.respond(response)
            response.message = "changed"
        assert sorted(await asyncio.gather(*tasks)) == [f"answer {n}" for n in range(3)]

    async def test_twice(self, session: Session, holder: Holder) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        call.respond(echo_of(call.request))
        with pytest.raises(UsageError, match="/held: this call was answered"):
            call.respond(Response(message="second"))
        assert await task == "text"
        (statistics,) = session.statistics().servers
        assert statistics.responded == 1

    @pytest.mark.parametrize("wrong", [None, "text", [("message", "text")], SetBool.Response()])
    async def test_of_the_wrong_type(self, session: Session, holder: Holder, wrong: Any) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        with pytest.raises(
            TypeError, match=r"is a diagnostic_msgs\.srv\.AddDiagnostics_Response, or"
        ):
            call.respond(wrong)
        assert not call.responded
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_one_that_cannot_be_converted_may_be_mended(
        self, session: Session, holder: Holder
    ) -> None:
        task = ask(session, "/held", "text")
        (call,) = await holder.held(1)
        with pytest.raises(ValueError, match="^message: cannot be encoded"):
            call.respond(Response(message="\ud800"))
        assert not call.responded
        call.respond(echo_of(call.request))
        assert await task == "text"

    async def test_after_the_close(self, session: Session) -> None:
        holder = Holder()
        async with session.serve(ECHO, "/held", holder) as server:
            task = ask(session, "/held", "text")
            (call,) = await holder.held(1)
        with pytest.raises(SessionClosed, match="/held"):
            call.respond(Response())
        with pytest.raises(SessionClosed):
            await asyncio.to_thread(call.respond, Response())
        with pytest.raises(ServerGone):
            await task
        assert server.statistics().dropped == 1
        assert server.statistics().unanswered == 0

    async def test_dropped_unanswered(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        server = session.serve(ECHO, "/mute", lambda call: None)
        await session.wait_for_service(ECHO, "/mute", timeout=LIMIT)

        async def call(dropped: int) -> None:
            with pytest.raises(ResponseTimeout):
                await ask(session, "/mute", "text", timeout=2 * TICK)
            await until(lambda: server.statistics().dropped == dropped)

        with pytest.warns(ResourceWarning, match="/mute: a call was dropped unanswered"):
            await call(1)
        statistics = server.statistics()
        assert (statistics.taken, statistics.deferred, statistics.dropped) == (1, 1, 1)
        assert statistics.unanswered == statistics.responded == 0
        with pytest.warns(ResourceWarning, match="/mute"):
            await call(2)
        said = [r for r in caplog.records if "a call was dropped unanswered" in r.getMessage()]
        assert len(said) == 1, "it is said once for each server"

    async def test_dropped_unanswered_in_another_thread(
        self, session: Session, holder: Holder
    ) -> None:
        task = ask(session, "/held", "text", timeout=LIMIT)
        await holder.held(1)

        def drop() -> None:
            with pytest.warns(ResourceWarning, match="/held"):
                holder.calls.clear()

        await asyncio.to_thread(drop)
        await until(lambda: session.statistics().servers[0].dropped == 1)
        await discard(task)

    async def test_dropped_after_the_close_is_no_mistake(self, session: Session) -> None:
        holder = Holder()
        async with session.serve(ECHO, "/held", holder):
            task = ask(session, "/held", "text")
            await holder.held(1)
        holder.calls.clear()
        gc.collect()
        with pytest.raises(ServerGone):
            await task

    async def test_given_up(self, session: Session, holder: Holder) -> None:
        task = ask(session, "/held", "text", timeout=None)
        (call,) = await holder.held(1)
        assert not call.settled
        assert call.give_up("dropped: of no interest")
        assert not call.give_up("dropped: again")
        assert call.settled
        assert not call.responded
        with pytest.raises(UsageError, match="this call was dropped: of no interest"):
            call.respond(Response())
        (statistics,) = session.statistics().servers
        assert (statistics.dropped, statistics.unanswered) == (1, 0)
        await discard(task)


class TestClients:
    async def test_the_same_sequence_numbers(self, session: Session) -> None:
        holder = Holder()
        session.serve(ECHO, "/held", holder)
        async with ClientProcess() as one, ClientProcess() as two:
            for process, tag in ((one, "one"), (two, "two")):
                await process.start("/held", 10, in_flight=10, depth=1000, tag=tag)
            calls = await holder.held(20)
            numbers = sorted(call.info.sequence_number for call in calls)
            assert numbers == sorted([*range(1, 11), *range(1, 11)])
            for call in reversed(calls):
                call.respond(echo_of(call.request))
            for process in (one, two):
                tally = await process.result()
                assert (tally.answered, tally.wrong, tally.lost) == (10, 0, 0)

    async def test_one_that_has_gone(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        async with ClientProcess() as process:
            await process.start("/held", 3, in_flight=3, timeout=LIMIT)
            calls = await holder.held(3)
            await asyncio.to_thread(process.kill)
        assert session.bridge in ("direct", "executor")
        calls[0].respond(echo_of(calls[0].request))
        # If its reader was never discovered, the response is sent again for a while.
        await until(
            lambda: server.statistics().responded + server.statistics().undeliverable == 1,
            3 * LIMIT,
        )
        assert await self.answered(session, holder) == "still serving"

    async def answered(self, session: Session, holder: Holder) -> str:
        task = ask(session, "/held", "still serving")
        call = (await holder.held(len(holder.calls) + 1))[-1]
        call.respond(echo_of(call.request))
        return await task

    async def test_the_last_one_has_gone(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        server = session.serve(ECHO, "/held", holder)
        async with ClientProcess() as process:
            await process.start("/held", 1)
            (call,) = await holder.held(1)
            await process.give_up()
            assert (await process.result()).lost == 1
        await until(lambda: not server._port.has_clients())
        call.respond(echo_of(call.request))
        assert server.statistics().undeliverable == 1
        assert server.statistics().responded == 0
        assert "cannot be delivered: the service has no client any more" in caplog.text
        assert call.responded
