"""``call_async``, whose future completes an asyncio future; executor in a thread."""

from __future__ import annotations

import asyncio
from contextlib import AbstractAsyncContextManager, ExitStack, nullcontext
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Asynchronous, make_clients, spinning
from benchmarks.work import Work, make_request

STOCK_DEPTH = 10


class CallAsync(Asynchronous):
    """Calls with a deadline; with a window, the calls wait for a semaphore."""

    def __init__(self, window: int | None = None) -> None:
        self._size = window

    async def open(self, work: Work) -> None:
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        self._clients = make_clients(node, work)
        self._request = make_request(work)
        self._timeout = work.timeout
        self._window: AbstractAsyncContextManager[Any] = (
            nullcontext() if self._size is None else asyncio.Semaphore(self._size)
        )

    async def call(self, service: int) -> None:
        async with asyncio.timeout(self._timeout), self._window:
            await _response(self._clients[service], self._request)

    async def shut(self) -> None:
        self._stack.close()


async def _response(client: Any, request: Any) -> None:
    loop = asyncio.get_running_loop()
    answered = asyncio.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: loop.call_soon_threadsafe(answered.set))
    try:
        await answered.wait()
        future.result()
    finally:
        client.remove_pending_request(future)


CONTESTANTS = {
    "call-async": CallAsync,
    "semaphore": partial(CallAsync, STOCK_DEPTH),
}
