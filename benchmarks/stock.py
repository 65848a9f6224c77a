"""A stock server that can be interrupted and killed: ``python -m benchmarks.stock NAME SECONDS``.

Its callback sleeps for a number of seconds. Ctrl-C ends it, as a launch file does.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import TracebackType

import rclpy
from rclpy.executors import ExternalShutdownException

from benchmarks.pipes import READY, ROOT, await_line
from benchmarks.work import Work, load_type, make_handler

__all__ = ["StockServer"]

PATIENCE = 10.0


class StockServer:
    """The parent's side: such a server in a process of its own, which is up once this returns."""

    def __init__(
        self,
        srv_name: str,
        seconds: float = 0.0,
        *,
        prefix: Sequence[str] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self._process = subprocess.Popen(
            [*prefix, sys.executable, "-m", __name__, srv_name, str(seconds)],
            env={**os.environ, **(environment or {})},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=ROOT,
        )
        assert self._process.stdout is not None
        await_line(self._process.stdout, READY)

    def interrupt(self) -> float:
        """Send SIGINT; return when, on the monotonic clock. It is gone once `close` returns."""
        self._process.send_signal(signal.SIGINT)
        return time.monotonic()

    def kill(self) -> float:
        """End it as a crash does; return when, on the monotonic clock."""
        self._process.kill()
        return time.monotonic()

    def close(self) -> None:
        """Interrupt it unless it has ended, wait for the end, and kill it if it does not end."""
        if self._process.poll() is None:
            self.interrupt()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(PATIENCE)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def __enter__(self) -> StockServer:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self.close()


def main(srv_name: str, seconds: float) -> None:
    """Serve until interrupted."""
    # A shell that starts the benchmarks in the background ignores SIGINT, and children inherit it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    work = Work(handling=seconds)
    rclpy.init()
    node = rclpy.create_node("bench_stock")
    node.create_service(load_type(work.srv_type), srv_name, make_handler(work))
    os.write(sys.stdout.fileno(), READY)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
