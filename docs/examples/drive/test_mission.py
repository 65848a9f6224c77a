"""The mission on a stub of the base, and the base itself: in memory, and on real ROS."""

from collections.abc import Iterator

import mobile_base
import pytest
from mission import CHARGE, run
from py_trees.blackboard import Blackboard
from py_trees.common import Status
from test_msgs.action import Fibonacci as Drive

from rosasync import GoalAborted, GoalCanceled, GoalRejected, GoalStatus
from rosasync.testing import Graph

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True),
]
DRIVE = "/base/drive"


@pytest.fixture(autouse=True)
def empty_blackboard() -> Iterator[None]:
    yield
    Blackboard.clear()


async def test_docks_when_the_battery_is_low(ros_graph: Graph) -> None:
    base = ros_graph.stub_action(Drive, DRIVE)
    # The first goal runs until it is cancelled.
    base.answer(None, feedback=[{"sequence": range(CHARGE)}], match={"order": 50}, delay=0.1)
    base.answer({"sequence": [0, 1, 2]}, match={"order": 3})
    async with ros_graph.session() as session:
        assert await run(session) is Status.SUCCESS
    base.assert_goals({"order": 50}, {"order": 3})
    base.assert_statuses(GoalStatus.CANCELED, GoalStatus.SUCCEEDED)


async def test_a_base_that_is_blocked_ends_the_mission(ros_graph: Graph) -> None:
    ros_graph.stub_action(Drive, DRIVE, GoalAborted("blocked"))
    async with ros_graph.session() as session:
        assert await run(session) is Status.FAILURE


async def test_the_base_drives_one_goal_at_a_time(ros_graph: Graph) -> None:
    base = mobile_base.Base()
    async with ros_graph.session() as server, ros_graph.session() as session:
        mobile_base.serve(server, base)
        async with session.goal(Drive, DRIVE, {"order": 50}) as first:
            async for feedback in first:
                if len(feedback.sequence) == 2:
                    break
            result = await session.act(Drive, DRIVE, {"order": 1})
            assert list(result.sequence) == [0]
            with pytest.raises(GoalCanceled) as caught:
                await first.result()
        assert 2 <= len(caught.value.result.sequence) < 50
        assert not base.moving
        with pytest.raises(GoalRejected):
            await session.act(Drive, DRIVE, {"order": 0})
