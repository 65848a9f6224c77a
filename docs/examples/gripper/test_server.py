"""The server with a device that takes 0.2 s: in memory, and on real ROS."""

import asyncio
from collections.abc import AsyncIterator

import pytest
import pytest_asyncio
from device import Gripper
from server import SERVICE, WAITING, GripperServer
from std_srvs.srv import SetBool

import rosasync
from rosasync.testing import Graph

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True),
]


@pytest_asyncio.fixture
async def session(ros_graph: Graph) -> AsyncIterator[rosasync.Session]:
    gripper = Gripper(seconds=0.2)
    ros_graph.serve(SetBool, SERVICE, GripperServer(gripper).close)
    async with ros_graph.session() as session:
        yield session
    gripper.disconnect()


async def move(session: rosasync.Session, *closed: bool) -> list[str]:
    """Order motions at once; return what the server says of each."""
    calls = [session.call(SetBool, SERVICE, {"data": one}) for one in closed]
    return [response.message for response in await asyncio.gather(*calls)]


async def test_each_motion_is_answered_when_it_is_done(session: rosasync.Session) -> None:
    assert await move(session, True, False, True) == ["done"] * 3


async def test_a_motion_that_fails(session: rosasync.Session) -> None:
    assert await move(session, True, True) == ["done", "it is already there"]


async def test_too_many_motions(session: rosasync.Session) -> None:
    motions = [number % 2 == 0 for number in range(WAITING + 2)]
    assert await move(session, *motions) == ["done"] * WAITING + ["busy"] * 2
    assert await move(session, False) == ["done"]


async def test_a_caller_that_gave_up(session: rosasync.Session) -> None:
    assert await move(session, False) == ["done"]
    with pytest.raises(rosasync.ResponseTimeout):
        await session.call(SetBool, SERVICE, {"data": True}, timeout=0.1)
    assert await move(session, True) == ["it is already there"]
