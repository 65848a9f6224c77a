"""What a proxy works on: one operation at a time, from any thread, performed by the loop."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from rosasync.errors import SessionClosed, UsageError

if TYPE_CHECKING:
    from rosasync._core.gateway import LoopGateway

__all__ = ["CurrentOperation", "Operation"]

StateT = TypeVar("StateT")


class Operation(Generic[StateT]):
    """One operation of a proxy, or none.

    The loop writes into it until it has ended, and the proxy's threads only afterwards.

    Attributes:
        state: its state; any thread may read it.
        outcome: what it has returned, until it is taken.
        error: why it has failed.
        task: the task that works on it.
    """

    __slots__ = ("_ends", "begun", "error", "outcome", "state", "task")

    PENDING: ClassVar[tuple[Any, ...]]
    """The states in which the loop works on it."""
    FAILED: ClassVar[Any]
    """The state after an error."""

    def __init__(self, state: StateT, timeout: float | None = None) -> None:
        self.state = state
        self.outcome: Any = None
        self.error: Exception | None = None
        self.begun = False
        self.task: asyncio.Task[None] | None = None
        self._ends = None if timeout is None else time.monotonic() + timeout

    @property
    def pending(self) -> bool:
        """Whether it has not ended."""
        return self.state in self.PENDING

    def time_left(self) -> float | None:
        """Return the seconds that are left of the timeout."""
        return None if self._ends is None else max(0.0, self._ends - time.monotonic())

    def end(self, state: StateT, outcome: Any = None, error: Exception | None = None) -> None:
        """Set the outcome, unless there is one."""
        if self.state in self.PENDING:
            self.outcome = outcome
            self.error = error
            # Last, because other threads read it first.
            self.state = state

    def fail(self, error: Exception) -> None:
        """End with an error, unless it has ended already."""
        self.end(self.FAILED, error=error)

    def take(self, ready: StateT, idle: StateT) -> Any:
        """Return the outcome if the state is ``ready``, which becomes ``idle``; otherwise None."""
        if self.state is not ready:
            return None
        # The loop does not write into an operation that has ended, so this thread may.
        self.state = idle
        outcome, self.outcome = self.outcome, None
        return outcome

    def errors(self) -> list[Exception]:
        """Return the error as a list of one, or an empty list."""
        error = self.error
        return [] if error is None else [error]


OperationT = TypeVar("OperationT", bound=Operation[Any])


class CurrentOperation(Generic[OperationT]):
    """The current operation of a proxy.

    Any thread replaces it as a whole, and the loop writes only into the one that it works on. So no
    lock is needed, and the outcome of a replaced operation is never visible. After each replacement
    the loop reconciles the two. Posts may be reordered between threads, but the last reconciliation
    sees the last operation.

    Attributes:
        operation: the current operation.
        working: the one that the loop works on.
        closed: whether the proxy was shut down.
    """

    __slots__ = ("_gateway", "closed", "operation", "working")

    def __init__(self, gateway: LoopGateway, operation: OperationT) -> None:
        self._gateway = gateway
        self.operation = operation
        self.working: OperationT | None = None
        self.closed = False

    def start(
        self,
        name: str,
        operation: OperationT,
        begin: Callable[[OperationT], asyncio.Task[None]],
        stop: Callable[[], None],
    ) -> None:
        """Start an operation, as `replace` does.

        Args:
            name: what is called, for the error.
            operation: a pending operation.
            begin: as for `replace`.
            stop: stops the current operation.

        Raises:
            UsageError: the proxy was shut down.
        """
        if self.closed:
            raise UsageError(f"{name}: the proxy was shut down: create a new one")
        self.replace(operation, begin)
        if self.closed:
            # Another thread has shut the proxy down since the check.
            stop()

    def replace(
        self, operation: OperationT, begin: Callable[[OperationT], asyncio.Task[None]]
    ) -> None:
        """Replace the current operation, pending or not.

        Args:
            operation: the new one.
            begin: creates the task of an operation, on the loop's thread. Needed for an operation
                that has ended, too: another thread may have replaced that one before the loop
                reconciles.
        """
        before, self.operation = self.operation, operation
        gateway = self._gateway
        gateway.discard(before)
        if not operation.pending:
            with contextlib.suppress(SessionClosed):
                gateway.call(self._reconcile, begin)
            return
        gateway.register(operation)
        try:
            gateway.call(self._reconcile, begin)
        except SessionClosed as error:
            gateway.discard(operation)
            operation.fail(error)

    # On the loop's thread.

    def _reconcile(self, begin: Callable[[OperationT], asyncio.Task[None]]) -> None:
        """Cancel the work on a replaced operation, and start the work on the current one."""
        operation, working = self.operation, self.working
        if operation is working:
            return
        if working is not None and working.task is not None:
            working.task.cancel()
        self.working = None
        if operation.pending and not operation.begun:
            operation.begun = True
            self.working = operation
            operation.task = begin(operation)

    def leave(self, operation: OperationT) -> None:
        """Mark an operation as finished."""
        self._gateway.discard(operation)
        if self.working is operation:
            self.working = None
