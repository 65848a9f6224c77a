"""Calls from other threads: the way into a session's loop, and ``session.from_thread``."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, InvalidStateError
from typing import TYPE_CHECKING, Any, Protocol

from rosasync.errors import ResponseTimeout, SessionClosed, UsageError
from rosasync.options import Retry, Timeout, check_timeout

if TYPE_CHECKING:
    from rosasync.gateway import LoopGateway
    from rosasync.pool import ClientPool
    from rosasync.ports import NodePort

__all__ = ["Portal"]

LOOK = 0.5
"""Seconds between looks of a blocked thread whether the loop it waits for is still there."""

MARGIN = 1.0
"""Seconds past its deadline for which a blocked thread waits for the loop to say so."""


class Pending(Protocol):
    """Something that a thread has asked for and the loop has not finished."""

    def fail(self, error: Exception) -> None:
        """End in an error, unless it has ended already. Any thread."""


class Gate:
    """The way into a session's loop from any thread, with one wake-up for each batch.

    What was asked for on other threads, and is not finished when the session ends, is told so:
    also what stood in the mailbox then, and what is added while the session closes. Every method
    may be called from any thread; dicts are changed by single operations, which are atomic.
    """

    def __init__(
        self, node: NodePort, gateway: LoopGateway, pool: ClientPool, timeout: float | None
    ) -> None:
        self.loop = asyncio.get_running_loop()
        self._gateway = gateway
        self.pool = pool
        self.timeout = timeout
        self._node = node
        self._thread = threading.get_ident()
        self._known: dict[tuple[Any, str], Any] = {}
        self._pending: dict[Pending, None] = {}
        self._ended = False

    @property
    def on_loop(self) -> bool:
        """Whether this is the loop's own thread, and the loop is running."""
        return asyncio._get_running_loop() is self.loop

    def check_thread(self) -> None:
        """Raise `UsageError` where waiting for the loop would be waiting for oneself.

        Raises:
            SessionClosed: there is no loop to wait for.
        """
        if self._ended or self.loop.is_closed():
            raise SessionClosed("the session is closed")
        ident = threading.get_ident()
        if ident == self._thread or self.on_loop:
            raise UsageError(
                "session.from_thread would block the session's own loop: await session.call"
            )
        if ident == self._node.executor_thread:
            raise UsageError(
                "session.from_thread would block the executor's thread, which runs this callback"
            )

    def check_service(self, srv_type: Any, srv_name: str, qos: Any) -> Any:
        """Return the service class, once type, name and QoS are known to be in order.

        Raises:
            TypeError, ValueError: there is no such service type, or that is no QoS.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed: the session is closed.
        """
        if self._ended:
            raise SessionClosed("the session is closed")
        if qos is None:
            with contextlib.suppress(KeyError, TypeError):
                return self._known[srv_type, srv_name]
        srv_class = self._node.describe(srv_type, srv_name, qos).srv_type
        self._known[srv_type, srv_name] = srv_class
        return srv_class

    def names(self, srv_type: Any, srv_name: str, qos: Any) -> tuple[str, str]:
        """Return the type's name and the resolved service name, for an error."""
        key = self._node.describe(srv_type, srv_name, qos).key
        return key.srv_type, key.srv_name

    def request(self, srv_class: Any, request: Any) -> Any:
        """Return a message of the request type; see `ClientPool.request`."""
        if isinstance(request, srv_class.Request):
            return request
        return self._node.make_request(srv_class, request)

    def post(self, pending: Pending, callback: Callable[[], object]) -> None:
        """Have ``callback()`` called on the loop's thread, for what is then pending.

        On that thread itself it is called at once.

        Raises:
            SessionClosed: the session is closed.
        """
        self._pending[pending] = None
        try:
            self._call(callback)
        except SessionClosed:
            self.finished(pending)
            raise

    def tell(self, callback: Callable[[], object]) -> None:
        """Have ``callback()`` called on the loop's thread, if it still takes calls."""
        with contextlib.suppress(SessionClosed):
            self._call(callback)

    def finished(self, pending: Pending) -> None:
        """Take note that this has ended, whichever way."""
        self._pending.pop(pending, None)

    def end(self) -> None:
        """Fail what is pending; after the node was stopped, so that nothing is added any more."""
        self._ended = True
        for pending in tuple(self._pending):
            pending.fail(SessionClosed("the session is closed"))
        self._pending.clear()

    def _call(self, callback: Callable[[], object]) -> None:
        if self._ended:
            raise SessionClosed("the session is closed")
        if self.on_loop:
            callback()
            return
        try:
            self._gateway.post(callback)
        except RuntimeError:
            if not self.loop.is_closed():
                raise
            raise SessionClosed("the session's loop was closed") from None


class Portal:
    """Calls services from other threads than the loop's: ``session.from_thread``.

    For plain threads: worker threads, GUI toolkits, libraries that block. In the loop there is
    `Session.call`. On the thread of the loop, and on the session's executor thread (where the
    node's callbacks run), a call would wait for itself: `UsageError`. With a node that somebody
    else's executor spins, do not block in its callbacks either.
    """

    def __init__(self, gate: Gate) -> None:
        self._gate = gate

    def call(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: Any = None,
        wait: bool = True,
        retry: Retry | None = None,
    ) -> Any:
        """Call a service, block this thread until the answer is there, and return the response.

        For the arguments and errors, see `Session.call`. It returns or raises also where the
        session closes meanwhile; where its loop is stuck, a second after the deadline.

        Raises:
            UsageError: on the loop's own thread, or the executor's: it would deadlock.
        """
        return self._submit(srv_type, srv_name, request, timeout, qos, wait, retry).wait()

    def submit(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: Any = None,
        wait: bool = True,
        retry: Retry | None = None,
    ) -> Future[Any]:
        """Start the same call and return at once. Cancelling the future cancels the call.

        For the arguments, see `Session.call`. What is wrong with them is raised here, what goes
        wrong later by the future. The request is sent by the loop: do not change it before the
        answer.

        Raises:
            UsageError: on the loop's own thread, or the executor's.
            SessionClosed: the session is closed.
        """
        return self._submit(srv_type, srv_name, request, timeout, qos, wait, retry)

    def _submit(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any,
        timeout: Timeout,
        qos: Any,
        wait: bool,
        retry: Retry | None,
    ) -> _Submission:
        gate = self._gate
        gate.check_thread()
        srv_class = gate.check_service(srv_type, srv_name, qos)
        message = gate.request(srv_class, request)
        seconds = check_timeout(timeout, gate.timeout)
        if retry is not None and not isinstance(retry, Retry):
            raise TypeError(f"retry must be a rosasync.Retry, not {type(retry).__name__}")
        submission = _Submission(gate, (srv_type, srv_name, qos), message, seconds, wait, retry)
        gate.post(submission, submission.start)
        submission.add_done_callback(submission.on_done)
        return submission


class _Submission(Future[Any]):
    """A call that another thread waits for.

    ``start`` runs on the loop's thread. The future is completed by the loop, by the end of the
    session, or cancelled, whichever comes first.
    """

    def __init__(
        self,
        gate: Gate,
        service: tuple[Any, str, Any],
        request: Any,
        timeout: float | None,
        wait: bool,
        retry: Retry | None,
    ) -> None:
        super().__init__()
        self._gate = gate
        self._service = service
        self._request = request
        self._timeout = timeout
        self._wait = wait
        self._retry = retry
        self._started = time.monotonic()
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin the call, unless it was cancelled on the way here."""
        if not self.done():
            self._task = self._gate.loop.create_task(self._call())

    def fail(self, error: Exception) -> None:
        """End in an error, unless it has ended already."""
        with contextlib.suppress(InvalidStateError):
            self.set_exception(error)

    def result(self, timeout: float | None = None) -> Any:
        """Wait for the response; as ``concurrent.futures.Future``, for a loop that may be gone."""
        self._watch(timeout)
        return super().result(0)

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait for the end; as ``concurrent.futures.Future``, for a loop that may be gone."""
        self._watch(timeout)
        return super().exception(0)

    def wait(self) -> Any:
        """Return the response as `result` does, at the latest `MARGIN` past the call's deadline.

        Whatever else ends the waiting, a KeyboardInterrupt, cancels the call.
        """
        try:
            self._watch(None if self._timeout is None else self._timeout + MARGIN)
            if self.done():
                return super().result()
        except BaseException:
            self.cancel()
            raise
        self.cancel()
        elapsed = time.monotonic() - self._started
        srv_type, srv_name = self._gate.names(*self._service)
        raise ResponseTimeout(
            f"{srv_name}: the session's loop is stuck: no word from it for {elapsed:.3g} s",
            srv_name=srv_name,
            srv_type=srv_type,
            elapsed=elapsed,
        )

    def on_done(self, _: Future[Any]) -> None:
        """Take the call back where it was cancelled; once, on whichever thread ended it."""
        self._gate.finished(self)
        if self.cancelled():
            # What concurrent.futures.wait and as_completed look at.
            self.set_running_or_notify_cancel()
            self._gate.tell(self._cancel)

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    def _watch(self, timeout: float | None) -> None:
        """Wait for the end, ``timeout`` seconds at the most, or for the end of the loop."""
        ends = None if timeout is None else time.monotonic() + timeout
        while not self.done():
            left = LOOK if ends is None else min(LOOK, ends - time.monotonic())
            if left <= 0:
                return
            with contextlib.suppress(TimeoutError, CancelledError):
                super().exception(left)
            if self._gate.loop.is_closed():
                self.fail(SessionClosed("the session's loop was closed"))

    async def _call(self) -> None:
        seconds = self._timeout
        if seconds is not None:
            seconds = max(0.0, seconds - (time.monotonic() - self._started))
        pool = self._gate.pool
        try:
            endpoint = pool.endpoint(*self._service)
            response = await pool.call(endpoint, self._request, seconds, self._wait, self._retry)
        except asyncio.CancelledError:
            self.fail(SessionClosed("the session's loop has ended"))
            raise
        except Exception as error:
            self.fail(error)
        else:
            with contextlib.suppress(InvalidStateError):
                self.set_result(response)
