import asyncio

import rosasync
from rosasync.parameters import ParameterClient, ParameterError


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        arm = ParameterClient(session, "/arm")
        print(await arm.get("speed"))
        print(await arm.get(["home", "serial"]))

        await arm.set("speed", 0.75)
        await arm.set_atomically({"speed": 0.25, "home": [0.0, 0.0, 1.0]})
        try:
            await arm.set("serial", "B2")
        except ParameterError as error:
            print(error.name, "was refused:", error.reason)

        speed = await arm.describe("speed")
        print(speed.type.name, speed.description, speed.range)


asyncio.run(main())
