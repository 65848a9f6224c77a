"""A process that floods one service: ``python -m tests.support.flood``.

A bare loop keeps requests outstanding. It gives a lost one up early, and sends another.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.support.child import Child, serve_commands
from tests.support.echo import ECHO, service_class
from tests.support.times import LIMIT

__all__ = ["CALLERS", "flooding"]

CALLERS = 8
"""Requests that are kept outstanding: fewer than the ten that a stock server queues."""
LOST_AFTER = 0.1
"""Seconds after which a request counts as lost."""
ENOUGH = 100
"""Answers after which the server is busy for certain."""


@contextmanager
def flooding(
    name: str, srv_type: str = ECHO, callers: int = CALLERS, **options: Any
) -> Iterator[None]:
    """Flood a service in this block, at whose beginning its server is busy.

    Args:
        name: the service's name.
        srv_type: the name of its type.
        callers: how many requests to keep outstanding.
        options: those of `Child`.
    """
    with Child("tests.support.flood", **options) as child:
        child.ask_now("start", name=name, srv_type=srv_type, callers=callers)
        yield
        assert child.ask_now("stop") > ENOUGH


class _Flood:
    """The child's side."""

    def __init__(self) -> None:
        self._answered = 0
        self._busy, self._enough = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=lambda: None)

    def start(self, name: str, srv_type: str, callers: int) -> None:
        self._thread = threading.Thread(target=self._run, args=(name, srv_type, callers))
        self._thread.start()
        assert self._busy.wait(LIMIT), f"{name} does not answer"

    def stop(self) -> int:
        """Return how many requests were answered."""
        self._enough.set()
        self._thread.join()
        return self._answered

    def _run(self, name: str, srv_type: str, callers: int) -> None:
        import rclpy
        from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

        rclpy.init()
        node = rclpy.create_node("flood")
        service = service_class(srv_type)
        client = node.create_client(service, name)
        wait_set = _rclpy.WaitSet(0, 0, 0, 1, 0, 0, node.context.handle)
        request, out = service.Request(), dict[int, float]()
        if client.wait_for_service(LIMIT):
            while not self._enough.is_set():
                while len(out) < callers:
                    out[client.handle.send_request(request)] = time.monotonic()
                wait_set.clear_entities()
                wait_set.add_client(client.handle)
                wait_set.wait(round(LOST_AFTER * 1e9))
                while (taken := client.handle.take_response(service.Response))[0] is not None:
                    self._answered += out.pop(taken[0].request_id.sequence_number, None) is not None
                lost = time.monotonic() - LOST_AFTER
                while out and out[oldest := next(iter(out))] < lost:
                    del out[oldest]
                if self._answered > ENOUGH:
                    self._busy.set()
        wait_set.destroy_when_not_in_use()
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    flood = _Flood()
    serve_commands(flood)
    flood.stop()
