import asyncio

from std_srvs.srv import SetBool, Trigger

import rosasync


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        try:
            await session.call(Trigger, "/lamp/switch", timeout=5.0)
        except rosasync.ServiceUnavailable as error:
            print(error)
        try:
            await session.call(SetBool, "/lamp/dim", wait=False)
        except TimeoutError as error:
            print(type(error).__name__, error)


asyncio.run(main())
