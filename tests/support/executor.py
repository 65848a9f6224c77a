"""An executor in a child process, whose commands come from its parent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from tests.support.child import serve_commands
from tests.support.times import LIMIT

__all__ = ["run_in", "spin"]

T = TypeVar("T")


def spin(executor: Any, commands: object, at_end: Callable[[], object] = lambda: None) -> None:
    """Spin in this thread and answer commands in another one, until the parent closes the pipe.

    Args:
        executor: the executor, which is shut down then.
        commands: those of `serve_commands`.
        at_end: called before the executor stops, in the other thread.
    """
    finished = threading.Event()

    def read() -> None:
        serve_commands(commands)
        at_end()
        finished.set()
        executor.create_task(lambda: None)

    reader = threading.Thread(target=read)
    reader.start()
    while not finished.is_set():
        executor.spin_once()
    reader.join()
    executor.shutdown()


def run_in(executor: Any, function: Callable[[], T]) -> T:
    """Run a function in the thread that spins: rclpy has crashed on changes from another one."""
    done = threading.Event()
    task = executor.create_task(function)
    task.add_done_callback(lambda _: done.set())
    assert done.wait(LIMIT), "the executor of this process is stuck"
    result: T = task.result()
    return result
