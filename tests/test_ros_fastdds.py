"""The end of discovery before a participant is destroyed, which may hang otherwise."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from rclpy.node import Node

from rosasync import Session
from rosasync._ros import fastdds
from tests.support.echo import ECHO
from tests.support.nodes import borrowed_node
from tests.support.servers import ServerProcess
from tests.support.times import TICK, until


def sees(node: Node, name: str) -> bool:
    return bool(node.count_services(name))


async def test_a_node_discovers_nothing_more(session: Session, server: ServerProcess) -> None:
    with borrowed_node("deaf") as deaf, borrowed_node("other") as other:
        await server.serve("/early")
        await until(lambda: sees(deaf, "/early"))
        assert fastdds.end_discovery(deaf)
        assert fastdds.end_discovery(deaf), "once more"
        await server.serve("/late")
        await session.wait_for_service(ECHO, "/late")
        await until(lambda: sees(other, "/late"))
        await asyncio.sleep(2 * TICK)
        assert sees(deaf, "/early")
        assert not sees(deaf, "/late")


async def test_a_session_ends_the_discovery_of_its_own_context(
    bridge: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended: list[bool] = []
    end_discovery = fastdds.end_discovery
    monkeypatch.setattr(fastdds, "end_discovery", lambda node: ended.append(end_discovery(node)))
    async with Session("own", bridge=bridge):
        assert ended == []
    assert ended == [True]


async def test_the_other_nodes_of_a_given_context_go_on_discovering(
    bridge: Any, server: ServerProcess
) -> None:
    with borrowed_node("other") as other:
        async with Session("guest", context=other.context, bridge=bridge):
            pass
        await server.serve("/late")
        await until(lambda: sees(other, "/late"))


async def test_a_session_ends_after_its_context_was_shut_down(bridge: Any) -> None:
    session = await Session("own", bridge=bridge).open()
    session.node.context.shutdown()
    await session.aclose()
