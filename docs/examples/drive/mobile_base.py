"""The base of a robot: an action that drives, one step after the other.

A new goal replaces the one that is under way. `Fibonacci` stands for an action of your own: its
order is the number of steps, and its sequence has the steps that were driven.
"""

import asyncio
import contextlib
from typing import Any

from test_msgs.action import Fibonacci as Drive

import rosasync

STEP = 0.1
"""Seconds for each step."""


class Base:
    """A base whose motors only count.

    Attributes:
        steps: the steps driven so far.
        moving: whether the motors run.
    """

    def __init__(self) -> None:
        self.steps = 0
        self.moving = False

    async def drive(self, goal: rosasync.ServerGoal[Any, Any]) -> Any:
        """Drive a number of steps, and report each."""
        driven: list[int] = []
        self.moving = True
        try:
            for step in range(goal.request.order):
                await asyncio.sleep(STEP)
                self.steps += 1
                driven.append(step)
                goal.feedback({"sequence": driven})
        except asyncio.CancelledError:
            # The client left, cancelled the goal, or sent another one: it gets what was driven.
            return {"sequence": driven}
        finally:
            self.moving = False
        return {"sequence": driven}


def is_possible(request: Any) -> bool:
    return bool(0 < request.order <= 100)


def serve(session: rosasync.Session, base: Base) -> rosasync.ActionServer[Any, Any, Any]:
    return session.serve_action(
        Drive, "/base/drive", base.drive, on_goal=is_possible, on_busy="replace"
    )


async def main() -> None:
    async with rosasync.Session("base") as session, serve(session, Base()):
        print("the base is ready", flush=True)
        await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(main())
