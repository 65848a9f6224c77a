"""A stock server that stops as its first request comes: ``python -m benchmarks.stopped``.

To its clients it is dead: nothing takes their requests or acknowledges them. Unlike one that was
killed, it can be woken and closed, and so leaves no shared memory behind.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from benchmarks.contestants.base import spinning
from benchmarks.pipes import READY, await_line
from benchmarks.work import Work, load_type

__all__ = ["stopping_server"]

PR_SET_PDEATHSIG = 1
"""From ``sys/prctl.h``: the signal that a process gets when its parent dies."""


@contextmanager
def stopping_server(work: Work) -> Iterator[None]:
    """Serves `work` in a process of its own, which stops as the first request comes."""
    command = (sys.executable, "-m", __name__, work.srv_type, *work.names)
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        await_line(process.stdout, READY)
        try:
            yield
        finally:
            process.send_signal(signal.SIGCONT)
            process.stdin.close()
            process.wait()


def main(srv_type: str, *srv_names: str) -> None:
    """Serves until standard input ends."""
    # A stopped process does not see that its standard input has ended: it dies with its parent.
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    requests = 0

    def stop(_request: Any, response: Any) -> Any:
        nonlocal requests
        requests += 1
        if requests == 1:
            os.kill(os.getpid(), signal.SIGSTOP)
        return response

    rclpy.init()
    node = rclpy.create_node("bench_stopped")
    for srv_name in srv_names:
        node.create_service(load_type(srv_type), srv_name, stop)
    with spinning(node, SingleThreadedExecutor()):
        os.write(sys.stdout.fileno(), READY)
        sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
