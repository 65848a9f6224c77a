"""A process of stock rclpy servers: ``python -m tests.support.servers``.

Services are made with ``node.create_service`` and spun by a ``SingleThreadedExecutor``. If a test
wants a response late, in another order or never, only sending it is put off.
"""

from __future__ import annotations

import asyncio
import ctypes
import heapq
import itertools
import os
import random
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

from rosasync._ros.discovery import own_ports
from tests.support.child import ChildError
from tests.support.echo import ECHO, fill, response_to, service_class
from tests.support.executor import run_in, spin
from tests.support.process import NodeProcess, ended, profile
from tests.support.times import LIMIT, TICK

__all__ = ["Delay", "Misbehaviour", "ServerProcess", "running", "wait_until_joined"]

Delay = float | tuple[float, float] | Literal["hold", "never"] | None
"""When a request is answered: at once (None), after a number of seconds, after a random number of
seconds between two, when `ServerProcess.release` is called, or never."""

Misbehaviour = Literal["twice", "thrice", "forging", "every second"] | None
"""What a server does wrong: it answers each request twice or thrice, or only every second one, or
it precedes each answer by others under the numbers of earlier requests and of none."""

REPLACED_AFTER = LIMIT / 2
"""Seconds after which a process that hangs in the middleware is replaced, between two tests."""


@contextmanager
def running(program: Path, *arguments: str) -> Iterator[None]:
    """Run a program of the documentation that serves the calls of this block."""
    command = (sys.executable, str(program), *arguments)
    with profile() as environment:
        server = subprocess.Popen(command, env=os.environ | environment, stderr=subprocess.DEVNULL)
        with ended(server):
            wait_until_joined(server, int(os.environ["ROS_DOMAIN_ID"]))
            yield


def wait_until_joined(program: subprocess.Popen[Any], domain: int) -> None:
    """Wait until a program has a participant in a ROS domain: it may take seconds to start."""
    end = time.monotonic() + 4 * LIMIT
    while not own_ports(domain, program.pid):
        assert program.poll() is None, f"{program.args!r} has ended"
        assert time.monotonic() < end, f"{program.args!r} joins no domain"
        time.sleep(TICK)


class ServerProcess(NodeProcess):
    """The parent's side of one such process.

    Args:
        node: the name of its node. Two that live at the same time need different ones.
        options: those of `NodeProcess`.
    """

    module = "tests.support.servers"

    def __init__(self, node: str = "stock_server", **options: Any) -> None:
        super().__init__(node, **options)
        self._serving = False

    async def serve(self, name: str, srv_type: str = ECHO, **options: Any) -> None:
        """Create a service without blocking the loop; the options are those of `serve_now`."""
        await asyncio.to_thread(self.serve_now, name, srv_type, **options)

    def serve_now(
        self,
        name: str,
        srv_type: str = ECHO,
        *,
        delay: Delay = None,
        skip: int = 0,
        depth: int | None = None,
        copies: int = 1,
        wrong: Misbehaviour = None,
    ) -> None:
        """Create a service, and return when it exists.

        Args:
            name: the service's name.
            srv_type: the name of its type.
            delay: when it answers.
            skip: how many requests to leave unanswered at first.
            depth: the depth of its history; None for the default of ROS, 10.
            copies: how many services to create under this name.
            wrong: what it does wrong.
        """
        arguments: dict[str, Any] = {
            "name": name,
            "srv_type": srv_type,
            "delay": delay,
            "skip": skip,
            "depth": depth,
            "copies": copies,
            "wrong": wrong,
        }
        if self._serving:
            self.ask_now("serve", **arguments)
            return
        self.ask_first("serve", patience=REPLACED_AFTER, **arguments)
        self._serving = True

    def works(self) -> bool:
        """Return whether it can still make something in the middleware; blocks.

        For one that is kept from test to test with its services. It may hang there (see `restart`),
        and is ended then.
        """
        with suppress(ChildError):
            self.ask_now("touch", patience=REPLACED_AFTER)
        return self.alive

    async def stop(self, name: str) -> None:
        """Destroy the services of this name."""
        await self.ask("stop", name=name)

    async def change(self, name: str, delay: Delay) -> None:
        """Change when requests are answered from now on; what is held stays held."""
        await self.ask("change", name=name, delay=delay)

    async def release(self, name: str, count: int | None = None, *, newest: bool = False) -> None:
        """Answer held requests, all or ``count`` of them, the oldest (or newest) first."""
        await self.ask("release", name=name, count=count, newest=newest)

    async def received(self, name: str, at_least: int = 0) -> list[str]:
        """Wait until ``at_least`` requests have come; return what all so far carried, in order."""
        result: list[str] = await self.ask("received", name=name, at_least=at_least)
        return result

    async def answered(self, name: str, at_least: int = 0) -> int:
        """Wait until ``at_least`` responses have been sent; return how many have been so far."""
        result: int = await self.ask("answered", name=name, at_least=at_least)
        return result

    def clear_now(self) -> None:
        """Destroy all services and forget what they counted; blocks."""
        self.ask_now("clear", patience=REPLACED_AFTER)
        self._serving = False


class _Later:
    """Runs functions at their time, in one thread."""

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._changed = threading.Condition()
        threading.Thread(target=self._run, daemon=True).start()

    def add(self, seconds: float, function: Callable[[], None]) -> None:
        with self._changed:
            heapq.heappush(self._heap, (time.monotonic() + seconds, next(self._order), function))
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._heap or self._heap[0][0] > time.monotonic():
                    wait = self._heap[0][0] - time.monotonic() if self._heap else None
                    self._changed.wait(wait)
                function = heapq.heappop(self._heap)[2]
            function()


class _Service:
    """A service name of the process: its rclpy services, when they answer, and its counts."""

    def __init__(self, delay: Delay, skip: int, later: _Later, wrong: Misbehaviour) -> None:
        self.delay = delay
        self.wrong = wrong
        self.received: list[str] = []
        self.answered = 0
        self.services: list[Any] = []
        self.changed = threading.Condition()
        self._skip = skip
        self._held: list[Callable[[], None]] = []
        self._later = later

    def add(self, service: Any) -> None:
        """Add a service created with ``handle``, to answer as this name does."""
        service.send_response = partial(self._respond, service.send_response)
        self.services.append(service)

    def handle(self, request: Any, response: Any) -> Any:
        with self.changed:
            self.received.append(response_to(request))
            self.changed.notify_all()
        return fill(request, response)

    def release(self, count: int | None, newest: bool) -> None:
        for _ in range(len(self._held) if count is None else count):
            self._held.pop(-1 if newest else 0)()

    def _respond(self, send: Callable[[Any, Any], None], response: Any, header: Any) -> None:
        answer = partial(self._answer, send, response, header)
        if self._skip:
            self._skip -= 1
        elif self.delay is None:
            answer()
        elif self.delay == "hold":
            self._held.append(answer)
        elif isinstance(self.delay, Sequence) and not isinstance(self.delay, str):
            self._later.add(random.uniform(*self.delay), answer)
        elif isinstance(self.delay, float | int):
            self._later.add(self.delay, answer)

    def _answer(self, send: Callable[[Any, Any], None], response: Any, header: Any) -> None:
        from rclpy.exceptions import InvalidHandle

        with suppress(InvalidHandle):
            if self.wrong == "forging":
                self._forge(send, response, header)
            times = {"twice": 2, "thrice": 3, "every second": len(self.received) % 2}
            for _ in range(times.get(self.wrong or "", 1)):
                send(response, header)
            with self.changed:
                self.answered += 1
                self.changed.notify_all()

    def _forge(self, send: Callable[[Any, Any], None], response: Any, header: Any) -> None:
        """Send a wrong response under numbers that no call waits for."""
        forged = type(response)(message="forged")
        identity = header.request_id
        number = _number_of(identity)
        true = number.value
        for other in (true - 1, true - 5, true + 1000, 0, -1, 2**63 - 1):
            number.value = other
            send(forged, identity)
        number.value = true


def _number_of(identity: Any) -> ctypes.c_int64:
    """Return the sequence number in an ``rmw_request_id_t``, which rclpy does not let one set.

    pybind11 keeps the address of a C++ object behind the head of the Python object.
    """
    address = ctypes.c_void_p.from_address(id(identity) + object.__basicsize__).value
    assert address is not None
    number = ctypes.c_int64.from_address(address + 16)
    assert number.value == identity.sequence_number
    return number


class _Servers:
    """The child's side: the commands, run in the thread that reads them."""

    def __init__(self, node: Any, executor: Any) -> None:
        self._node = node
        self._executor = executor
        self._later = _Later()
        self._services: dict[str, _Service] = {}

    def serve(
        self,
        name: str,
        srv_type: str,
        delay: Delay,
        skip: int,
        depth: int | None,
        copies: int,
        wrong: Misbehaviour,
    ) -> None:
        from rclpy.qos import QoSProfile, qos_profile_services_default

        qos = qos_profile_services_default if depth is None else QoSProfile(depth=depth)
        kept = self._services.get(name)
        service = kept or _Service(delay, skip, self._later, wrong)
        service.delay = delay
        self._services[name] = service

        def create() -> None:
            for _ in range(copies):
                service.add(
                    self._node.create_service(
                        service_class(srv_type), name, service.handle, qos_profile=qos
                    )
                )

        run_in(self._executor, create)

    def stop(self, name: str) -> None:
        service = self._services[name]

        def destroy() -> None:
            while service.services:
                self._node.destroy_service(service.services.pop())

        run_in(self._executor, destroy)

    def change(self, name: str, delay: Delay) -> None:
        self._services[name].delay = delay

    def release(self, name: str, count: int | None, newest: bool) -> None:
        run_in(self._executor, partial(self._services[name].release, count, newest))

    def received(self, name: str, at_least: int) -> list[str]:
        service = self._services[name]
        with service.changed:
            service.changed.wait_for(lambda: len(service.received) >= at_least, LIMIT)
            assert len(service.received) >= at_least, f"{len(service.received)} < {at_least}"
            return list(service.received)

    def answered(self, name: str, at_least: int) -> int:
        service = self._services[name]
        with service.changed:
            service.changed.wait_for(lambda: service.answered >= at_least, LIMIT)
            assert service.answered >= at_least, f"{service.answered} < {at_least}"
            return service.answered

    def touch(self) -> None:
        from std_msgs.msg import Empty

        def touch() -> None:
            self._node.destroy_publisher(self._node.create_publisher(Empty, "/_touched", 1))

        run_in(self._executor, touch)

    def clear(self) -> None:
        for name in self._services:
            self.stop(name)
        self._services.clear()


def main() -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(sys.argv[1])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spin(executor, _Servers(node, executor))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
