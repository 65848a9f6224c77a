"""The executor thread: spins an rclpy executor."""

from __future__ import annotations

import threading
from collections.abc import Callable

from rclpy.exceptions import InvalidHandle
from rclpy.executors import Executor, ExternalShutdownException, ShutdownException

__all__ = ["ExecutorThread"]


class ExecutorThread:
    """Spins an rclpy executor in a thread of its own.

    An exception that a callback of the node raises is reported and does not end the spinning.
    The thread is a daemon, so that it cannot keep the interpreter alive; whoever starts it joins
    it before the interpreter's exit, which would abort on a thread still spinning.
    """

    def __init__(
        self,
        executor: Executor,
        name: str,
        on_error: Callable[[Exception], None],
        on_shutdown: Callable[[], None],
        on_end: Callable[[], None],
    ) -> None:
        self._executor = executor
        self._on_error = on_error
        self._on_shutdown = on_shutdown
        self._on_end = on_end
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=name, daemon=True)
        self._thread.start()

    @property
    def ident(self) -> int | None:
        """The thread's identifier, as ``threading.get_ident`` gives it; None once it has ended.

        Another thread may have the same one then.
        """
        return self._thread.ident if self._thread.is_alive() else None

    def stop(self) -> None:
        """Ask the thread to end, after the callback under way. Any thread; idempotent."""
        if not self._stopping.is_set():
            self._stopping.set()
            # After a `wake` alone, without work, the executor would wait again.
            self._executor.create_task(_nothing)

    def join(self, timeout: float) -> bool:
        """Wait for the end, ``timeout`` seconds at the most; blocks.

        Returns:
            Whether the thread has ended.
        """
        if self._thread is threading.current_thread():
            return False
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _spin(self) -> None:
        while not self._stopping.is_set():
            try:
                # What `spin_once` does: apart here to tell its own errors from the callbacks'.
                handler, _, _ = self._executor.wait_for_ready_callbacks()
            except (ExternalShutdownException, ShutdownException):
                break
            except InvalidHandle:
                # An entity was destroyed while it was added to the wait set (rclpy issue 1355).
                self._stopping.wait(0.001)
                continue
            except Exception as error:
                if self._stopping.is_set() or not self._executor.context.ok():
                    break
                self._on_error(error)
                self._stopping.wait(0.1)
                continue
            handler()
            if handler.exception() is not None:
                self._on_error(handler.exception())
        if not self._stopping.is_set():
            self._on_shutdown()
        self._on_end()


def _nothing() -> None:
    """A task to wake for."""
