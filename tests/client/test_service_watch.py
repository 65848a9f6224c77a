"""Watching the servers of a service: up, gone, replaced."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import TYPE_CHECKING, Any

import pytest

from rosasync import InvalidServiceName, ServiceState, Session, SessionClosed
from tests.support.echo import ECHO
from tests.support.fake_graph import FakeGraph
from tests.support.plain import Echo, echo
from tests.support.times import LIMIT

if TYPE_CHECKING:
    from tests.support.servers import ServerProcess


async def following(states: AsyncIterator[ServiceState]) -> ServiceState:
    """Return the next state."""
    async with asyncio.timeout(LIMIT):
        return await anext(states)


async def test_servers_that_come_go_and_are_replaced(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        states = session.watch_service(Echo, "/echo")
        assert await following(states) == ServiceState("gone", ())
        first = fake_graph.serve(Echo, "/echo", echo)
        assert await following(states) == ServiceState("up", ("/server_1",))
        second = fake_graph.serve(Echo, "/echo", echo)
        assert await following(states) == ServiceState("up", ("/server_1", "/server_2"))
        first.close()
        assert (await following(states)).status == "up"
        # Within one turn of the loop, as a server that is restarted while the loop is blocked.
        second.close()
        third = fake_graph.serve(Echo, "/echo", echo)
        assert await following(states) == ServiceState("replaced", ("/server_1",))
        third.close()
        assert await following(states) == ServiceState("gone", ())


async def test_other_changes_of_the_graph_are_no_news(fake_graph: FakeGraph) -> None:
    async with fake_graph.session() as session:
        states = session.watch_service(Echo, "/echo")
        await following(states)
        waiting = asyncio.ensure_future(following(states))
        fake_graph.serve(Echo, "/another", echo)
        for _ in range(3):
            await asyncio.sleep(0)
        assert not waiting.done()
        fake_graph.serve(Echo, "/echo", echo)
        assert (await waiting).status == "up"


async def test_it_ends_with_the_session(fake_graph: FakeGraph) -> None:
    session = await fake_graph.session().open()
    states = session.watch_service(Echo, "/echo")
    await following(states)
    waiting = asyncio.ensure_future(following(states))
    await asyncio.sleep(0)
    await session.aclose()
    with pytest.raises(SessionClosed):
        await waiting


async def test_bad_arguments() -> None:
    async with Session("watching") as session:
        mistakes: list[tuple[Any, Any, type[Exception]]] = [
            (5, "/echo", TypeError),
            (ECHO, "no name", InvalidServiceName),
        ]
        for srv_type, srv_name, error in mistakes:
            with pytest.raises(error):
                await following(session.watch_service(srv_type, srv_name))


async def test_a_stock_server(session: Session, server: ServerProcess) -> None:
    states = session.watch_service(ECHO, "/watched")
    assert (await following(states)).status == "gone"
    await server.serve("/watched")
    up = await following(states)
    assert up.status == "up"
    assert all(name.startswith("/") for name in up.nodes)
    await server.stop("/watched")
    assert (await following(states)).status == "gone"
