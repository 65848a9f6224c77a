"""A server that defers to a slow device: a call is answered when the device reports."""

import asyncio
import signal
from functools import partial

from device import Gripper
from std_srvs.srv import SetBool

import rosasync

SERVICE = "/gripper/close"
WAITING = 5
"""The maximum number of motions that wait for the device."""


class GripperServer:
    def __init__(self, gripper: Gripper) -> None:
        self.gripper = gripper
        self.waiting: set[rosasync.ServiceCall[SetBool.Request, SetBool.Response]] = set()

    def close(
        self, call: rosasync.ServiceCall[SetBool.Request, SetBool.Response]
    ) -> SetBool.Response | None:
        """Order the motion. It runs in the loop, so it must not wait for the device."""
        if len(self.waiting) == WAITING:
            return SetBool.Response(success=False, message="busy")
        self.waiting.add(call)
        self.gripper.move(call.request.data, partial(self.moved, call))
        return None  # `moved` responds.

    def moved(
        self,
        call: rosasync.ServiceCall[SetBool.Request, SetBool.Response],
        problem: str | None,
    ) -> None:
        """Respond. It runs in the driver's thread."""
        self.waiting.discard(call)
        try:
            call.respond(SetBool.Response(success=problem is None, message=problem or "done"))
        except rosasync.SessionClosed:
            print("moved, but the server has ended")


async def main() -> None:
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    gripper = Gripper()
    try:
        async with rosasync.Session("gripper") as session:
            session.serve(SetBool, SERVICE, GripperServer(gripper).close)
            print("ready", flush=True)
            await stop.wait()
    finally:
        await asyncio.to_thread(gripper.disconnect)


if __name__ == "__main__":
    asyncio.run(main())
