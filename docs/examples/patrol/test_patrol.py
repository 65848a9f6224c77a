"""The patrol on a base of stubs: in memory, and on real ROS."""

from collections.abc import Iterator

import pytest
from patrol import run
from py_trees.blackboard import Blackboard
from py_trees.common import Status
from std_srvs.srv import Trigger

from rosasync.testing import Graph

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True),
]
YES, NO = {"success": True}, {"success": False}


@pytest.fixture(autouse=True)
def empty_blackboard() -> Iterator[None]:
    yield
    Blackboard.clear()


async def test_docks_when_the_battery_is_low(ros_graph: Graph) -> None:
    door = ros_graph.stub(Trigger, "/base/go_to_door", YES)
    window = ros_graph.stub(Trigger, "/base/go_to_window", YES)
    dock = ros_graph.stub(Trigger, "/base/dock", YES)
    battery = ros_graph.stub(Trigger, "/battery/is_low")
    battery.answer(YES, match=lambda request: len(window.calls) == 1)
    battery.answer(NO)

    async with ros_graph.session() as session:
        with window.hold_responses():
            assert await run(session) is Status.SUCCESS
        assert session.pool.statistics().cancelled >= 1
    for place in (door, window, dock):
        place.assert_called(times=1)


async def test_a_failed_drive_ends_the_patrol(ros_graph: Graph) -> None:
    ros_graph.stub(Trigger, "/battery/is_low", NO)
    ros_graph.stub(Trigger, "/base/go_to_door", NO)
    async with ros_graph.session() as session:
        assert await run(session) is Status.FAILURE
