"""A tree ticked in the loop, whose leaves start calls as tasks and check them in later ticks."""

import asyncio
from typing import Any

from nodes import Fallback, Parallel, Sequence, Status
from std_srvs.srv import SetBool, Trigger

import rosasync


class Call:
    def __init__(
        self, session: rosasync.Session, srv_type: Any, srv_name: str, **fields: Any
    ) -> None:
        self.start = lambda: session.start(srv_type, srv_name, fields, timeout=5.0)
        self.task: asyncio.Task[Any] | None = None

    def tick(self) -> Status:
        if self.task is None:
            self.task = self.start()
        if not self.task.done():
            return Status.RUNNING
        task, self.task = self.task, None
        if (error := task.exception()) is not None:
            print(error)
            return Status.FAILURE
        print(task.result().message)
        return Status.SUCCESS if task.result().success else Status.FAILURE

    def halt(self) -> None:
        if self.task is not None:
            self.task.cancel()
            self.task = None


async def main() -> None:
    async with rosasync.Session("polled_tasks") as session:
        mission = Sequence(
            Call(session, SetBool, "/arm/enable", data=True),
            Call(session, Trigger, "/arm/home"),
            Fallback(Call(session, Trigger, "/door/open"), Call(session, Trigger, "/door/knock")),
            Parallel(
                Call(session, Trigger, "/gripper/open"),
                Call(session, SetBool, "/lamp/switch", data=True),
                Call(session, SetBool, "/camera/enable", data=True),
            ),
            Call(session, Trigger, "/map/save"),
        )
        while True:
            status = mission.tick()
            if status is not Status.RUNNING:
                break
            await asyncio.sleep(0.01)
        print(status.name.lower())


asyncio.run(main())
