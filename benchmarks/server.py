"""The server process of the benchmarks: stock rclpy, a bare loop or rosasync.

Services are created and destroyed with each turn, so that the server has nothing else to do.
"""

from __future__ import annotations

import ctypes
import dataclasses
import heapq
import os
import select
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from benchmarks.contestants.base import spinning
from benchmarks.meter import usage
from benchmarks.work import (
    Work,
    async_handler,
    handled,
    load_type,
    make_handler,
    make_qos,
    make_response,
)
from tests.support.child import Child, serve_commands

__all__ = ["Server", "WorkServer"]

PR_SET_PDEATHSIG = 1
"""From ``sys/prctl.h``: the signal that a process gets when its parent dies."""
LEAN_DEPTH = 1000
WAIT_SET_LIMIT = 16
"""With more services, building the wait set would be most of the server's work."""


class Lean(ABC):
    """A bare loop in a thread, which waits, takes requests and answers them when they are due."""

    def __init__(self, node: Any, work: Work) -> None:
        self._node = node
        self._work = work
        srv_type = load_type(work.srv_type)
        qos = make_qos(work.depth or LEAN_DEPTH)
        nothing = make_handler(work)
        self.services = [
            node.create_service(srv_type, name, nothing, qos_profile=qos).handle
            for name in work.names
        ]
        self._request_type = srv_type.Request
        self._response = make_response(work)
        self._due: list[tuple[float, int, int, Any]] = []
        self._taken = 0
        self._ending = False
        self._thread = threading.Thread(target=self._loop)

    @abstractmethod
    def wait(self, seconds: float | None) -> Iterable[int]:
        """Wait for requests and return their services, or none after `seconds`."""

    @abstractmethod
    def wake(self) -> None:
        """End a wait, from another thread."""

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        self._ending = True
        self.wake()
        self._thread.join()
        self._node.destroy_node()
        rclpy.shutdown()

    def _loop(self) -> None:
        while not self._ending:
            left = max(0.0, self._due[0][0] - time.monotonic()) if self._due else None
            for service in self.wait(left):
                self._take(service)
            while self._due and self._due[0][0] <= time.monotonic():
                _, _, service, header = heapq.heappop(self._due)
                self.services[service].service_send_response(self._response, header)

    def _take(self, service: int) -> None:
        handle = self.services[service]
        delay = self._work.delay(service)
        while (taken := handle.service_take_request(self._request_type))[0] is not None:
            header = taken[1].request_id
            if delay:
                self._taken += 1
                due = (time.monotonic() + delay, self._taken, service, header)
                heapq.heappush(self._due, due)
            else:
                handle.service_send_response(self._response, header)


class WaitSetServer(Lean):
    """Sleeps in one wait set, which is created once."""

    def __init__(self, node: Any, work: Work) -> None:
        super().__init__(node, work)
        context = node.context.handle
        self._guard = _rclpy.GuardCondition(context)
        self._wait_set = _rclpy.WaitSet(0, 1, 0, 0, len(self.services), 0, context)

    def wait(self, seconds: float | None) -> Iterable[int]:
        self._wait_set.clear_entities()
        self._wait_set.add_guard_condition(self._guard)
        for handle in self.services:
            self._wait_set.add_service(handle)
        self._wait_set.wait(-1 if seconds is None else round(seconds * 1e9))
        ready = self._wait_set.get_ready_entities("service")
        return [i for i, handle in enumerate(self.services) if handle.pointer in ready]

    def wake(self) -> None:
        self._guard.trigger_guard_condition()

    def close(self) -> None:
        super().close()
        self._wait_set.destroy_when_not_in_use()
        self._guard.destroy_when_not_in_use()


class EventServer(Lean):
    """Sleeps on one eventfd for each service, which the middleware signals; for many services."""

    def __init__(self, node: Any, work: Work) -> None:
        super().__init__(node, work)
        self._epoll = select.epoll()
        self._of: dict[int, int] = {}
        self._wake = self._watch(None)
        for service, handle in enumerate(self.services):
            signal_requests(handle, self._watch(service))

    def wait(self, seconds: float | None) -> Iterable[int]:
        for fd, _ in self._epoll.poll(seconds):
            os.eventfd_read(fd)
            if fd != self._wake:
                yield self._of[fd]

    def wake(self) -> None:
        os.eventfd_write(self._wake, 1)

    def close(self) -> None:
        for handle in self.services:
            signal_requests(handle, None)
        super().close()
        for fd in (self._wake, *self._of):
            os.close(fd)
        self._epoll.close()

    def _watch(self, service: int | None) -> int:
        fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._epoll.register(fd, select.EPOLLIN)
        if service is not None:
            self._of[fd] = service
        return fd


def signal_requests(service: Any, fd: int | None) -> None:
    """Let the middleware count a service's new requests on an eventfd; None stops it."""
    on_request = ctypes.CDLL("librcl.so").rcl_service_set_on_new_request_callback
    on_request.argtypes = [ctypes.c_void_p] * 3
    callback = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
    if on_request(service.pointer, None if fd is None else callback, fd):
        raise RuntimeError("the middleware does not accept a request callback")


class Server:
    """Answers the runner's requests. Its methods are the commands."""

    def __init__(self) -> None:
        self._stack = ExitStack()

    def serve(self, work: dict[str, Any]) -> None:
        self._serve(Work.from_json(work))

    def handled(self, begin: float, end: float) -> int:
        """How many requests the handlers that take time have finished between these times."""
        return sum(begin <= at < end for at in handled)

    def usage(self) -> dict[str, Any]:
        return usage().to_json()

    def end(self) -> None:
        self._stack.close()

    def _serve(self, work: Work) -> None:
        if work.server == "stopped":
            self._stack.enter_context(stopping_server(work))
            return
        if work.server not in STOCK:
            # Only now: a stock server's process has nothing of rosasync.
            from benchmarks.servers import rosasync_server

            self._stack.enter_context(rosasync_server(work))
            return
        rclpy.init()
        node = rclpy.create_node("bench_server")
        if work.server == "lean":
            lean = (EventServer if work.services > WAIT_SET_LIMIT else WaitSetServer)(node, work)
            lean.start()
            self._stack.callback(lean.close)
            return
        if any(work.delays):
            raise ValueError("the stock server answers at once: a delay would block its executor")
        srv_type, qos = load_type(work.srv_type), make_qos(work.depth)
        handler = STOCK[work.server](work)
        for name in work.names:
            node.create_service(srv_type, name, handler, qos_profile=qos)
        self._stack.enter_context(spinning(node, SingleThreadedExecutor()))


def make_stopping_handler(work: Work) -> Callable[[Any, Any], Any]:
    """Return a handler that stops the process as the first request comes.

    To its clients it is dead: nothing takes their requests or acknowledges them. Unlike one that
    was killed, it can be woken and closed, and so leaves no shared memory behind.
    """
    # A stopped process does not see that its standard input has ended: it dies with its parent.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    stops = iter((True,))

    def stop(_request: Any, response: Any) -> Any:
        if next(stops, False):
            os.kill(os.getpid(), signal.SIGSTOP)
        return response

    return stop


STOCK: Mapping[str, Callable[[Work], Callable[[Any, Any], Any]]] = {
    "stock": make_handler,
    "stock-async": async_handler,
    "stopping": make_stopping_handler,
    "lean": make_handler,
}
"""The servers without rosasync, with what makes the handler of each."""


@contextmanager
def stopping_server(work: Work) -> Iterator[None]:
    """Serve `work` in a process of its own, which stops as the first request comes."""
    with WorkServer(dataclasses.replace(work, server="stopping")) as server:
        yield
        server.signal(signal.SIGCONT)


class WorkServer(Child):
    """The parent's side of such a process that serves one work, and does so once this returns.

    Args:
        work: what to serve.
        options: those of `Child`.
    """

    def __init__(self, work: Work, **options: Any) -> None:
        super().__init__("benchmarks.server", quiet=True, **options)
        self.ask_now("serve", work=work.to_json())


def main() -> None:
    # A shell that starts the benchmarks in the background ignores SIGINT, and children inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    server = Server()
    with suppress(KeyboardInterrupt):
        serve_commands(server)
    server.end()


if __name__ == "__main__":
    main()
