"""Handlers that echo, in every form that a server accepts, and helpers for their tests."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, TypeAlias

from diagnostic_msgs.srv import AddDiagnostics

from rosasync import ServiceCall, ServiceServer
from rosasync._core.ports import Unmatched
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.times import until

if TYPE_CHECKING:
    from rosasync import Session

__all__ = [
    "FORMS",
    "AnyCall",
    "AnyServer",
    "Gate",
    "Holder",
    "Response",
    "UnmatchedClients",
    "ask",
    "discard",
    "echo_call",
    "echo_of",
    "serving",
    "settled",
]

AnyCall: TypeAlias = ServiceCall[Any, Any]
AnyServer: TypeAlias = ServiceServer[Any, Any]
Response = AddDiagnostics.Response


def echo_of(request: Any) -> Any:
    """The response that echoes a request."""
    return Response(success=True, message=request.load_namespace)


def echo_call(call: AnyCall) -> Any:
    """A handler that echoes."""
    return echo_of(call.request)


def ask(session: Session, name: str, text: str, **options: Any) -> asyncio.Task[str]:
    """Call a service of the echoing type; the task gives the text that comes back."""

    async def call() -> str:
        return answer_to(await session.call(ECHO, name, request_of(text), **options))

    return asyncio.create_task(call())


async def discard(*tasks: asyncio.Task[Any]) -> None:
    """Cancel tasks, and retrieve their errors so that asyncio does not log them."""
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


class Gate(asyncio.Event):
    """A handler that echoes once it is set."""

    async def __call__(self, call: AnyCall) -> Any:
        await self.wait()
        return echo_of(call.request)


class Holder:
    """A handler that keeps its calls, for the test to answer."""

    def __init__(self) -> None:
        self.calls: list[AnyCall] = []

    def __call__(self, call: AnyCall) -> None:
        self.calls.append(call)

    async def held(self, count: int) -> list[AnyCall]:
        """Wait until ``count`` calls have arrived, and return all."""
        await until(lambda: len(self.calls) >= count)
        return self.calls


def _plain_pair(request: Any, response: Any) -> Any:
    response.message = request.load_namespace
    return response


async def _async_pair(request: Any, response: Any) -> Any:
    await asyncio.sleep(0)
    return _plain_pair(request, response)


def _plain_call(call: AnyCall) -> Any:
    call.response.message = call.request.load_namespace
    return call.response


async def _async_call(call: AnyCall) -> Any:
    await asyncio.sleep(0)
    return _plain_call(call)


def _responding(call: AnyCall) -> None:
    call.respond(echo_of(call.request))


async def _responding_later(call: AnyCall) -> None:
    asyncio.get_running_loop().call_soon(call.respond, echo_of(call.request))


FORMS: dict[str, Callable[..., Any] | None] = {
    "plain, request and response": _plain_pair,
    "async, request and response": _async_pair,
    "plain, call": _plain_call,
    "async, call": _async_call,
    "plain, respond": _responding,
    "async, respond after the return": _responding_later,
    "iteration": None,
}
"""Each form of a server that echoes; None for iteration."""


@asynccontextmanager
async def serving(session: Session, name: str, form: str) -> AsyncIterator[AnyServer]:
    """Serve an echo in one of the forms."""
    async with session.serve(ECHO, name, FORMS[form]) as server:
        if FORMS[form] is not None:
            yield server
            return

        async def iterate() -> None:
            async for call in server:
                call.respond(echo_of(call.request))

        task = asyncio.create_task(iterate())
        yield server
    await task


async def settled(server: AnyServer) -> None:
    """Wait until nothing runs, waits or is unanswered."""

    def idle() -> bool:
        now = server.statistics()
        return now.running == now.waiting == now.unanswered == 0

    try:
        await until(idle)
    except AssertionError:
        raise AssertionError(f"not settled: {server.statistics()}") from None


class UnmatchedClients:
    """Makes a server's responses fail as if their clients were not discovered yet.

    Attributes:
        unmatched: whether sends fail now.
        attempts: how many have failed.
    """

    def __init__(self, server: AnyServer) -> None:
        self.unmatched = True
        self.attempts = 0
        port = server._port
        self._send = port.send
        port.send = self._fail_or_send  # type: ignore[method-assign]

    def _fail_or_send(self, header: Any, response: Any) -> None:
        if self.unmatched:
            self.attempts += 1
            raise Unmatched("not yet")
        self._send(header, response)
