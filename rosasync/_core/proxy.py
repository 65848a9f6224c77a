"""AsyncServiceProxy: a tick-driven state machine for behaviour trees."""

from __future__ import annotations

import asyncio
import enum
from collections.abc import Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Generic, cast

from rosasync._core.aio import start_task
from rosasync._core.operations import CurrentOperation, Operation
from rosasync.options import Retry, check_retry, check_timeout
from rosasync.typing import RequestT, ResponseT, ServiceType, Timeout

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from rosasync.session import Session

__all__ = ["AsyncServiceProxy", "ProxyState"]


class ProxyState(enum.Enum):
    """The state of the last operation of an `AsyncServiceProxy`.

    Attributes:
        IDLE: there was no operation yet, or its response has been read.
        WAITING: it waits for a server.
        SERVICE_AVAILABLE: it waited for a server and found one.
        RUNNING: a call is in progress: waiting for a server, a client or the response.
        RESPONSE_READY: the response can be read.
        TIMEOUT: the deadline of the call or the wait passed, in any phase.
        ABORTED: it was stopped before it ended, or before its response was read.
        ERROR: it failed with another error; `AsyncServiceProxy.get_errors` returns it.
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
"""The states in which the loop works on the operation."""

STOPPABLE = (*PENDING, ProxyState.RESPONSE_READY)
"""The states that `AsyncServiceProxy.stop_call` ends."""


class AsyncServiceProxy(Generic[RequestT, ResponseT]):
    """Calls a service from the ticks of a behaviour tree.

    No method blocks, and each may be called from the loop and from any other thread. A proxy owns
    nothing: all proxies of a session share its clients through the pool.

    ::

        state              call_service  wait_for_service  stop_call  get_response
        IDLE               RUNNING       WAITING           unchanged  None
        WAITING            RUNNING       WAITING           ABORTED    None
        SERVICE_AVAILABLE  RUNNING       WAITING           unchanged  None
        RUNNING            RUNNING       WAITING           ABORTED    None
        RESPONSE_READY     RUNNING       WAITING           ABORTED    response; IDLE
        TIMEOUT            RUNNING       WAITING           unchanged  None
        ABORTED            RUNNING       WAITING           unchanged  None
        ERROR              RUNNING       WAITING           unchanged  None

    Two states change by themselves: WAITING to SERVICE_AVAILABLE, TIMEOUT or ERROR, and RUNNING to
    RESPONSE_READY, TIMEOUT or ERROR. When the session is closed, both become ERROR.

    A new call or wait cancels and replaces the previous operation. A late response to that one is
    counted, and never returned. ``shutdown`` does what ``stop_call`` does, and refuses new calls.

    Args:
        session: an open session.
        srv_type: a service class or its name, ``"std_srvs/srv/SetBool"``.
        srv_name: the service's name.
        qos: a ``QoSProfile``; None for the service default.
        retry: when to send an unanswered request again; only for services that may run twice.

    Raises:
        TypeError, ValueError: the service type does not exist, or QoS or retry does not fit.
        InvalidServiceName: ROS does not allow the name.
        UsageError: the session is not open yet.
        SessionClosed: the session is closed.
    """

    __slots__ = (
        "__weakref__",
        "_arguments",
        "_current",
        "_gateway",
        "_pool",
        "_retry",
        "_service",
        "_timeout",
    )

    def __init__(
        self,
        session: Session,
        srv_type: ServiceType[RequestT, ResponseT] | str,
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
        retry: Retry | None = None,
    ) -> None:
        core = session.core
        core.gateway.check_open()
        if retry is not None:
            check_retry(retry)
        self._gateway = core.gateway
        self._pool = core.pool
        self._arguments = core.arguments
        self._timeout = core.timeout
        self._retry = retry
        self._service = core.arguments.service(srv_type, srv_name, qos)
        self._current = CurrentOperation(core.gateway, _Operation(ProxyState.IDLE))

    def __repr__(self) -> str:
        return f"<AsyncServiceProxy {self._service.key.srv_name} {self.get_state().name}>"

    def call_service(
        self,
        request: RequestT | Mapping[str, Any] | None = None,
        timeout: Timeout = ...,
        *,
        wait: bool | float = True,
    ) -> None:
        """Start a call, which replaces the previous operation. The state becomes RUNNING.

        On the loop's thread, if a client is free, the request is sent before this returns.
        Otherwise it is copied. So it may be changed afterwards.

        Args:
            request: a message, a mapping of its fields, or None for an empty one.
            timeout: seconds for the whole call; None for no deadline; if left out, the session's.
            wait: False to fail at once if there is no server.

        Raises:
            TypeError, ValueError: an argument does not fit; the state is unchanged.
            UsageError: the proxy was shut down.
        """
        message, seconds = self._arguments.check_call(
            self._service, request, timeout, self._timeout, wait
        )
        if request is not None and not self._gateway.on_loop:
            message = deepcopy(message)
        self._start(_Operation(ProxyState.RUNNING, message, seconds, wait))

    def make_request(self, request: RequestT | Mapping[str, Any] | None) -> RequestT:
        """Return the message that `call_service` sends for this argument, to prepare it in advance.

        Raises:
            TypeError, ValueError: it does not fit.
        """
        message, _ = self._arguments.check_call(self._service, request, None, None)
        return cast(RequestT, message)

    def wait_for_service(self, timeout: Timeout = None) -> None:
        """Wait for a server, which replaces the previous operation. The state becomes WAITING.

        Args:
            timeout: seconds; None, or left out, for no deadline; ``...`` for the session's.

        Raises:
            TypeError, ValueError: the timeout does not fit; the state is unchanged.
            UsageError: the proxy was shut down.
        """
        seconds = check_timeout(timeout, self._timeout)
        self._start(_Operation(ProxyState.WAITING, timeout=seconds))

    def stop_call(self) -> None:
        """Stop the operation, in any state.

        A call or wait in progress is cancelled, an unread response is dropped, and the state
        becomes ABORTED. In the other states nothing changes.
        """
        if self._current.operation.state in STOPPABLE:
            self._current.replace(_Operation(ProxyState.ABORTED), self._begin)

    def get_state(self) -> ProxyState:
        """Return the state. Cheap: it only reads an attribute."""
        return self._current.operation.state

    def get_response(self) -> ResponseT | None:
        """Return the response and become IDLE; return None if there is no unread response."""
        response = self._current.operation.take(ProxyState.RESPONSE_READY, ProxyState.IDLE)
        return cast("ResponseT | None", response)

    def get_errors(self) -> list[Exception]:
        """Return the error in the states TIMEOUT and ERROR; otherwise an empty list."""
        return self._current.operation.errors()

    def shutdown(self) -> None:
        """Stop the call, and refuse further ones; idempotent."""
        self._current.closed = True
        self.stop_call()

    def _start(self, operation: _Operation) -> None:
        self._current.start(self._service.key.srv_name, operation, self._begin, stop=self.stop_call)

    # On the loop's thread.

    def _begin(self, operation: _Operation) -> asyncio.Task[None]:
        loop, work = self._gateway.loop, self._work(operation)
        # A call is sent in the same tick. A wait has to be visible as WAITING first.
        calls = operation.state is ProxyState.RUNNING
        return start_task(loop, work) if calls else loop.create_task(work)

    async def _work(self, operation: _Operation) -> None:
        try:
            operation.end(*await self._perform(operation))
        except TimeoutError as error:
            operation.end(ProxyState.TIMEOUT, error=error)
        except asyncio.CancelledError:
            operation.end(ProxyState.ABORTED)
            raise
        except Exception as error:
            operation.fail(error)
        finally:
            self._current.leave(operation)

    async def _perform(self, operation: _Operation) -> tuple[ProxyState, Any]:
        service = self._pool.service_of(self._service)
        if operation.state is ProxyState.WAITING:
            await service.wait_for_server(operation.time_left())
            return ProxyState.SERVICE_AVAILABLE, None
        response = await service.call(
            operation.request,
            operation.time_left(),
            operation.wait,
            self._retry,
            copy=True,
            # The task is cancelled later: when the loop reconciles, and then in its next step.
            is_cancelled=lambda: self._current.operation is not operation,
        )
        return ProxyState.RESPONSE_READY, response


class _Operation(Operation[ProxyState]):
    """A call, a wait, or none."""

    __slots__ = ("request", "wait")

    PENDING = PENDING
    FAILED = ProxyState.ERROR

    def __init__(
        self,
        state: ProxyState,
        request: Any = None,
        timeout: float | None = None,
        wait: bool | float = True,
    ) -> None:
        super().__init__(state, timeout)
        self.request = request
        self.wait = wait
