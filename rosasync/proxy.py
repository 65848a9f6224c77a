"""AsyncServiceProxy: the tick-driven state machine."""

from __future__ import annotations

import asyncio
import enum
import time
from typing import TYPE_CHECKING, Any

from rosasync.aio import begin
from rosasync.errors import SessionClosed, UsageError
from rosasync.options import check_timeout

if TYPE_CHECKING:
    from rosasync.portal import Gate
    from rosasync.session import Session

__all__ = ["AsyncServiceProxy", "ProxyState"]


class ProxyState(enum.Enum):
    """What became of the last thing an `AsyncServiceProxy` was asked for.

    Attributes:
        IDLE: nothing was asked yet, or the response has been read.
        WAITING: for a server to be there.
        SERVICE_AVAILABLE: a server was there at the end of the wait.
        RUNNING: a call is under way: waiting for a server, a client or the response.
        RESPONSE_READY: the response is there to be read.
        TIMEOUT: the deadline passed, of the call or the wait, in any phase.
        ABORTED: stopped before its end, or before its response was read.
        ERROR: it failed otherwise; `AsyncServiceProxy.get_errors` tells how.
    """

    IDLE = enum.auto()
    WAITING = enum.auto()
    SERVICE_AVAILABLE = enum.auto()
    RUNNING = enum.auto()
    RESPONSE_READY = enum.auto()
    TIMEOUT = enum.auto()
    ABORTED = enum.auto()
    ERROR = enum.auto()


PENDING = (ProxyState.WAITING, ProxyState.RUNNING)
"""The loop is at work on it."""

STOPPABLE = (*PENDING, ProxyState.RESPONSE_READY)
"""Something is under way, or unread."""


class AsyncServiceProxy:
    """Calls a service from the ticks of a behaviour tree.

    No method blocks, and each may be called from the loop and from any other thread. It owns
    nothing: all proxies of a session share its clients through the pool.

    ::

        state              call_service  wait_for_service  stop_call  get_response
        IDLE               RUNNING       WAITING           stays      None
        WAITING            RUNNING       WAITING           ABORTED    None
        SERVICE_AVAILABLE  RUNNING       WAITING           stays      None
        RUNNING            RUNNING       WAITING           ABORTED    None
        RESPONSE_READY     RUNNING       WAITING           ABORTED    response; IDLE
        TIMEOUT            RUNNING       WAITING           stays      None
        ABORTED            RUNNING       WAITING           stays      None
        ERROR              RUNNING       WAITING           stays      None

    By itself only WAITING changes, to SERVICE_AVAILABLE, TIMEOUT or ERROR; and RUNNING, to
    RESPONSE_READY, TIMEOUT or ERROR. ERROR is also what becomes of both when the session is closed.

    A new call or wait replaces what was asked before: that is cancelled, and whatever still comes
    of it is counted as late and never shown. ``shutdown`` does what ``stop_call`` does, for good.

    Args:
        session: an open session.
        srv_type: a service class or its name, ``"std_srvs/srv/SetBool"``.
        srv_name: the service's name.
        qos: a ``QoSProfile``; None for the service default with a history of 1,000.

    Raises:
        TypeError, ValueError: there is no such service type, or that is no QoS.
        InvalidServiceName: ROS does not allow the name.
        UsageError: the session is not open yet.
        SessionClosed: the session is closed.
    """

    # One attribute, swapped as a whole, says what is wanted; the loop writes only into the object
    # it works on. So no lock is needed, and a superseded call has no way to show up. Each swap is
    # followed by a look of the loop at what is wanted then: the last look settles it.
    __slots__ = ("__weakref__", "_closed", "_gate", "_now", "_service", "_srv_class", "_working")

    def __init__(self, session: Session, srv_type: Any, srv_name: str, *, qos: Any = None) -> None:
        self._gate: Gate = session._open_core().gate
        self._srv_class = self._gate.check_service(srv_type, srv_name, qos)
        self._service = (srv_type, srv_name, qos)
        self._now = _Ask(ProxyState.IDLE)
        self._working: _Ask | None = None
        self._closed = False

    def __repr__(self) -> str:
        return f"<AsyncServiceProxy {self._service[1]} {self.get_state().name}>"

    def call_service(
        self, request: Any = None, timeout: float | None = None, *, wait: bool = True
    ) -> None:
        """Start a call in place of whatever was asked before; the state is RUNNING.

        On the loop's thread the request is sent at once, if a client is free.

        Args:
            request: a message, a mapping of its fields, or None for an empty one. The loop sends
                it: do not change it before the answer.
            timeout: seconds for the whole call from now on; None for the session's, ``math.inf``
                for no deadline.
            wait: False to fail at once where no server is there.

        Raises:
            TypeError, ValueError: the request or the timeout does not fit; the state stays.
            UsageError: the proxy was shut down.
        """
        message = self.request(request)
        seconds = self._gate.timeout if timeout is None else check_timeout(timeout, None)
        self._ask(_Ask(ProxyState.RUNNING, message, seconds, wait))

    def request(self, request: Any) -> Any:
        """Return the message that `call_service` makes of this, to make it ahead.

        Raises:
            TypeError, ValueError: it does not fit.
        """
        return self._gate.request(self._srv_class, request)

    def wait_for_service(self, timeout: float | None = None) -> None:
        """Start to wait for a server in place of whatever was asked before; the state is WAITING.

        Args:
            timeout: seconds from now on; None for no deadline.

        Raises:
            TypeError, ValueError: the timeout is no number, or negative; the state stays.
            UsageError: the proxy was shut down.
        """
        self._ask(_Ask(ProxyState.WAITING, timeout=check_timeout(timeout, None)))

    def stop_call(self) -> None:
        """Give up what was asked for, in any state.

        What is under way is cancelled and an unread response dropped: the state is ABORTED,
        whatever still comes. Where nothing is under way or unread, the state stays.
        """
        if self._now.state in STOPPABLE:
            self._swap(_Ask(ProxyState.ABORTED))

    def get_state(self) -> ProxyState:
        """Return the state: an attribute's value, no more."""
        return self._now.state

    def get_response(self) -> Any:
        """Return the response where one is ready, once: the state becomes IDLE. Else None."""
        now = self._now
        if now.state is not ProxyState.RESPONSE_READY:
            return None
        # The loop has done with it.
        now.state = ProxyState.IDLE
        response, now.response = now.response, None
        return response

    def get_errors(self) -> list[Exception]:
        """Return what went wrong, where the state is TIMEOUT or ERROR; else an empty list."""
        error = self._now.error
        return [] if error is None else [error]

    def shutdown(self) -> None:
        """Stop the call, and refuse others; idempotent."""
        self._closed = True
        self.stop_call()

    def _ask(self, ask: _Ask) -> None:
        if self._closed:
            raise UsageError(f"{self._service[1]}: the proxy was shut down")
        self._swap(ask)
        if self._closed:
            # Shut down by another thread meanwhile.
            self.stop_call()

    def _swap(self, ask: _Ask) -> None:
        before, self._now = self._now, ask
        gate = self._gate
        gate.finished(before)
        if ask.state not in PENDING:
            gate.tell(self._look)
            return
        try:
            gate.post(ask, self._look)
        except SessionClosed as error:
            ask.fail(error)

    # On the loop's thread.

    def _look(self) -> None:
        """Drop what is not wanted any more, and start what is."""
        now = self._now
        working = self._working
        if now is working:
            return
        loop = self._gate.loop
        if working is not None and working.task is not None:
            loop.call_soon(working.task.cancel)
        self._working = None
        if now.state in PENDING and not now.begun:
            now.begun = True
            self._working = now
            work = self._work(now)
            # A call is sent by the tick that asks for it; a wait is always WAITING at first.
            calls = now.state is ProxyState.RUNNING
            now.task = begin(loop, work) if calls else loop.create_task(work)

    async def _work(self, ask: _Ask) -> None:
        try:
            ask.end(*await self._do(ask))
        except TimeoutError as error:
            ask.end(ProxyState.TIMEOUT, error=error)
        except asyncio.CancelledError:
            ask.end(ProxyState.ABORTED)
            raise
        except Exception as error:
            ask.fail(error)
        finally:
            self._gate.finished(ask)
            if self._working is ask:
                self._working = None

    async def _do(self, ask: _Ask) -> tuple[ProxyState, Any]:
        pool = self._gate.pool
        endpoint = pool.endpoint(*self._service)
        if ask.state is ProxyState.WAITING:
            await pool.wait_for_server(endpoint, ask.left())
            return ProxyState.SERVICE_AVAILABLE, None
        response = await pool.call(endpoint, ask.request, ask.left(), ask.wait)
        return ProxyState.RESPONSE_READY, response


class _Ask:
    """One thing a proxy is asked for: a call, a wait, or nothing."""

    __slots__ = (
        "asked",
        "begun",
        "error",
        "request",
        "response",
        "state",
        "task",
        "timeout",
        "wait",
    )

    def __init__(
        self,
        state: ProxyState,
        request: Any = None,
        timeout: float | None = None,
        wait: bool = True,
    ) -> None:
        self.state = state
        self.request = request
        self.timeout = timeout
        self.wait = wait
        self.asked = time.monotonic()
        self.begun = False
        self.response: Any = None
        self.error: Exception | None = None
        self.task: asyncio.Task[None] | None = None

    def left(self) -> float | None:
        """Seconds of the timeout that are left."""
        if self.timeout is None:
            return None
        return max(0.0, self.timeout - (time.monotonic() - self.asked))

    def end(self, state: ProxyState, response: Any = None, error: Exception | None = None) -> None:
        """Take the outcome, if there is none yet; the state last, since others look at it."""
        if self.state in PENDING:
            self.response = response
            self.error = error
            self.state = state

    def fail(self, error: Exception) -> None:
        """End in an error, unless it has ended already."""
        self.end(ProxyState.ERROR, error=error)
