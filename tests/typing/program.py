"""A user's program: what the checkers infer of each call; read by them, never run."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping
from concurrent.futures import Future
from typing import Any, Literal, assert_type

from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

import rosasync
from rosasync import (
    AsyncActionProxy,
    AsyncServiceProxy,
    Goal,
    LeasedClient,
    ServiceCall,
    ServiceClient,
    ServiceServer,
)
from rosasync.testing import Graph, StubServer

NAME = "std_srvs/srv/SetBool"


async def calls(session: rosasync.Session) -> None:
    response = await session.call(SetBool, "/arm/enable", SetBool.Request(data=True))
    assert_type(response, SetBool.Response)
    assert_type(await session.call(SetBool, "/arm/enable", {"data": True}), SetBool.Response)
    assert_type(await session.call(Trigger, "/arm/home", timeout=None), Trigger.Response)
    assert_type(await session.call(NAME, "/arm/enable", {"data": True}), Any)
    print(response.message.upper())


async def tasks(session: rosasync.Session) -> None:
    task = session.start(SetBool, "/arm/enable", SetBool.Request(data=True), timeout=2.0)
    assert_type(task, asyncio.Task[SetBool.Response])
    assert_type(await task, SetBool.Response)
    assert_type(session.start(NAME, "/arm/enable"), asyncio.Task[Any])


async def clients(session: rosasync.Session) -> None:
    client = session.client(SetBool, "/arm/enable")
    assert_type(client, ServiceClient[SetBool.Request, SetBool.Response])
    assert_type(await client.call(SetBool.Request(data=True)), SetBool.Response)
    assert_type(await client.call({"data": True}, timeout=1.0), SetBool.Response)
    assert_type(client.start(), asyncio.Task[SetBool.Response])
    assert_type(await session.client(NAME, "/arm/enable").call(), Any)


async def leases(session: rosasync.Session) -> None:
    async with session.pool.lease(SetBool, "/arm/enable") as client:
        assert_type(client, LeasedClient[SetBool.Request, SetBool.Response])
        assert_type(await client.call(SetBool.Request(data=True)), SetBool.Response)
    async with session.pool.lease(NAME, "/arm/enable") as named:
        assert_type(await named.call(), Any)


def plain(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success = request.data
    return response


async def later(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    await asyncio.sleep(1.0)
    return plain(request, response)


def deferred(call: ServiceCall[SetBool.Request, SetBool.Response]) -> None:
    assert_type(call.request, SetBool.Request)
    assert_type(call.response, SetBool.Response)
    call.respond(SetBool.Response(success=call.request.data))


async def by_call(call: ServiceCall[SetBool.Request, SetBool.Response]) -> SetBool.Response:
    await asyncio.sleep(1.0)
    return call.response


def untyped(request: Any, response: Any) -> Any:
    return response


async def servers(session: rosasync.Session) -> None:
    server = session.serve(SetBool, "/arm/enable", plain)
    assert_type(server, ServiceServer[SetBool.Request, SetBool.Response])
    session.serve(SetBool, "/arm/enable", later)
    session.serve(SetBool, "/arm/enable", deferred)
    session.serve(SetBool, "/arm/enable", by_call)
    session.serve(SetBool, "/arm/enable", untyped)
    session.serve(NAME, "/arm/enable", plain)
    async with session.serve(SetBool, "/arm/enable") as iterated:
        async for call in iterated:
            assert_type(call, ServiceCall[SetBool.Request, SetBool.Response])
            assert_type(call.request, SetBool.Request)
            call.respond(SetBool.Response(success=call.request.data))


def threads(session: rosasync.Session) -> None:
    portal = session.from_thread
    assert_type(portal.call(SetBool, "/arm/enable", {"data": True}), SetBool.Response)
    future = portal.submit(SetBool, "/arm/enable", SetBool.Request(data=True))
    assert_type(future, Future[SetBool.Response])
    assert_type(future.result(timeout=1.0), SetBool.Response)
    assert_type(portal.call(NAME, "/arm/enable"), Any)


def ticks(session: rosasync.Session) -> None:
    proxy = AsyncServiceProxy(session, SetBool, "/arm/enable")
    assert_type(proxy, AsyncServiceProxy[SetBool.Request, SetBool.Response])
    proxy.call_service(SetBool.Request(data=True), timeout=2.0)
    assert_type(proxy.get_response(), SetBool.Response | None)


def respond(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    return response


async def tests(graph: Graph) -> None:
    stub = graph.stub(SetBool, "/arm/enable", {"success": True})
    assert_type(stub, StubServer[SetBool.Request, SetBool.Response])
    assert_type(stub.calls[0].request, SetBool.Request)
    stub.answer({}, match=lambda request: bool(assert_type(request, SetBool.Request).data))
    served = graph.serve(SetBool, "/arm/enable", plain)
    assert_type(served, StubServer[SetBool.Request, SetBool.Response])
    graph.serve(SetBool, "/arm/enable", by_call)
    graph.serve(SetBool, "/arm/enable", lambda request, response: respond(request, response))
    async for call in graph.serve(SetBool, "/arm/enable"):
        assert_type(call, ServiceCall[SetBool.Request, SetBool.Response])
    restart: list[Coroutine[Any, Any, None]] = [stub.vanish(), stub.come_back()]
    await asyncio.gather(*restart)
    base = graph.stub_action(Fibonacci, "/fibonacci", {"sequence": [1]})
    base.answer(None, match=lambda goal: bool(assert_type(goal, Fibonacci.Goal).order))
    assert_type(graph.stub(NAME, "/arm/enable"), StubServer[Any, Any])
    async with graph.session() as session:
        assert_type(await session.wait_for_service(SetBool, "/arm/enable"), Literal[True])


async def generic(
    session: rosasync.Session,
    kinds: Mapping[str, rosasync.ServiceType[SetBool.Request, SetBool.Response]],
) -> None:
    kind = kinds["enable"]
    assert_type(await session.call(kind, "/arm/enable", SetBool.Request()), SetBool.Response)


ACTION = "test_msgs/action/Fibonacci"


def on_feedback(feedback: Fibonacci.Feedback) -> None:
    print(feedback.sequence)


async def goals(session: rosasync.Session) -> None:
    result = await session.act(Fibonacci, "/fibonacci", {"order": 8}, on_feedback=on_feedback)
    assert_type(result, Fibonacci.Result)
    assert_type(
        await session.act(Fibonacci, "/fibonacci", Fibonacci.Goal(order=8), timeout=30.0),
        Fibonacci.Result,
    )
    assert_type(await session.act(ACTION, "/fibonacci"), Any)
    async with session.goal(Fibonacci, "/fibonacci", feedback=100) as goal:
        assert_type(goal, Goal[Fibonacci.Result, Fibonacci.Feedback])
        async for feedback in goal:
            assert_type(feedback, Fibonacci.Feedback)
        assert_type(await goal.result(), Fibonacci.Result)
        async with session.attach(Fibonacci, "/fibonacci", goal.id) as same:
            assert_type(same, Goal[Fibonacci.Result, Fibonacci.Feedback])
    async with session.goal(ACTION, "/fibonacci") as named:
        assert_type(named, Goal[Any, Any])


async def drive(
    goal: rosasync.ServerGoal[Fibonacci.Goal, Fibonacci.Feedback],
) -> Fibonacci.Result:
    goal.feedback(Fibonacci.Feedback(sequence=[goal.request.order]))
    goal.feedback({"sequence": [1]})
    return Fibonacci.Result()


async def drive_with_mapping(goal: rosasync.ServerGoal[Any, Any]) -> dict[str, Any]:
    return {"sequence": [goal.request.order]}


async def is_possible(request: Fibonacci.Goal) -> bool:
    return bool(request.order > 0)


async def action_servers(session: rosasync.Session) -> None:
    server = session.serve_action(
        Fibonacci, "/fibonacci", drive, on_goal=is_possible, on_busy="replace", result_timeout=None
    )
    assert_type(server, rosasync.ActionServer[Fibonacci.Goal, Fibonacci.Result, Fibonacci.Feedback])
    session.serve_action(Fibonacci, "/fibonacci", drive_with_mapping, on_error=lambda g, e: None)
    async with session.serve_action(ACTION, "/fibonacci", drive_with_mapping) as named:
        assert_type(named, rosasync.ActionServer[Any, Any, Any])


def goals_of_threads(session: rosasync.Session) -> None:
    assert_type(session.from_thread.act(Fibonacci, "/fibonacci"), Fibonacci.Result)
    assert_type(session.from_thread.act(ACTION, "/fibonacci"), Any)


def goals_of_ticks(session: rosasync.Session) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal({"order": 8}, timeout=30.0)
    assert_type(proxy.get_feedback(), Fibonacci.Feedback | None)
    assert_type(proxy.get_result(), Fibonacci.Result | None)
    assert_type(AsyncActionProxy(session, ACTION, "/fibonacci").get_result(), Any | None)
