"""``client.call`` from the callers' threads, with an executor in another thread."""

from __future__ import annotations

from contextlib import ExitStack

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Blocking, answered, make_clients, spinning
from benchmarks.work import CALL_TIMEOUT, Work, make_request


class ThreadedCall(Blocking):
    def setup(self, work: Work) -> None:
        self.services = work.services
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        self._clients = make_clients(node, work)
        self._request = make_request(work)

    def call(self, service: int) -> None:
        answered(self._clients[service].call(self._request, CALL_TIMEOUT))

    def close(self) -> None:
        self._stack.close()


CONTESTANTS = {"call": ThreadedCall}
