"""Seven motions at once, of which the server accepts five."""

import asyncio

from std_srvs.srv import SetBool

import rosasync


async def main() -> None:
    async with rosasync.Session("operator") as session:
        gripper = session.client(SetBool, "/gripper/close", timeout=20.0)
        await gripper.wait(timeout=20.0)
        calls = [gripper.start({"data": number % 2 == 0}) for number in range(7)]
        for response in await asyncio.gather(*calls):
            print(response.success, response.message)


asyncio.run(main())
