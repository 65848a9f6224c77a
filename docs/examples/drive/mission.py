"""A robot that explores until its battery is low, and then docks: the dock preempts the drive.

The tree halts the leaf that explores. That cancels its goal on the base, also if the goal was not
accepted yet, and no tick waits for it.
"""

import asyncio
from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import Access, Status
from py_trees.composites import Selector, Sequence
from py_trees.trees import BehaviourTree
from test_msgs.action import Fibonacci as Drive

import rosasync
from rosasync.behaviours import SendGoal

PERIOD = 0.02
"""Seconds between two ticks."""
CHARGE = 4
"""Steps after which the battery is low."""


class BatteryLow(Behaviour):
    """SUCCESS if the robot has driven further than its battery lasts, by the newest feedback."""

    def __init__(self) -> None:
        super().__init__("battery low?")
        self.board = self.attach_blackboard_client()
        self.board.register_key("driven", Access.READ)

    def update(self) -> Status:
        low = self.board.exists("driven") and len(self.board.driven.sequence) >= CHARGE
        return Status.SUCCESS if low else Status.FAILURE


def arrived(result: Any) -> None:
    print("docked after", len(result.sequence), "steps", flush=True)


def make_tree() -> BehaviourTree:
    explore = SendGoal("explore", Drive, "/base/drive", {"order": 50}, key_feedback="driven")
    dock = SendGoal("dock", Drive, "/base/drive", {"order": 3}, on_result=arrived, timeout=30.0)
    # The selector has no memory, so it asks for the battery in every tick.
    return BehaviourTree(
        Selector("robot", False, [Sequence("charge", True, [BatteryLow(), dock]), explore])
    )


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
    async with rosasync.Session("mission") as session:
        status = await run(session)
        print(status.name.lower())


if __name__ == "__main__":
    asyncio.run(main())
