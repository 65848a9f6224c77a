import asyncio

import rosasync


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        response = await session.call("std_srvs/srv/SetBool", "/lamp/switch", {"data": False})
        print("the lamp is", response.message)


asyncio.run(main())
