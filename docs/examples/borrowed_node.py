import asyncio
import threading
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool

import rosasync


def spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()


async def use(node: Node, executor: SingleThreadedExecutor) -> None:
    async with rosasync.Session(node) as session:
        response = await session.call(SetBool, "/lamp/switch", {"data": True}, timeout=10.0)
        print("the lamp is", response.message)
        name = await rosasync.wrap_future(executor.create_task(node.get_fully_qualified_name))
        print("the executor's task returned", name)


rclpy.init()
node = rclpy.create_node("mine")
executor = SingleThreadedExecutor()
executor.add_node(node)
thread = threading.Thread(target=spin, args=(executor,))
thread.start()
try:
    asyncio.run(use(node, executor))
finally:
    rclpy.shutdown()
    thread.join()
