"""``call_async``, whose future is polled in the loop with ``sleep(0)``; executor in a thread."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Asynchronous, make_clients, spinning
from benchmarks.work import Work, make_request


class PolledFuture(Asynchronous):
    async def open(self, work: Work) -> None:
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        self._clients = make_clients(node, work)
        self._request = make_request(work)

    async def call(self, service: int) -> None:
        future = self._clients[service].call_async(self._request)
        while not future.done():  # noqa: ASYNC110 - the measured pattern
            await asyncio.sleep(0)
        future.result()

    async def shut(self) -> None:
        self._stack.close()


CONTESTANTS = {"polled": PolledFuture}
