import asyncio

from std_srvs.srv import SetBool

import rosasync


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        response = await session.call(
            SetBool, "/lamp/switch", SetBool.Request(data=True), timeout=10.0
        )
        print("the lamp is", response.message)


asyncio.run(main())
