import asyncio

from std_srvs.srv import SetBool

import rosasync


async def main() -> None:
    limits = rosasync.Limits(clients=8, in_flight=1)
    async with rosasync.Session("exclusive", limits=limits) as session:
        async with session.pool.lease(SetBool, "/lamp/switch", timeout=10.0) as client:
            for data in (True, False):
                response = await client.call(SetBool.Request(data=data))
                print("the lamp is", response.message)
        statistics = session.pool.statistics()
        print(statistics.clients, "client,", statistics.completed, "calls")


asyncio.run(main())
