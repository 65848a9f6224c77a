"""A py_trees tree, ticked in its own thread. The loop is free for everything else."""

import asyncio

from mission import make_mission
from py_trees.trees import BehaviourTree

import rosasync


async def main() -> None:
    async with rosasync.Session("py_trees_in_thread") as session:
        tree = BehaviourTree(make_mission())
        tree.setup(session=session)
        await asyncio.to_thread(tree.tick_tock, period_ms=10, stop_on_terminal_state=True)
        print(tree.root.status.name.lower())
        tree.shutdown()


asyncio.run(main())
