"""A process for each call, with its state in a SyncManager: the notes' first design."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy

from benchmarks.contestants.base import Windowed
from benchmarks.work import READY_TIMEOUT, Work, load_type, make_qos, make_request


class ProcessPerCall(Windowed):
    def setup(self, work: Work) -> None:
        """Import the modules before the processes are forked; each process initialises ROS."""
        load_type(work.srv_type)
        self._work = work
        self.services = work.services
        self._manager = multiprocessing.Manager()

    def start(self, service: int, over: Callable[[Exception | None], None]) -> None:
        state = self._manager.dict(outcome="running")
        process = multiprocessing.Process(target=_call, args=(state, self._work, service))
        process.start()
        threading.Thread(target=_watch, args=(process, state, over)).start()

    def close(self) -> None:
        self._manager.shutdown()


def _call(state: Any, work: Work, service: int) -> None:
    rclpy.init()
    node = rclpy.create_node("bench")
    client = node.create_client(
        load_type(work.srv_type), work.names[service], qos_profile=make_qos(work.depth)
    )
    if client.wait_for_service(timeout_sec=READY_TIMEOUT):
        future = client.call_async(make_request(work))
        rclpy.spin_until_future_complete(node, future, timeout_sec=READY_TIMEOUT)
        state["outcome"] = "answered" if future.done() else "timeout"
    node.destroy_node()
    rclpy.shutdown()


def _watch(process: Any, state: Any, over: Callable[[Exception | None], None]) -> None:
    process.join()
    outcome = "gone"
    with suppress(OSError, EOFError):
        outcome = state["outcome"]
    if outcome == "answered":
        over(None)
    else:
        over(TimeoutError() if outcome == "timeout" else RuntimeError(f"process {outcome}"))


CONTESTANTS = {"process-per-call": ProcessPerCall}
