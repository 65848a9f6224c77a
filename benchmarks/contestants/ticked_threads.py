"""Leaves with a thread for each call, which claims a client: the notes' second design."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import answered, make_clients, spinning
from benchmarks.contestants.thread_per_call import ProxyStore
from benchmarks.ticking import Leaf, Ticked, call_timeout, watch_rclpy
from benchmarks.work import Work, load_type, make_request


class ThreadLeaf:
    def __init__(self, store: ProxyStore, work: Work) -> None:
        self._store = store
        self._name, self._srv_type = work.names[0], load_type(work.srv_type)
        self._request = make_request(work)
        self._timeout = call_timeout(work)
        self._lock = threading.Lock()
        self._data: dict[str, Any] = {"state": "idle", "error": None}

    def start(self) -> None:
        with self._lock:
            self._data["state"] = "running"
        # A daemon, because the worker may end with pending calls.
        threading.Thread(target=self._run, daemon=True).start()

    def state(self) -> str:
        with self._lock:
            return str(self._data["state"])

    def look(self) -> bool:
        state = self.state()
        if state == "error":
            raise self._data["error"]
        return state == "answered"

    def _run(self) -> None:
        try:
            with self._store.claim(self._name, self._srv_type) as client:
                answered(client.call(self._request, self._timeout))
        except Exception as exc:
            with self._lock:
                self._data.update(state="error", error=exc)
        else:
            with self._lock:
                self._data["state"] = "answered"


class ThreadPerCall(Ticked):
    def setup(self, work: Work) -> None:
        self.stamps = watch_rclpy()
        self._work = work
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        make_clients(node, work)
        self._store = ProxyStore(node, work.depth)

    def leaf(self) -> Leaf:
        return ThreadLeaf(self._store, self._work)

    def close(self) -> None:
        self._stack.close()


CONTESTANTS = {"tick-threads": ThreadPerCall}
