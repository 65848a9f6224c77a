import asyncio

import rosasync
from rosasync.lifecycle import LifecycleClient, TransitionFailed, TransitionTimeout


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        camera = LifecycleClient(session, "/camera")
        print(await camera.state(), [found.label for found in await camera.transitions()])
        try:
            await camera.activate()
        except TransitionFailed as error:
            print("still", error.state)

        try:
            await camera.configure(timeout=0.5)
        except TransitionTimeout as error:
            print("configured?", error.outcome)

        # The camera answers when it has finished.
        print(await camera.state())
        print(await camera.activate())
        print(await camera.shutdown())


asyncio.run(main())
