"""``spin_once(timeout_sec=0)`` in an asyncio task: no threads, but a core at 100 %."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Asynchronous, make_clients
from benchmarks.work import CALL_TIMEOUT, Work, make_request


class SpinInTask(Asynchronous):
    async def open(self, work: Work) -> None:
        rclpy.init()
        self._node = rclpy.create_node("bench")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._spinning = asyncio.create_task(self._spin())
        self._clients = make_clients(self._node, work)
        self._request = make_request(work)

    async def call(self, service: int) -> None:
        response: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        future = self._clients[service].call_async(self._request)
        future.add_done_callback(lambda done: response.set_result(done.result()))
        async with asyncio.timeout(CALL_TIMEOUT):
            await response

    async def shut(self) -> None:
        self._spinning.cancel()
        with suppress(asyncio.CancelledError):
            await self._spinning
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown()

    async def _spin(self) -> None:
        while rclpy.ok():
            self._executor.spin_once(timeout_sec=0)
            await asyncio.sleep(0)


CONTESTANTS = {"spin-task": SpinInTask}
