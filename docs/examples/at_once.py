import asyncio

from std_srvs.srv import SetBool

import rosasync


async def main() -> None:
    async with rosasync.Session("tutorial") as session:
        switch = session.client(SetBool, "/lamp/switch")
        await switch.wait(timeout=10.0)
        async with asyncio.TaskGroup() as group:
            tasks = [
                group.create_task(switch.call(SetBool.Request(data=number % 2 == 0)))
                for number in range(100)
            ]
        answers = [task.result().message for task in tasks]
        print("on:", answers.count("on"), "off:", answers.count("off"))


asyncio.run(main())
