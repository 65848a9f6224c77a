"""A thread for each call, which claims a client from a store: the notes' second design."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import Windowed, answered, make_clients, spinning
from benchmarks.work import CALL_TIMEOUT, READY_TIMEOUT, Work, load_type, make_qos, make_request


class ProxyStore:
    """Clients by url and type, created on demand, claimed for one call and released after it."""

    def __init__(self, node: Any, depth: int | None) -> None:
        self._node = node
        self._qos = make_qos(depth)
        self._lock = threading.Lock()
        self._unclaimed: defaultdict[tuple[str, Any], list[Any]] = defaultdict(list)

    @contextmanager
    def claim(self, name: str, srv_type: Any) -> Any:
        client = self._take(name, srv_type)
        try:
            yield client
        finally:
            with self._lock:
                self._unclaimed[name, srv_type].append(client)

    def _take(self, name: str, srv_type: Any) -> Any:
        with self._lock:
            if self._unclaimed[name, srv_type]:
                return self._unclaimed[name, srv_type].pop()
            client = self._node.create_client(srv_type, name, qos_profile=self._qos)
        if not client.wait_for_service(timeout_sec=READY_TIMEOUT):
            raise RuntimeError(f"no server for {name}")
        return client


class ThreadPerCall(Windowed):
    def setup(self, work: Work) -> None:
        self.services = work.services
        rclpy.init()
        node = rclpy.create_node("bench")
        self._stack = ExitStack()
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))
        make_clients(node, work)
        self._names, self._srv_type = work.names, load_type(work.srv_type)
        self._store = ProxyStore(node, work.depth)
        self._request = make_request(work)

    def start(self, service: int, over: Callable[[Exception | None], None]) -> None:
        threading.Thread(target=self._run, args=(self._names[service], over)).start()

    def close(self) -> None:
        self._stack.close()

    def _run(self, name: str, over: Callable[[Exception | None], None]) -> None:
        try:
            with self._store.claim(name, self._srv_type) as client:
                answered(client.call(self._request, CALL_TIMEOUT))
        except Exception as exc:
            over(exc)
        else:
            over(None)


CONTESTANTS = {"thread-per-call": ThreadPerCall}
