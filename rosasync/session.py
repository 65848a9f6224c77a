"""Session: node, executor thread, client pool and servers under one lifetime."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NoReturn, Self, overload

from rosasync._actions.session_methods import ActionMethods
from rosasync._core.opening import Opening
from rosasync._core.service_client import ServiceClient
from rosasync.errors import UsageError
from rosasync.options import Limits, Retry, SessionOptions, check_timeout
from rosasync.typing import (
    RequestT,
    ResponseT,
    ServiceType,
    Timeout,
)

if TYPE_CHECKING:
    import asyncio
    from collections.abc import AsyncIterator, Mapping
    from types import TracebackType

    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node
    from rclpy.qos import QoSProfile

    from rosasync._client.pool import ClientPool
    from rosasync._client.service_watch import ServiceState
    from rosasync._core.core import Core
    from rosasync._core.portal import Portal
    from rosasync._server.handlers import ErrorHook, Handler, OverloadHook
    from rosasync._server.server import Order, ServiceServer
    from rosasync._server.status import Status
    from rosasync.statistics import SessionStatistics
    from rosasync.tracing import Trace

__all__ = ["ServiceClient", "Session"]


class Session(ActionMethods):
    """Calls and serves ROS 2 services from asyncio.

    ::

        async with rosasync.Session("my_app") as session:
            response = await session.call(SetBool, "/arm/enable", {"data": True}, timeout=2.0)

    A session belongs to the loop in which it is opened. Use it on that loop's thread; other threads
    use ``session.from_thread``. It may be opened in one task and closed in another.

    Args:
        node: a name, for a node and a context of the session's own, which end with it; or an
            ``rclpy.node.Node``, which is borrowed: it is never destroyed, and spun only if no
            executor has it yet. The session does not install rclpy's signal handlers.
        context: for a named node, the ``rclpy.context.Context`` to create it in. The session does
            not shut it down.
        executor: an ``rclpy.executors.Executor`` that you spin. The node is added to it, and the
            session starts no thread.
        bridge: how responses reach the loop: ``"direct"``, ``"executor"``, or ``"auto"`` for the
            direct bridge if it works here.
        limits: what the pool may use for each service.
        timeout: seconds for a call that gives no timeout, None for no deadline.
        busy_poll: seconds for which the loop polls for a response before it sleeps, like Linux's
            SO_BUSY_POLL. It halves the latency, and keeps a core busy while a quick service is
            called. 0.0005 suits services on the same machine. Only on the direct bridge.
        introspection: what clients and servers publish about each call, on
            ``<service>/_service_event``: ``"off"``, ``"metadata"`` (that it happened) or
            ``"contents"`` (with request and response).
        trace: a `Trace`, which is called for the start, each phase and the end of every call made
            and every request taken, such as ``rosasync.opentelemetry.OpenTelemetryTrace``.

    Raises:
        TypeError, ValueError: an argument is of the wrong type, or out of range.
    """

    def __init__(
        self,
        node: str | Node = "rosasync",
        *,
        context: Context | None = None,
        executor: Executor | None = None,
        bridge: Literal["auto", "direct", "executor"] = "auto",
        limits: Limits | None = None,
        timeout: float | None = 10.0,
        busy_poll: float = 0.0,
        introspection: Literal["off", "metadata", "contents"] = "off",
        trace: Trace | None = None,
    ) -> None:
        options = SessionOptions(
            node=node,
            context=context,
            executor=executor,
            bridge=bridge,
            limits=Limits() if limits is None else limits,
            timeout=timeout,
            busy_poll=busy_poll,
            introspection=introspection,
            trace=trace,
        )
        self._opening = Opening(options)

    def __repr__(self) -> str:
        core = self._opening.core
        if core is None:
            return f"<Session {self._opening.options.node!r} not open>"
        state = "closed" if core.closed else f"{core.node.bridge} bridge, {core.pool!r}"
        return f"<Session {core.name!r} {state}>"

    async def open(self) -> Self:
        """Open the session in the running loop, and return it.

        ``async with`` does this, and `aclose` at its end. Open it yourself where no block can span
        the session's life: in a notebook, or in the start-up hook of a framework.

        The first opening in a process imports rclpy, in a thread, while the loop runs other tasks.
        Then it creates the context and the node, which blocks the loop for some tens of
        milliseconds. A cancellation takes effect after the import, and leaves nothing behind.

        Raises:
            ImportError: rclpy is not installed, or the middleware that ``RMW_IMPLEMENTATION``
                names; the message says what to do.
            UsageError: the session was opened before, the bridge asked for does not work here, the
                ROS domain does not exist, or the process was forked from one that has used ROS.
            TypeError: ``node`` is neither a name nor an rclpy node.
            ValueError: ROS does not allow the node's name.
            SessionClosed: the session was closed during the opening.
            OSError: the process is out of file descriptors.
            RosasyncError: the process is out of threads, or rclpy cannot create the node.
        """
        await self._opening.open(self)
        return self

    async def __aenter__(self) -> Self:
        """Open the session; see `open`."""
        return await self.open()

    def __enter__(self) -> NoReturn:
        """Raise `UsageError`: a session needs ``async with``."""
        raise UsageError(
            "a session is opened with `async with`, not `with`: "
            "`async with rosasync.Session(…) as session:`"
        )

    def __exit__(self, *exc: object) -> None:
        # `with` looks it up before it calls `__enter__`.
        raise AssertionError("never entered")

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()

    def __del__(self) -> None:
        # There is none if the constructor has refused its arguments.
        opening = getattr(self, "_opening", None)
        if opening is not None and opening.core is not None and not opening.closed:
            opening.core.abandon(self)

    @property
    def closed(self) -> bool:
        """Whether the session has been closed, or has begun to close."""
        return self._opening.closed

    @property
    def bridge(self) -> str:
        """The bridge in use, ``"direct"`` or ``"executor"``."""
        return self.core.node.bridge

    @property
    def node(self) -> Node:
        """The rclpy node, for its timers, publishers, parameters and so on."""
        return self.core.node.node

    @property
    def pool(self) -> ClientPool:
        """The client pool."""
        return self.core.pool

    @property
    def from_thread(self) -> Portal:
        """Calls from other threads than the loop's."""
        return self.core.portal

    @property
    def core(self) -> Core:
        """The parts of the open session, for rosasync itself. Not part of the public API."""
        return self._opening.parts()

    def statistics(self) -> SessionStatistics:
        """Take a snapshot of the session's statistics. After the close it shows the final ones."""
        return self.core.statistics()

    @overload
    async def call(
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
    async def call(
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

    async def call(
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
        """Call a service and return its response.

        Args:
            srv_type: a service class or its name, ``"std_srvs/srv/SetBool"``. With a class, type
                checkers know the response.
            srv_name: the service's name. Relative, private (``~/name``) and remapped names work as
                in rclpy.
            request: a message of the request type, a mapping of its fields, or None for an empty
                one. It is read when it is sent: do not change it before the response.
            timeout: seconds for the whole call, None for no deadline; if left out, the session's.
                If none are left (0 or less), nothing is sent, and the call raises `QueueTimeout`.
            qos: a ``QoSProfile``; None for the service default with a history of 1,000, or of
                ``Limits.in_flight``, at least 10, without rosasync's Fast DDS profile.
            wait: False to fail at once if there is no server, or none of this type; a number of
                seconds to wait for one within the timeout. A call that waits while the name is
                served as another type logs a warning after one second.
            retry: when to send an unanswered request again; only for services that may run twice.

        Raises:
            ServiceUnavailable: there was no server in time.
            QueueTimeout: the deadline passed while waiting for a client; nothing was sent.
            ResponseTimeout: the request was sent, and not answered in time.
            ServerGone: every server vanished while the request was outstanding.
            PoolFull: more callers wait than `Limits.waiting` allows.
            SessionClosed, ContextShutdown: the session ended, before or during the call.
            InvalidServiceName: ROS does not allow the name.
            TypeError, ValueError: an argument does not fit; nothing was sent.
            UsageError: called from another loop or thread.
        """
        # `Opening.use`, inlined, because this runs for every call.
        core = self._opening.core or self._opening.use()
        core.check_loop()
        service = core.pool.service(srv_type, srv_name, qos)
        message, seconds = core.arguments.check_call(
            service.service, request, timeout, core.timeout, wait, retry
        )
        return await service.call(message, seconds, wait, retry)

    @overload
    def start(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> asyncio.Task[ResponseT]: ...

    @overload
    def start(
        self,
        srv_type: str,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> asyncio.Task[Any]: ...

    def start(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> asyncio.Task[Any]:
        """Start the same call as a task, for a tick to poll and cancel.

        If a client is free, the request is sent before this returns. Otherwise it is copied. So it
        may be changed afterwards.

        For the arguments and errors, see `call`. Wrong arguments raise here, everything later is
        raised by the task.
        """
        core = self._opening.use()
        service = core.pool.service(srv_type, srv_name, qos)
        message, seconds = core.arguments.check_call(
            service.service, request, timeout, core.timeout, wait, retry
        )
        return service.start(message, seconds, wait, retry, copy=request is not None)

    @overload
    def client(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        limits: Limits | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> ServiceClient[RequestT, ResponseT]: ...

    @overload
    def client(
        self,
        srv_type: str,
        srv_name: str,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        limits: Limits | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> ServiceClient[Any, Any]: ...

    def client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        timeout: Timeout = ...,
        qos: QoSProfile | None = None,
        limits: Limits | None = None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> ServiceClient[Any, Any]:
        """Bind a type and a name, for several calls. The handle owns nothing: the pool does.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            timeout: seconds for each call; None for no deadline; if left out, the session's.
            qos: as for `call`.
            limits: what the pool may use for these calls; None for the session's. Clients with the
                same limits share a pool, apart from calls with the session's.
            wait: for calls that give none; see `call`.
            retry: for calls that give none; ``Retry(attempts=1)`` in a call switches it off.

        Raises:
            InvalidServiceName: ROS does not allow the name.
            TypeError, ValueError: an argument does not fit.
            SessionClosed, ContextShutdown: the session has ended.
        """
        core = self._opening.use()
        service = core.pool.service(srv_type, srv_name, qos)
        # All arguments are checked before anything is made.
        seconds = core.arguments.check_defaults(timeout, core.timeout, wait, retry)
        if limits is not None:
            service = core.pool.limited(service.service, limits)
        return ServiceClient(core, service, seconds, wait, retry)

    async def wait_for_service(
        self,
        srv_type: ServiceType[Any, Any] | str,
        srv_name: str,
        *,
        timeout: Timeout = None,
        qos: QoSProfile | None = None,
    ) -> Literal[True]:
        """Wait until a server of this service is matched, and return True.

        Unlike rclpy's, it never returns False: it raises instead.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            timeout: seconds; None, or left out, for no deadline; ``...`` for the session's.
            qos: as for `call`.

        Raises:
            ServiceUnavailable: there was none in time; the message describes what the graph shows
                instead.
            SessionClosed, ContextShutdown: the session ended.
        """
        core = self._opening.use()
        service = core.pool.service(srv_type, srv_name, qos)
        await service.wait_for_server(check_timeout(timeout, core.timeout))
        return True

    async def watch_service(
        self,
        srv_type: ServiceType[Any, Any] | str,
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
    ) -> AsyncIterator[ServiceState]:
        """Watch the servers of a service: yield their state now, and after each change.

        ::

            async for state in session.watch_service(SetBool, "/arm/enable"):
                print(state.status, *state.nodes)

        A session that was just opened knows no servers yet, so the first state may be ``"gone"``.
        If a server is added to others, the state is ``"up"`` again. It runs until it is left, or
        until the session ends.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            qos: as for `call`; a server that does not fit it does not count.

        Raises:
            TypeError, ValueError, InvalidServiceName: an argument does not fit.
            SessionClosed, ContextShutdown: the session ended.
        """
        core = self._opening.use()
        service = core.arguments.service(srv_type, srv_name, qos)
        async for state in core.pool.watch(service):
            yield state

    def service_is_ready(
        self,
        srv_type: ServiceType[Any, Any] | str,
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
    ) -> bool:
        """Return whether a server of this service is matched, so that a call is sent at once.

        The first query for a service may return False, because it takes some milliseconds to match
        a new client.
        """
        return self._opening.use().pool.service(srv_type, srv_name, qos).match()

    @overload
    def serve(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        handler: Handler[RequestT, ResponseT] | None = None,
        *,
        concurrency: int = 100,
        backlog: int = 1000,
        backlog_bytes: int = 64_000_000,
        order: Order = "fair",
        qos: QoSProfile | None = None,
        on_error: ErrorHook[RequestT, ResponseT] | None = None,
        on_overload: OverloadHook[RequestT, ResponseT] | None = None,
        status: Status = False,
        cancel_abandoned: bool = False,
    ) -> ServiceServer[RequestT, ResponseT]: ...

    @overload
    def serve(
        self,
        srv_type: str,
        srv_name: str,
        handler: Handler[Any, Any] | None = None,
        *,
        concurrency: int = 100,
        backlog: int = 1000,
        backlog_bytes: int = 64_000_000,
        order: Order = "fair",
        qos: QoSProfile | None = None,
        on_error: ErrorHook[Any, Any] | None = None,
        on_overload: OverloadHook[Any, Any] | None = None,
        status: Status = False,
        cancel_abandoned: bool = False,
    ) -> ServiceServer[Any, Any]: ...

    def serve(
        self,
        srv_type: Any,
        srv_name: str,
        handler: Handler[Any, Any] | None = None,
        *,
        concurrency: int = 100,
        backlog: int = 1000,
        backlog_bytes: int = 64_000_000,
        order: Order = "fair",
        qos: QoSProfile | None = None,
        on_error: ErrorHook[Any, Any] | None = None,
        on_overload: OverloadHook[Any, Any] | None = None,
        status: Status = False,
        cancel_abandoned: bool = False,
    ) -> ServiceServer[Any, Any]:
        """Serve a service from now until the server or the session is closed.

        ::

            async def enable(request, response):
                response.success = await motors.enable(request.data)
                return response

            async with session.serve(SetBool, "/arm/enable", enable):
                ...

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            handler: ``handler(request, response)``, plain or async, which returns the response. Or
                ``handler(call)`` with a `ServiceCall`, which returns the response, or None if the
                call is answered with ``call.respond``, now or later. None for
                ``async for call in server:``. The number of required arguments decides, once, at
                registration. A plain handler blocks the loop while it runs. Instead of the
                response it may return a mapping of the response's fields.
            concurrency: the maximum number of handlers that run at a time.
            backlog: the maximum number of requests that wait for a handler.
            backlog_bytes: the maximum size of these requests together, in bytes. A single request
                may be larger. If more come, the oldest is dropped, of the client that has most.
            order: in which order they run while the server is overloaded. ``"fair"``: the clients
                take turns, and the newest request of each comes first, because the oldest is the
                one whose caller has most likely left. ``"arrival"``: first come, first served, as
                at all other times; for requests that must run in their order, or whose callers wait
                for as long as it takes.
            qos: a ``QoSProfile``; None for the service default with a history of 1,000.
            on_error: ``on_error(call, error)``, plain or async, called when the handler has raised
                an exception, or returned something other than a response or a response that cannot
                be sent. It may return the response to send. Then the error is only logged at DEBUG.
            on_overload: ``on_overload(call)``, plain or async, called for a request that the
                backlog drops. It may return the response to send. ``concurrency`` does not limit
                it, so it should be quick.
            status: True to tell callers at once that there will be no answer, if they use rosasync:
                `HandlerFailed`, `ServerOverloaded` or `ServerGone`; and to learn which callers have
                left, also of other clients whose process has gone from the graph. A request whose
                caller has left is not run. ``"quiet"`` keeps the messages of exceptions here.
            cancel_abandoned: whether to cancel the handler of a call whose caller has left. Needs
                ``status``.

        Raises:
            TypeError: the handler is not callable, is a class, or takes neither one argument nor
                two; a hook is not callable; the type or the QoS does not fit.
            ValueError: a limit is out of range; there is no such order; the service type does not
                exist.
            InvalidServiceName: ROS does not allow the name.
            UsageError: this process serves or calls another type under this name.
            SessionClosed, ContextShutdown: the session has ended, or has begun to.
        """
        return self._opening.use().serve(
            srv_type,
            srv_name,
            handler,
            concurrency=concurrency,
            backlog=backlog,
            backlog_bytes=backlog_bytes,
            order=order,
            qos=qos,
            on_error=on_error,
            on_overload=on_overload,
            status=status,
            cancel_abandoned=cancel_abandoned,
        )

    async def aclose(self) -> None:
        """End the session and everything it started; idempotent.

        First the servers end: their handlers have five seconds to finish, and may still call. Then
        the goals that are out are cancelled, except those that were detached, and have five seconds
        to end. Then the calls in progress end with `SessionClosed`. A cancellation does not cut
        this short.
        """
        await self._opening.aclose()
