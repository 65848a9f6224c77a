"""Leaves with a process for each call, its state in a SyncManager: the notes' first design."""

from __future__ import annotations

import multiprocessing
from multiprocessing.managers import SyncManager
from typing import Any

import rclpy

from benchmarks.ticking import Leaf, Stamps, Ticked, call_timeout, watch_rclpy
from benchmarks.work import READY_TIMEOUT, Work, load_type, make_qos, make_request


class ProcessLeaf:
    def __init__(self, manager: SyncManager, work: Work, stamps: Stamps) -> None:
        self._work = work
        self._stamps = stamps
        self._data: Any = manager.dict(state="idle", sent=0, taken=0)
        self.process: multiprocessing.Process | None = None

    def start(self) -> None:
        self._data["state"] = "running"
        self.process = multiprocessing.Process(
            target=_call, args=(self._data, self._work, self._stamps)
        )
        self.process.start()

    def state(self) -> str:
        return str(self._data["state"])

    def look(self) -> bool:
        state = self.state()
        if state == "running":
            return False
        assert self.process is not None
        self.process.join()
        if state != "answered":
            raise TimeoutError("no response")
        self._stamps.sent = int(self._data["sent"])
        self._stamps.taken = int(self._data["taken"])
        return True


class ProcessPerCall(Ticked):
    def setup(self, work: Work) -> None:
        """Import the modules before the processes are forked; each process initialises ROS."""
        self.stamps = watch_rclpy()
        load_type(work.srv_type)
        self._work = work
        self._manager = multiprocessing.Manager()
        self._leaves: list[ProcessLeaf] = []

    def leaf(self) -> Leaf:
        leaf = ProcessLeaf(self._manager, self._work, self.stamps)
        self._leaves.append(leaf)
        return leaf

    def close(self) -> None:
        for leaf in self._leaves:
            if leaf.process is not None:
                leaf.process.kill()
                leaf.process.join()
        self._manager.shutdown()


def _call(data: Any, work: Work, stamps: Stamps) -> None:
    rclpy.init()
    node = rclpy.create_node("bench")
    client = node.create_client(
        load_type(work.srv_type), work.names[0], qos_profile=make_qos(work.depth)
    )
    client.wait_for_service(timeout_sec=READY_TIMEOUT)
    future = client.call_async(make_request(work))
    rclpy.spin_until_future_complete(node, future, timeout_sec=call_timeout(work))
    data.update(sent=stamps.sent, taken=stamps.taken)
    data["state"] = "answered" if future.done() else "timeout"
    node.destroy_node()
    rclpy.shutdown()


CONTESTANTS = {"tick-processes": ProcessPerCall}
