"""Iterating over a server."""

from __future__ import annotations

import asyncio
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
    pass


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

    async def test_a_call_granted_to_a_cancelled_task_goes_to_the_next(
        self, session: Session
    ) -> None:
        server = session.serve(ECHO, "/served")
        victim = asyncio.create_task(anext(server))
        await asyncio.sleep(0)
        served = server._on_request
        done = asyncio.Event()

        def deliver(request: Any, header: Any) -> None:
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
