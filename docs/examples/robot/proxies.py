"""A tree ticked in its own thread, whose leaves use `AsyncServiceProxy`."""

import asyncio
import time
from typing import Any

from nodes import Fallback, Parallel, Sequence, Status
from std_srvs.srv import SetBool, Trigger

import rosasync
from rosasync import AsyncServiceProxy, ProxyState


class Call:
    def __init__(
        self, session: rosasync.Session, srv_type: Any, srv_name: str, **fields: Any
    ) -> None:
        self.proxy = AsyncServiceProxy(session, srv_type, srv_name)
        self.fields = fields
        self.running = False

    def tick(self) -> Status:
        if not self.running:
            self.running = True
            self.proxy.call_service(self.fields, timeout=5.0)
        state = self.proxy.get_state()
        if state is ProxyState.RUNNING:
            return Status.RUNNING
        self.running = False
        if state is not ProxyState.RESPONSE_READY:
            print(state.name, *self.proxy.get_errors())
            return Status.FAILURE
        response = self.proxy.get_response()
        print(response.message)
        return Status.SUCCESS if response.success else Status.FAILURE

    def halt(self) -> None:
        self.running = False
        self.proxy.stop_call()


def run_mission(session: rosasync.Session) -> None:
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
    while (status := mission.tick()) is Status.RUNNING:
        time.sleep(0.01)
    print(status.name.lower())


async def main() -> None:
    async with rosasync.Session("proxies") as session:
        await asyncio.to_thread(run_mission, session)


asyncio.run(main())
