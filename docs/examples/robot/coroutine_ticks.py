"""A tree whose nodes are coroutines that await their calls, under `asyncio.timeout`.

Cancelling a node cancels its call, so `asyncio.timeout` also limits a subtree.
"""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from std_srvs.srv import SetBool, Trigger

import rosasync

Node = Callable[[rosasync.Session], Awaitable[bool]]


def call(srv_type: Any, srv_name: str, **fields: Any) -> Node:
    async def node(session: rosasync.Session) -> bool:
        try:
            response = await session.call(srv_type, srv_name, fields)
        except rosasync.CallError as error:
            print(error)
            return False
        print(response.message)
        return bool(response.success)

    return node


def sequence(*children: Node) -> Node:
    async def node(session: rosasync.Session) -> bool:
        for child in children:
            if not await child(session):
                return False
        return True

    return node


def fallback(*children: Node) -> Node:
    async def node(session: rosasync.Session) -> bool:
        for child in children:
            if await child(session):
                return True
        return False

    return node


def parallel(*children: Node) -> Node:
    async def node(session: rosasync.Session) -> bool:
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(child(session)) for child in children]
        return all(task.result() for task in tasks)

    return node


def within(seconds: float, child: Node) -> Node:
    async def node(session: rosasync.Session) -> bool:
        try:
            async with asyncio.timeout(seconds):
                return await child(session)
        except TimeoutError:
            return False

    return node


MISSION = within(
    20.0,
    sequence(
        call(SetBool, "/arm/enable", data=True),
        call(Trigger, "/arm/home"),
        fallback(call(Trigger, "/door/open"), call(Trigger, "/door/knock")),
        parallel(
            call(Trigger, "/gripper/open"),
            call(SetBool, "/lamp/switch", data=True),
            call(SetBool, "/camera/enable", data=True),
        ),
        call(Trigger, "/map/save"),
    ),
)


async def main() -> None:
    async with rosasync.Session("coroutine_ticks") as session:
        print("success" if await MISSION(session) else "failure")


asyncio.run(main())
