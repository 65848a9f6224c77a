"""A py_trees tree, ticked in the loop. The loop runs between the ticks."""

import asyncio

from mission import make_mission
from py_trees.common import Status
from py_trees.trees import BehaviourTree

import rosasync


async def main() -> None:
    async with rosasync.Session("py_trees_in_loop") as session:
        tree = BehaviourTree(make_mission())
        tree.setup(session=session)
        tree.tick()
        while tree.root.status is Status.RUNNING:
            await asyncio.sleep(0.01)
            tree.tick()
        print(tree.root.status.name.lower())
        tree.shutdown()


asyncio.run(main())
