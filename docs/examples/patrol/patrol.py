"""A robot that patrols between two places, and docks as soon as its battery is low.

The battery is asked while the robot drives. If it is low, the tree halts the drive, which cancels
its call: a late answer to it cannot be taken for the answer of a later drive.
"""

import asyncio
import operator

from py_trees.behaviour import Behaviour
from py_trees.behaviours import CheckBlackboardVariableValue
from py_trees.blackboard import Client
from py_trees.common import Access, ComparisonExpression, ParallelPolicy, Status
from py_trees.composites import Parallel, Selector, Sequence
from py_trees.decorators import Repeat
from py_trees.trees import BehaviourTree
from std_srvs.srv import Trigger

import rosasync
from rosasync.behaviours import CallService

PERIOD = 0.02
"""Seconds between two ticks."""


def drive(place: str) -> Behaviour:
    def arrived(response: Trigger.Response) -> None:
        print(place, flush=True)

    return CallService(place, Trigger, f"/base/{place}", on_response=arrived, timeout=10.0)


def battery() -> Behaviour:
    """Asks the battery again and again, and remembers its last answer."""
    board = Client(name="battery")
    board.register_key("battery_low", Access.WRITE)

    def remember(response: Trigger.Response) -> Status:
        board.battery_low = response.success
        return Status.SUCCESS

    def ignore(error: Exception) -> Status:
        return Status.SUCCESS

    return CallService("battery", Trigger, "/battery/is_low", on_response=remember, on_error=ignore)


def make_tree() -> BehaviourTree:
    low = CheckBlackboardVariableValue(
        "low?", ComparisonExpression("battery_low", True, operator.eq)
    )
    rounds = Sequence("round", True, [drive("go_to_door"), drive("go_to_window")])
    work = Selector(
        "work",
        memory=False,  # "low?" is asked again in every tick, also while the robot drives.
        children=[
            Sequence("charge", True, [low, drive("dock")]),
            Repeat("patrol", rounds, num_success=-1),
        ],
    )
    until_docked = ParallelPolicy.SuccessOnSelected([work], synchronise=False)
    return BehaviourTree(Parallel("robot", until_docked, [battery(), work]))


async def run(session: rosasync.Session) -> Status:
    """Tick the tree until the robot is docked."""
    tree = make_tree()
    tree.setup(session=session)
    try:
        tree.tick()
        while tree.root.status is Status.RUNNING:
            await asyncio.sleep(PERIOD)
            tree.tick()
        return tree.root.status
    finally:
        tree.shutdown()


async def main() -> None:
    async with rosasync.Session("patrol") as session:
        status = await run(session)
        print(status.name.lower(), "- cancelled calls:", session.pool.statistics().cancelled)


if __name__ == "__main__":
    asyncio.run(main())
