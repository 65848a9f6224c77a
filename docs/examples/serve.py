import asyncio

from std_srvs.srv import SetBool, Trigger

import rosasync


async def main() -> None:
    async with rosasync.Session("night") as session:

        async def good_night(
            request: Trigger.Request, response: Trigger.Response
        ) -> Trigger.Response:
            lamp = await session.call(SetBool, "/lamp/switch", {"data": False}, timeout=10.0)
            response.success = True
            response.message = f"the lamp is {lamp.message}"
            return response

        async with session.serve(Trigger, "/good_night", good_night):
            answer = await session.call(Trigger, "/good_night")
            print(answer.message)


asyncio.run(main())
