"""Mistakes that a type checker flags: each line that has one is marked, and no other is flagged.

mypy infers the request's type from the service and from the request at once, and takes what both
have in common. So it accepts any message there; with a client, a lease or a proxy it does not.
"""

from __future__ import annotations

from typing import Any

from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

import rosasync
from rosasync import AsyncActionProxy, AsyncServiceProxy, ServiceCall
from rosasync.testing import Graph


async def calls(session: rosasync.Session) -> None:
    response = await session.call(SetBool, "/arm/enable", SetBool.Request(data=True))
    print(response.mesage)  # E: no such field
    await session.call(SetBool, "/arm/enable", Trigger.Request())  # E (pyright): another type
    await session.call(SetBool, "/arm/enable", SetBool.Response())  # E (pyright): a response
    await session.call(7, "/arm/enable")  # E: no service type
    await session.call(SetBool.Request, "/arm/enable")  # E: a message type
    await session.call(SetBool, "/arm/enable", timeout="2")  # E: no number of seconds
    unawaited = session.call(SetBool, "/arm/enable")
    print(unawaited.message)  # E: a coroutine, no response
    task = session.start(SetBool, "/arm/enable")
    print(task.message)  # E: a task, no response


async def clients(session: rosasync.Session) -> None:
    client = session.client(SetBool, "/arm/enable")
    await client.call(Trigger.Request())  # E: another type's request
    print((await client.call()).sucess)  # E: no such field
    async with session.pool.lease(SetBool, "/arm/enable") as leased:
        await leased.call(Trigger.Request())  # E: another type's request
        print((await leased.call()).sucess)  # E: no such field


def of_three(request: SetBool.Request, response: SetBool.Response, more: int) -> SetBool.Response:
    return response


def of_another(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    return response


def of_another_call(call: ServiceCall[Trigger.Request, Trigger.Response]) -> Trigger.Response:
    return call.response


async def wrong_answer(request: SetBool.Request, response: SetBool.Response) -> bool:
    return True


async def servers(session: rosasync.Session) -> None:
    session.serve(SetBool, "/arm/enable", of_three)  # E: three arguments
    session.serve(SetBool, "/arm/enable", of_another)  # E: another type's messages
    session.serve(SetBool, "/arm/enable", of_another_call)  # E: another type's call
    session.serve(SetBool, "/arm/enable", wrong_answer)  # E: no response
    async with session.serve(SetBool, "/arm/enable") as server:
        async for call in server:
            print(call.request.dat)  # E: no such field
            call.respond(Trigger.Response())  # E: another type's response


def tests(graph: Graph) -> None:
    stub = graph.stub(SetBool, "/arm/enable")
    stub.answer({}, match=lambda request: request.dat)  # E: no such field
    stub.answer({}, match=of_three)  # E: three arguments
    print(stub.calls[0].request.dat)  # E: no such field
    graph.serve(SetBool, "/arm/enable", of_another)  # E: another type's messages
    graph.serve(SetBool, "/arm/enable", of_another_call)  # E: another type's call


def threads(session: rosasync.Session) -> None:
    print(session.from_thread.call(SetBool, "/arm/enable").mesage)  # E: no such field
    print(session.from_thread.submit(SetBool, "/arm/enable").success)  # E: a future, no response


def ticks(session: rosasync.Session, by_name: Any) -> None:
    proxy = AsyncServiceProxy(session, SetBool, "/arm/enable")
    proxy.call_service(Trigger.Request())  # E: another type's request
    print(proxy.get_response().message)  # E: None until it is there


async def wrong_result(goal: rosasync.ServerGoal[Fibonacci.Goal, Fibonacci.Feedback]) -> int:
    print(goal.request.ordr)  # E: no such field
    goal.feedback(Fibonacci.Result())  # E: a result
    return 3


def action_servers(session: rosasync.Session) -> None:
    session.serve_action(Fibonacci, "/fibonacci", wrong_result)  # E (mypy): no result
    session.serve_action(SetBool, "/fibonacci", wrong_result)  # E: a service type
    session.serve_action(Fibonacci, "/fibonacci", drive, on_busy="wait")  # E: no such choice


async def drive(goal: rosasync.ServerGoal[Fibonacci.Goal, Fibonacci.Feedback]) -> Fibonacci.Result:
    return Fibonacci.Result()


async def goals(session: rosasync.Session) -> None:
    result = await session.act(Fibonacci, "/fibonacci", {"order": 8})
    print(result.sequenc)  # E: no such field
    await session.act(Fibonacci, "/fibonacci", Fibonacci.Result())  # E (pyright): a result
    await session.act(SetBool, "/fibonacci")  # E: a service type
    await session.act(Fibonacci, "/fibonacci", timeout="2")  # E: no number of seconds
    async with session.goal(Fibonacci, "/fibonacci") as goal:
        async for feedback in goal:
            print(feedback.sequenc)  # E: no such field
        print((await goal.result()).sequenc)  # E: no such field
    session.attach(Fibonacci, "/fibonacci", "7")  # E: no UUID
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal(Fibonacci.Result())  # E: a result
