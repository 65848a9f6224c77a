"""Prints the memory that goals leave behind: ``python -m tests.support.goal_memory BRIDGE SIDES``.

It is what the process has grown by in megabytes, from 1,000 goals to 10,000. SIDES is ``client``,
with a server in another process, or ``both``. A process of its own, because what other tests leave
to the allocator blurs the figure.
"""

from __future__ import annotations

import asyncio
import gc
import sys
from contextlib import suppress
from typing import Any

from test_msgs.action import Fibonacci

from rosasync import GoalRejected, Session
from tests.faults.trial import resident_megabytes
from tests.support.times import LIMIT, until

AT_ONCE = 10
BATCH = 500
"""Goals until the results that the server keeps have to expire: how many it keeps at a time would
depend on the machine."""


async def handler(goal: Any) -> dict[str, list[int]]:
    return {"sequence": [goal.request.order]}


async def run_goals(session: Session, count: int) -> None:
    async def run_one_after_the_other() -> None:
        for _ in range(count // AT_ONCE):
            # On a busy machine a result may expire before it is asked for.
            with suppress(GoalRejected):
                await session.act(Fibonacci, "/quick", {"order": 2})

    async with asyncio.TaskGroup() as group:
        for _ in range(AT_ONCE):
            group.create_task(run_one_after_the_other())


async def measure(bridge: Any, sides: str) -> float:
    sizes = []
    async with Session("goal_memory", bridge=bridge, timeout=LIMIT) as session:
        server = None
        if sides == "both":
            server = session.serve_action(
                Fibonacci, "/quick", handler, concurrency=AT_ONCE, result_timeout=0.25
            )
        for count in (1_000, 9_000):
            for _ in range(count // BATCH):
                await run_goals(session, BATCH)
                await until(lambda: server is None or not server.statistics().results)
            gc.collect()
            sizes.append(resident_megabytes())
    return sizes[1] - sizes[0]


if __name__ == "__main__":
    print(asyncio.run(measure(*sys.argv[1:])))
