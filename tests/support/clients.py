"""A process of stock rclpy clients: ``python -m tests.support.clients``.

It calls services of the echoing type with ``client.call_async`` or, in threads, ``client.call``.
It reports how many responses came, were wrong, or never came.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, Literal

from tests.support.child import Unanswered, serve_commands
from tests.support.echo import ECHO, answer_to, request_of, service_class
from tests.support.process import NodeProcess
from tests.support.times import LIMIT, TICK

__all__ = ["ClientProcess", "Tally"]


@dataclass
class Tally:
    """How the calls of one run ended."""

    answered: int = 0
    wrong: int = 0
    lost: int = 0

    @property
    def calls(self) -> int:
        return self.answered + self.wrong + self.lost

    def count(self, text: str, response: Any) -> None:
        """Count one call that sent ``text``; the response is None if none came."""
        if response is None:
            self.lost += 1
        elif answer_to(response) == text:
            self.answered += 1
        else:
            self.wrong += 1


class ClientProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.support.clients"

    async def start(
        self,
        name: str,
        calls: int | None,
        *,
        way: Literal["call_async", "call"] = "call_async",
        in_flight: int = 1,
        clients: int = 1,
        depth: int | None = None,
        block: float = 0.0,
        timeout: float = LIMIT,
        tag: str = "",
    ) -> None:
        """Begin a run, which goes on in the child while the test does something else.

        Args:
            name: the service's name.
            calls: how many calls each client makes; None to go on until `result` is called.
            way: how to call. ``call`` takes a thread for each request in flight.
            in_flight: how many requests each client has outstanding at once.
            clients: how many rclpy clients, all on one node.
            depth: the depth of their history; None for the default of ROS, 10.
            block: seconds for which the process is busy before it takes its next responses.
            timeout: seconds after which a call without a response counts as lost.
            tag: the beginning of the text of every request, which identifies the process.
        """
        await self.ask(
            "start",
            name=name,
            calls=calls,
            way=way,
            in_flight=in_flight,
            clients=clients,
            depth=depth,
            block=block,
            timeout=timeout,
            tag=tag or str(self.pid),
        )

    async def give_up(self) -> None:
        """End a run of ``call_async`` now: what is out counts as lost."""
        await self.ask("give_up")

    async def result(self) -> Tally:
        """End the run if it has no end of its own, and wait for the result."""
        return Tally(**await self.ask("result"))

    async def run(self, name: str, calls: int, **options: Any) -> Tally:
        """Make calls and wait until they have ended; the options are those of `start`."""
        try:
            await self.start(name, calls, **options)
            return await self.result()
        except Unanswered:
            await asyncio.to_thread(self.restart)
            await self.start(name, calls, **options)
            return await self.result()


@dataclass(frozen=True)
class _Run:
    name: str
    calls: int | None
    way: str
    in_flight: int
    clients: int
    depth: int | None
    block: float
    timeout: float
    tag: str
    enough: threading.Event = field(default_factory=threading.Event)
    given_up: threading.Event = field(default_factory=threading.Event)
    results: queue.SimpleQueue[Tally | Exception] = field(default_factory=queue.SimpleQueue)


class _Runner:
    """The child's side: one run after the other, in the main thread."""

    def __init__(self, node: Any) -> None:
        self._runs: queue.SimpleQueue[_Run | None] = queue.SimpleQueue()
        self._last: _Run | None = None
        self._node = node

    def start(self, **options: Any) -> None:
        """Begin a run, after ending one that a failed test left behind."""
        self._end_last()
        self._last = _Run(**options)
        self._runs.put(self._last)

    def give_up(self) -> None:
        assert self._last is not None
        self._last.given_up.set()

    def result(self) -> dict[str, int]:
        assert self._last is not None
        self._end_last()
        result = self._last.results.get(timeout=3 * LIMIT)
        if isinstance(result, Exception):
            raise result
        return asdict(result)

    def stop(self) -> None:
        """End the work, and the current run."""
        self._end_last()
        self._runs.put(None)

    def _end_last(self) -> None:
        if self._last is not None:
            self._last.enough.set()

    def work(self) -> None:
        while (run := self._runs.get()) is not None:
            try:
                run.results.put(self._run(run))
            except Exception as error:
                run.results.put(error)

    def _run(self, run: _Run) -> Tally:
        from rclpy.qos import QoSProfile, qos_profile_services_default

        qos = qos_profile_services_default if run.depth is None else QoSProfile(depth=run.depth)
        clients = [
            self._node.create_client(service_class(ECHO), run.name, qos_profile=qos)
            for _ in range(run.clients)
        ]
        try:
            for client in clients:
                assert client.wait_for_service(LIMIT), f"no server for {run.name}"
            return (self._call_async if run.way == "call_async" else self._call)(run, clients)
        finally:
            for client in clients:
                self._node.destroy_client(client)

    def _texts(self, run: _Run, index: int) -> Callable[[], str | None]:
        """Return a function that returns the text of each request of a client, then None."""
        count = 0

        def next_text() -> str | None:
            nonlocal count
            over = run.enough.is_set() if run.calls is None else count == run.calls
            if over or run.given_up.is_set():
                return None
            count += 1
            return f"{run.tag}-{index}-{count}"

        return next_text

    def _call_async(self, run: _Run, clients: list[Any]) -> Tally:
        from rclpy.executors import SingleThreadedExecutor

        tally = Tally()
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        texts = [self._texts(run, index) for index in range(len(clients))]
        out: list[dict[Any, tuple[str, float]]] = [{} for _ in clients]
        working = True
        while working:
            working = False
            for client, next_text, pending in zip(clients, texts, out, strict=True):
                while len(pending) < run.in_flight and (text := next_text()) is not None:
                    future = _accepted(partial(client.call_async, request_of(text)))
                    if future is None:
                        tally.count(text, None)
                    else:
                        pending[future] = (text, time.monotonic() + run.timeout)
                working = working or bool(pending)
            _spin(executor, run.block)
            for client, pending in zip(clients, out, strict=True):
                _settle(client, pending, tally, given_up=run.given_up.is_set())
        executor.remove_node(self._node)
        executor.shutdown()
        return tally

    def _call(self, run: _Run, clients: list[Any]) -> Tally:
        from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

        tally = Tally()
        lock = threading.Lock()
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)

        def spin() -> None:
            with suppress(ExternalShutdownException):
                executor.spin()

        def caller(client: Any, next_text: Callable[[], str | None]) -> None:
            while True:
                with lock:
                    text = next_text()
                if text is None:
                    return
                response = _call_blocking(client, text, run.timeout)
                with lock:
                    tally.count(text, response)

        spinner = threading.Thread(target=spin)
        spinner.start()
        with ThreadPoolExecutor(run.in_flight * len(clients)) as threads:
            futures = [
                threads.submit(caller, client, next_text)
                for index, client in enumerate(clients)
                for next_text in [self._texts(run, index)]
                for _ in range(run.in_flight)
            ]
        executor.shutdown()
        spinner.join()
        executor.remove_node(self._node)
        for future in futures:
            future.result()
        return tally


def _spin(executor: Any, block: float) -> None:
    """Run one callback. If the process is to be busy, block first and then run several."""
    if not block:
        executor.spin_once(TICK)
        return
    time.sleep(block)
    end = time.monotonic() + TICK / 10
    while (left := end - time.monotonic()) > 0:
        executor.spin_once(left)


def _settle(
    client: Any, pending: dict[Any, tuple[str, float]], tally: Tally, *, given_up: bool
) -> None:
    """Count the calls that have been answered or lost, and remove them."""
    now = time.monotonic()
    for future, (text, deadline) in list(pending.items()):
        if future.done():
            tally.count(text, future.result())
        elif given_up or now > deadline:
            client.remove_pending_request(future)
            tally.count(text, None)
        else:
            continue
        del pending[future]


def _call_blocking(client: Any, text: str, timeout: float) -> Any:
    try:
        return _accepted(partial(client.call, request_of(text), timeout_sec=timeout))
    except TimeoutError:
        return None


def _accepted(send: Callable[[], Any]) -> Any:
    """Send a request up to three times; None if the middleware refuses it.

    On a busy machine the middleware may not get its own locks, or an acknowledgement, within 0.1 s.
    It has not sent the request then.
    """
    from rclpy.impl.implementation_singleton import rclpy_implementation

    for _ in range(3):
        with suppress(rclpy_implementation.RCLError):
            return send()
    return None


def main() -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("stock_client")
    runner = _Runner(node)

    def read() -> None:
        serve_commands(runner)
        runner.stop()

    reader = threading.Thread(target=read)
    reader.start()
    runner.work()
    reader.join()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
