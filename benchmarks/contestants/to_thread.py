"""``asyncio.to_thread(client.call)``: the blocking call runs in another thread."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Asynchronous, answered, make_clients, spinning
from benchmarks.work import CALL_TIMEOUT, Work, make_request


class ToThread(Asynchronous):
    async def open(self, work: Work) -> None:
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        self._clients = make_clients(node, work)
        self._request = make_request(work)

    async def call(self, service: int) -> None:
        client = self._clients[service]
        answered(await asyncio.to_thread(client.call, self._request, CALL_TIMEOUT))

    async def shut(self) -> None:
        self._stack.close()


CONTESTANTS = {"to-thread": ToThread}
