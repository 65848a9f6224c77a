"""``client.call`` in a thread pool."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Windowed, answered, make_clients, spinning
from benchmarks.work import CALL_TIMEOUT, Work, make_request

THREADS = 8


class ThreadPool(Windowed):
    def setup(self, work: Work) -> None:
        self.services = work.services
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        self._clients = make_clients(node, work)
        self._pool = self._stack.enter_context(ThreadPoolExecutor(THREADS))
        self._request = make_request(work)

    def start(self, service: int, over: Callable[[Exception | None], None]) -> None:
        future = self._pool.submit(self._clients[service].call, self._request, CALL_TIMEOUT)
        future.add_done_callback(lambda done: over(_outcome(done)))

    def close(self) -> None:
        self._stack.close()


def _outcome(future: Future[Any]) -> Exception | None:
    try:
        answered(future.result())
    except Exception as exc:
        return exc
    return None


CONTESTANTS = {"pool": ThreadPool}
