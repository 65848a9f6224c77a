"""Portal: calls from threads other than the loop's, as ``session.from_thread``."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import CancelledError, Future, InvalidStateError
from copy import deepcopy
from typing import TYPE_CHECKING, Any, overload

from rosasync._core.fork import check_fork
from rosasync.errors import ResponseTimeout, SessionClosed, UsageError
from rosasync.options import check_hook, check_timeout
from rosasync.typing import (
    ActionType,
    FeedbackT,
    GoalT,
    RequestT,
    ResponseT,
    ResultT,
    ServiceType,
    Timeout,
)

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from rosasync._actions.registry import Actions
    from rosasync._client.pool import ClientPool
    from rosasync._core.arguments import ArgumentChecker
    from rosasync._core.gateway import LoopGateway
    from rosasync._core.ports import NodePort
    from rosasync.options import Retry

__all__ = ["Portal"]

IsCancelled = Callable[[], bool]
"""Returns whether the caller has cancelled."""

POLL_LOOP = 0.5
"""Seconds after which a blocked thread checks again whether the loop has been closed."""

MARGIN = 1.0
"""Seconds after its deadline for which a blocked thread waits for the loop to report it."""


class Portal:
    """Calls services from threads other than the loop's: ``session.from_thread``.

    For worker threads, GUI toolkits and libraries that block, and for the callbacks of the
    session's node; in the loop, use `Session.call` and `Session.start`. On the loop's own thread,
    and on the session's executor thread (which runs the node's callbacks), waiting for a response
    would deadlock and raises `UsageError`. `submit` does not wait, so it works in these callbacks.
    If another executor spins the node, do not block in its callbacks either.
    """

    def __init__(
        self,
        node: NodePort,
        gateway: LoopGateway,
        arguments: ArgumentChecker,
        pool: ClientPool,
        actions: Actions,
        timeout: float | None,
    ) -> None:
        self._node = node
        self._gateway = gateway
        self._arguments = arguments
        self._pool = pool
        self._actions = actions
        self._timeout = timeout

    def __repr__(self) -> str:
        state = "closed" if self._gateway.closed else "open"
        return f"<Portal to the session of node {self._node.name!r}, {state}>"

    @overload
    def call(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> ResponseT: ...

    @overload
    def call(
        self,
        srv_type: str,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> Any: ...

    def call(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> Any:
        """Call a service, block this thread until the response arrives, and return it.

        For the arguments and errors, see `Session.call`. It also ends when the session closes, and
        a second after the deadline if the loop is blocked.

        Raises:
            UsageError: on the loop's thread, or the executor's: it would deadlock.
        """
        self._check_loop("call")
        self._check_executor()
        submission = self._submission(srv_type, srv_name, request, timeout, qos, wait, retry)
        submission.submit()
        return submission.wait()

    @overload
    def submit(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> Future[ResponseT]: ...

    @overload
    def submit(
        self,
        srv_type: str,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> Future[Any]: ...

    def submit(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> Future[Any]:
        """Start the same call and return at once. Cancelling the future cancels the call.

        It works in the callbacks of the session's node too, but do not wait for the future there:
        while it is not done, its ``result()`` and ``exception()`` raise `UsageError` on the
        executor's thread and the loop's. ``add_done_callback`` says what happens with the response;
        it is called on the loop's thread, or at once if the call is done by then.

        The request is copied, so it may be changed afterwards. For the arguments, see
        `Session.call`. Wrong arguments raise here, everything later is raised by the future.

        Raises:
            UsageError: on the loop's thread; use `Session.start` there.
            SessionClosed: the session is closed.
        """
        self._check_loop("start")
        submission = self._submission(
            srv_type, srv_name, request, timeout, qos, wait, retry, copy=request is not None
        )
        submission.submit()
        return submission

    @overload
    def act(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        goal: GoalT | Mapping[str, Any] | None = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[FeedbackT], Any] | None = None,
    ) -> ResultT: ...

    @overload
    def act(
        self,
        action_type: str,
        action_name: str,
        goal: Any = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[Any], Any] | None = None,
    ) -> Any: ...

    def act(
        self,
        action_type: Any,
        action_name: str,
        goal: Any = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[Any], Any] | None = None,
    ) -> Any:
        """Send a goal, block this thread until it has ended, and return its result.

        For the arguments and errors, see `Session.act`. ``on_feedback`` is called on the loop's
        thread. If the wait is interrupted, for example by a KeyboardInterrupt, the goal is
        cancelled.

        Raises:
            UsageError: on the loop's thread, or the executor's: it would deadlock.
        """
        self._check_loop("act")
        self._check_executor()
        seconds = check_timeout(timeout, None)
        arguments = self._actions.arguments(action_type, action_name, goal, accept_timeout, wait)
        hook = check_hook("on_feedback", on_feedback, "feedback")

        def start(seconds: float | None, _: IsCancelled) -> Coroutine[Any, Any, Any]:
            return self._actions.act(arguments, seconds, hook)

        action = arguments.action
        submission = _Submission(
            self._gateway, self._check_executor, start, seconds, (action.name, action.type_name)
        )
        submission.submit()
        return submission.wait()

    def _submission(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any,
        timeout: Timeout,
        qos: QoSProfile | None,
        wait: bool | float,
        retry: Retry | None,
        copy: bool = False,
    ) -> _Submission:
        service = self._arguments.service(srv_type, srv_name, qos)
        message, seconds = self._arguments.check_call(
            service, request, timeout, self._timeout, wait, retry
        )
        if copy:
            message = deepcopy(message)

        def start(seconds: float | None, is_cancelled: IsCancelled) -> Coroutine[Any, Any, Any]:
            pool = self._pool.service_of(service)
            return pool.call(message, seconds, wait, retry, is_cancelled=is_cancelled)

        name, type_name, _ = service.key
        return _Submission(self._gateway, self._check_executor, start, seconds, (name, type_name))

    def _check_loop(self, instead: str) -> None:
        check_fork()
        self._gateway.check_open()
        if self._gateway.on_thread or self._gateway.on_loop:
            raise UsageError(
                "session.from_thread is for other threads, and this is the thread of the session's "
                f"own loop: use {'' if instead == 'start' else 'await '}session.{instead}(…)"
            )

    def _check_executor(self) -> None:
        if self._node.executor_thread == threading.get_ident():
            raise UsageError(
                "this is the executor's thread, which runs this callback, and waiting here for a "
                "response would stop all callbacks: use session.from_thread.submit(…), and "
                "add_done_callback for what to do with the response"
            )


class _Submission(Future[Any]):
    """A call, or a goal, that another thread waits for.

    The loop, the end of the session and a cancellation may each complete it. The first one wins.

    Args:
        gateway: the way into the loop.
        check_executor: raises `UsageError` on the executor's thread.
        start: returns the coroutine of the call, for the seconds that are left, and a function
            that returns whether the call was cancelled in the meantime.
        timeout: seconds for the whole call, None for no deadline.
        names: the names of the service and its type.
    """

    def __init__(
        self,
        gateway: LoopGateway,
        check_executor: Callable[[], None],
        start: Callable[[float | None, IsCancelled], Coroutine[Any, Any, Any]],
        timeout: float | None,
        names: tuple[str, str],
    ) -> None:
        super().__init__()
        self._gateway = gateway
        self._check_executor = check_executor
        self._start_call = start
        self._timeout = timeout
        self._names = names
        self._submitted = time.monotonic()
        # The call runs in the context of its caller, for a trace.
        self._context = contextvars.copy_context()
        self._task: asyncio.Task[None] | None = None

    def submit(self) -> None:
        """Pass the call to the loop.

        Raises:
            SessionClosed: the session is closed.
        """
        self._gateway.register(self)
        try:
            self._gateway.post(self._start)
        except SessionClosed:
            self._gateway.discard(self)
            raise
        self.add_done_callback(self._on_done)

    def fail(self, error: Exception) -> None:
        """End with an error, unless it has ended already."""
        with contextlib.suppress(InvalidStateError):
            self.set_exception(error)

    def result(self, timeout: float | None = None) -> Any:
        """Wait as ``concurrent.futures.Future.result`` does, also if the loop has vanished.

        Raises:
            UsageError: it is not done, and this is a thread that it needs to become so.
        """
        self._check_wait()
        self._watch(timeout)
        return super().result(0)

    def exception(self, timeout: float | None = None) -> BaseException | None:
        """Wait as ``concurrent.futures.Future.exception`` does, also if the loop has vanished.

        Raises:
            UsageError: it is not done, and this is a thread that it needs to become so.
        """
        self._check_wait()
        self._watch(timeout)
        return super().exception(0)

    def wait(self) -> Any:
        """Return the response, at most `MARGIN` seconds after the deadline.

        If the wait ends otherwise, for example by a KeyboardInterrupt, the call is cancelled.
        """
        try:
            self._watch(None if self._timeout is None else self._timeout + MARGIN)
            if self.done():
                return super().result()
        except BaseException:
            self.cancel()
            raise
        self.cancel()
        elapsed = time.monotonic() - self._submitted
        srv_name, srv_type = self._names
        raise ResponseTimeout(
            f"{srv_name}: the session's loop is stuck: it did not react for {elapsed:.3g} s, so a "
            "task or a callback blocks it",
            srv_name=srv_name,
            srv_type=srv_type,
            elapsed=elapsed,
        )

    def _check_wait(self) -> None:
        """Raise `UsageError` on a thread that must not wait for this, unless it is done."""
        if self.done() or self._gateway.closed:
            return
        if self._gateway.on_thread or self._gateway.on_loop:
            raise UsageError(
                "the session's own loop would wait for itself: use await asyncio.wrap_future(…)"
            )
        self._check_executor()

    def _watch(self, timeout: float | None) -> None:
        """Wait until this is done, the loop is closed, or ``timeout`` seconds have passed."""
        ends = None if timeout is None else time.monotonic() + timeout
        while not self.done():
            left = POLL_LOOP if ends is None else min(POLL_LOOP, ends - time.monotonic())
            if left <= 0:
                return
            with contextlib.suppress(TimeoutError, CancelledError):
                super().exception(left)
            if self._gateway.loop.is_closed():
                self.fail(SessionClosed("the session's loop was closed"))

    def _on_done(self, _: Future[Any]) -> None:
        """Cancel the call if the future was cancelled. Runs once, on the thread that ended it."""
        self._gateway.discard(self)
        if self.cancelled():
            # concurrent.futures.wait and as_completed see the cancellation only now.
            self.set_running_or_notify_cancel()
            with contextlib.suppress(SessionClosed):
                self._gateway.call(self._cancel)

    # On the loop's thread.

    def _start(self) -> None:
        if not self.done():
            self._task = self._context.run(self._gateway.loop.create_task, self._call())

    def _cancel(self) -> None:
        if self._task is not None:
            self._task.cancel()

    async def _call(self) -> None:
        seconds = self._timeout
        if seconds is not None:
            seconds = max(0.0, seconds - (time.monotonic() - self._submitted))
        try:
            response = await self._start_call(seconds, self.cancelled)
        except asyncio.CancelledError:
            self.fail(SessionClosed("the session's loop has ended"))
            raise
        except Exception as error:
            self.fail(error)
        else:
            with contextlib.suppress(InvalidStateError):
                self.set_result(response)
