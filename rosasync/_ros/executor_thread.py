"""The executor thread: spins a node that no other executor spins."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ConditionReachedException,
    Executor,
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
)
from rclpy.node import Node

__all__ = ["ExecutorThread", "ThreadUser", "executor_thread_of"]

_starting = threading.RLock()
"""Held while a session looks for a node's thread and starts one."""


@dataclass(eq=False, slots=True)
class ThreadUser:
    """One session's use of an executor thread.

    Attributes:
        on_error: called with an exception that a callback of the node has raised.
        on_shutdown: called if the thread ends because the context was shut down.
        on_left: called when the session has left, or the thread has ended.
        leaving: whether the session has asked to leave.
        left: set before ``on_left`` is called.
    """

    on_error: Callable[[Exception], None]
    on_shutdown: Callable[[], None]
    on_left: Callable[[], None]
    leaving: bool = False
    left: threading.Event = field(default_factory=threading.Event)

    def acknowledge(self) -> None:
        """Report that the session has left."""
        self.left.set()
        self.on_left()


class ExecutorThread:
    """Spins a node in a thread, until the last session that uses it has left.

    An exception that a callback of the node raises is reported and does not end the thread.
    The thread is a daemon, so that it cannot keep the interpreter alive. Sessions have to join it
    before the interpreter's exit, which would abort on a thread that still spins.
    """

    def __init__(self, node: Node, user: ThreadUser) -> None:
        self._node = node
        # Changed by single operations only, which are atomic: `leave` must not take a lock.
        self._users: dict[ThreadUser, None] = {user: None}
        self._deciding = False
        self._ended = False
        self._executor = _OwnExecutor(self)
        try:
            self._executor.add_node(node)
            self._thread = threading.Thread(
                target=self._run, name=f"rosasync executor of {node.get_name()}", daemon=True
            )
            self._thread.start()
        except BaseException:
            self._ended = True
            self.close()
            raise

    @property
    def node(self) -> Node:
        """The node that it spins."""
        return self._node

    @property
    def ident(self) -> int | None:
        """The thread's identifier; None once it has ended, because another thread may reuse it."""
        return self._thread.ident if self._thread.is_alive() else None

    def enter(self, user: ThreadUser) -> bool:
        """Join the users of the thread, and return whether that succeeded: not if it is ending."""
        # The order matters: the user is added before `_deciding` and `_ended` are read. So either
        # `_decide_end` counts this user, or this user sees that the thread is ending.
        self._users[user] = None
        while self._deciding:
            time.sleep(0)
        if self._ended:
            self._users.pop(user, None)
        return not self._ended

    def leave(self, user: ThreadUser) -> None:
        """Ask to leave after the current callback. From any thread; takes no lock; idempotent.

        The garbage collector may call this in a thread that holds a lock of rclpy.
        """
        user.leaving = True
        with contextlib.suppress(InvalidHandle):
            self._executor.wake()

    def join(self, user: ThreadUser, timeout: float) -> bool:
        """Wait until this user has left, and for the thread's end if it was the last; blocks.

        Args:
            user: who has called `leave`.
            timeout: the maximum number of seconds to wait.

        Returns:
            Whether it has left.
        """
        if self._thread is threading.current_thread():
            return False
        if not user.left.wait(timeout):
            return False
        if self._ended:
            self._thread.join(timeout)
            return not self._thread.is_alive()
        return True

    def close(self) -> None:
        """Remove the node from the executor, if the thread has ended."""
        if self._ended:
            if self._node.executor is self._executor:
                self._node.executor = None
            # The garbage collector destroys the guard condition for SIGINT before, if it collects
            # the executor together with an unclosed session.
            with contextlib.suppress(InvalidHandle, ValueError):
                self._executor.shutdown()

    def _run(self) -> None:
        try:
            self._spin()
        finally:
            self._ended = True
            for user in tuple(self._users):
                if not user.leaving:
                    user.on_shutdown()
                user.acknowledge()

    def _spin(self) -> None:
        """Spin until no user is left, or the executor or its context is shut down."""
        while not self._decide_end():
            try:
                # As `spin_once`, in two steps, to distinguish its errors from those of callbacks.
                handler, _, _ = self._executor.wait_for_ready_callbacks(
                    None, None, self._leave_requested
                )
            except ConditionReachedException:
                continue
            except (ExternalShutdownException, ShutdownException):
                return
            except InvalidHandle:
                # An entity was destroyed while it was added to the wait set (rclpy issue 1355).
                time.sleep(0.001)
                continue
            except Exception as error:
                if self._executor.is_shut_down or not self._executor.context.ok():
                    return
                self._report(error)
                time.sleep(0.1)
                continue
            handler()
            if handler.exception() is not None:
                self._report(handler.exception())

    def _leave_requested(self) -> bool:
        """Return whether a user has asked to leave."""
        return any(user.leaving for user in tuple(self._users))

    def _decide_end(self) -> bool:
        """Acknowledge the users that have asked to leave, and return whether no other is left."""
        if not self._leave_requested():
            return False
        leaving = [user for user in tuple(self._users) if user.leaving]
        self._deciding = True
        self._ended = len(leaving) == len(self._users)
        self._deciding = False
        if not self._ended:
            for user in leaving:
                self._users.pop(user, None)
                user.acknowledge()
        return self._ended

    def _report(self, error: Exception) -> None:
        """Report an error once, to the first of the users."""
        for user in tuple(self._users)[:1]:
            user.on_error(error)


class _OwnExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """The executor of an `ExecutorThread`, which other sessions find by ``node.executor``."""

    def __init__(self, thread: ExecutorThread) -> None:
        super().__init__(context=thread.node.context)
        self.thread = thread
        self.is_shut_down = False

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop executing callbacks."""
        self.is_shut_down = True
        return bool(super().shutdown(timeout_sec))

    def __del__(self) -> None:
        """Do not destroy the guard condition here: another thread may be in `shutdown`."""


def executor_thread_of(node: Node, user: ThreadUser) -> ExecutorThread | None:
    """Return the thread that spins a node for its sessions, started if it has no executor.

    Returns:
        None if another executor has the node.
    """
    with _starting:
        executor: Executor | None = node.executor
        if isinstance(executor, _OwnExecutor):
            if executor.thread.enter(user):
                return executor.thread
        elif executor is not None:
            return None
        return ExecutorThread(node, user)
