"""Session: node, executor thread, pool and servers under one lifetime."""

from __future__ import annotations

import asyncio
import atexit
import importlib
import logging
import warnings
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import anyio

from rosasync.aio import until_done
from rosasync.errors import SessionClosed, UsageError
from rosasync.gateway import LoopGateway
from rosasync.handlers import ErrorHook, Handler, OverloadHook
from rosasync.options import Limits, Retry, SessionOptions, Timeout, check_timeout
from rosasync.pool import ClientPool, Endpoint, context_shut_down
from rosasync.portal import Gate, Portal
from rosasync.server import ServiceServer
from rosasync.statistics import SessionStatistics

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node

    from rosasync.ports import NodePort
    from rosasync.ros.node import RosNode

__all__ = ["ServiceClient", "Session"]

logger = logging.getLogger("rosasync")

ENDING = 5.0
"""Seconds for a callback of the node to end with the session, before its thread is left behind."""


class Session:
    """Calls ROS 2 services from asyncio.

    ::

        async with rosasync.Session("my_app") as session:
            response = await session.call(SetBool, "/arm/enable", {"data": True}, timeout=2.0)

    It belongs to the loop it is opened in, and is used on that loop's thread. It may be opened in
    one task and closed in another.

    Args:
        node: a name, for a node and a context of the session's own, which end with it; or an
            ``rclpy.node.Node``, which is borrowed: never destroyed, and spun only if no executor
            has it yet. rclpy's signal handlers are not installed.
        context: for a named node, the ``rclpy.context.Context`` to make it in; not shut down.
        executor: an ``rclpy.executors.Executor`` that you spin: the node is added to it, and the
            session starts no thread.
        bridge: how responses reach the loop: ``"direct"``, ``"executor"``, or ``"auto"`` for the
            direct one where it works.
        limits: what the pool may use for each service.
        timeout: seconds for a call that does not say, None for no deadline.
        busy_poll: seconds for which the loop looks for a response before it sleeps, after Linux's
            SO_BUSY_POLL: about half the latency, for a core that is busy as long as a quick
            service is called. 0.0005 suits services on this machine. Only on the direct bridge.
        introspection: what clients and servers publish of every call, on
            ``<service>/_service_event``: ``"off"``, ``"metadata"`` (that it happened) or
            ``"contents"`` (request and response too).

    Raises:
        TypeError, ValueError: an argument is of the wrong kind, or out of range.
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
    ) -> None:
        self._options = SessionOptions(
            node=node,
            context=context,
            executor=executor,
            bridge=bridge,
            limits=Limits() if limits is None else limits,
            timeout=timeout,
            busy_poll=busy_poll,
            introspection=introspection,
        )
        self._timeout = self._options.timeout
        self._core: _Core | None = None
        self._closed = False

    def __repr__(self) -> str:
        if self._core is None:
            return f"<Session {self._options.node!r} not open>"
        state = "closed" if self._closed else f"{self.bridge} bridge, {self._core.pool!r}"
        return f"<Session {self._core.name!r} {state}>"

    async def __aenter__(self) -> Self:
        """Open the session in the running loop.

        Raises:
            ImportError: rclpy is not installed; the message says how to install it.
            UsageError: it was opened before, or the bridge asked for does not work here.
            TypeError: ``node`` is neither a name nor an rclpy node.
        """
        if self._core is not None or self._closed:
            raise UsageError("a session is opened once")
        self._core = _Core(self)
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()

    def __del__(self) -> None:
        core = getattr(self, "_core", None)
        if core is not None and not self._closed:
            _warn_unclosed(self)
            core.abandon()

    @property
    def closed(self) -> bool:
        """Whether the session has been closed, or its closing has begun."""
        return self._closed

    @property
    def bridge(self) -> str:
        """The bridge in use: ``"direct"`` or ``"executor"``."""
        return self._open_core().ros.bridge

    @property
    def node(self) -> Node:
        """The rclpy node: for its timers, publishers, parameters and so on."""
        return self._open_core().ros.node

    @property
    def pool(self) -> ClientPool:
        """The clients."""
        return self._open_core().pool

    @property
    def from_thread(self) -> Portal:
        """Calls from other threads than the loop's."""
        return self._open_core().portal

    def statistics(self) -> SessionStatistics:
        """Take a snapshot of how the session stands; after the close, of how it ended."""
        core = self._open_core()
        return SessionStatistics(
            bridge=core.ros.bridge,
            pool=core.pool.statistics(),
            servers=tuple(server.statistics() for server in core.servers),
        )

    async def call(
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
        """Call a service and return its response.

        Args:
            srv_type: a service class or its name, ``"std_srvs/srv/SetBool"``.
            srv_name: the service's name; relative, private (``~/name``) and remapped names work
                as in rclpy.
            request: a message of the request type, a mapping of its fields, or None for an empty
                one.
            timeout: seconds for the whole call, None for no deadline; the session's where it is
                left out.
            qos: a ``QoSProfile``; None for the service default with a history of 1,000.
            wait: False to fail at once where no server is there.
            retry: when to send again what is unanswered; only for services that may run twice.
                The request is sent as it then is: it must not be changed before the answer.

        Raises:
            ServiceUnavailable: no server was there in time.
            QueueTimeout: the deadline passed while waiting for a client; nothing was sent.
            ResponseTimeout: sent, and not answered in time.
            ServerGone: the last server vanished while the request was out.
            PoolFull: as many callers as ``Limits.waiting`` allows are waiting already.
            SessionClosed, ContextShutdown: the session ended, before or during the call.
            InvalidServiceName: ROS does not allow the name.
            TypeError, ValueError: type, request or timeout do not fit; nothing was sent.
            UsageError: called from another loop or thread.
        """
        pool = self._use().pool
        endpoint = pool.endpoint(srv_type, srv_name, qos)
        message = pool.request(endpoint, request)
        seconds = self._timeout if timeout is ... else check_timeout(timeout, None)
        return await pool.call(endpoint, message, seconds, wait, retry)

    def start(
        self,
        srv_type: Any,
        srv_name: str,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        qos: Any = None,
        wait: bool = True,
        retry: Retry | None = None,
    ) -> asyncio.Task[Any]:
        """Start the same call as a task: what a tick polls and cancels.

        For the arguments and errors, see `call`. What is wrong with the arguments is raised here,
        what goes wrong later by the task.
        """
        pool = self._use().pool
        endpoint = pool.endpoint(srv_type, srv_name, qos)
        message = pool.request(endpoint, request)
        seconds = check_timeout(timeout, self._timeout)
        return self._loop.create_task(pool.call(endpoint, message, seconds, wait, retry))

    def client(
        self, srv_type: Any, srv_name: str, *, timeout: Timeout = ..., qos: Any = None
    ) -> ServiceClient:
        """Bind type and name, for several calls. The handle owns nothing: the pool does.

        Raises:
            InvalidServiceName: ROS does not allow the name.
            TypeError, ValueError: type, QoS or timeout do not fit.
            SessionClosed: the session is closed.
        """
        endpoint = self._use().pool.endpoint(srv_type, srv_name, qos)
        return ServiceClient(self, endpoint, check_timeout(timeout, self._timeout))

    async def wait_for_service(
        self, srv_type: Any, srv_name: str, *, timeout: float | None = None, qos: Any = None
    ) -> None:
        """Wait until a server of this service is matched.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            timeout: seconds, None for no deadline.
            qos: as for `call`.

        Raises:
            ServiceUnavailable: none was there in time; the message says what was seen instead.
            SessionClosed, ContextShutdown: the session ended meanwhile.
        """
        pool = self._use().pool
        endpoint = pool.endpoint(srv_type, srv_name, qos)
        await pool.wait_for_server(endpoint, check_timeout(timeout, None))

    def service_is_ready(self, srv_type: Any, srv_name: str, *, qos: Any = None) -> bool:
        """Tell whether a server of this service is matched, so that a call would be sent at once.

        A service asked for the first time needs some milliseconds to be matched.
        """
        pool = self._use().pool
        return pool.is_ready(pool.endpoint(srv_type, srv_name, qos))

    def serve(
        self,
        srv_type: Any,
        srv_name: str,
        handler: Handler[Any, Any] | None = None,
        *,
        concurrency: int = 100,
        backlog: int = 1000,
        qos: Any = None,
        on_error: ErrorHook[Any, Any] | None = None,
        on_overload: OverloadHook[Any, Any] | None = None,
    ) -> ServiceServer[Any, Any]:
        """Serve a service, from now until the server or the session is closed.

        ::

            async def enable(request, response):
                response.success = await motors.enable(request.data)
                return response

            async with session.serve(SetBool, "/arm/enable", enable):
                ...

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            handler: ``handler(request, response)``, plain or async, which returns the response; or
                ``handler(call)`` with a `ServiceCall`, which returns the response, or None where
                the call is answered with ``call.respond``, now or later. None for
                ``async for call in server:``. How many arguments it has to get decides, here and
                once. A plain handler holds up the loop as long as it runs.
            concurrency: how many handlers run at a time at the most.
            backlog: how many requests wait at the most.
            qos: a ``QoSProfile``; None for the service default with a history of 1,000.
            on_error: ``on_error(call, error)``, plain or async, when the handler has raised or has
                returned something else: may return the response to send.
            on_overload: ``on_overload(call)``, plain or async, for a request beyond the backlog:
                may return the response to send. It is not held back by ``concurrency``, so it
                should be quick.

        Raises:
            TypeError: the handler is not callable, is a class, or takes neither one argument nor
                two; a hook is not callable; type or QoS do not fit.
            ValueError: a limit out of range; there is no such service type.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed, ContextShutdown: the session has ended, or has begun to.
        """
        core = self._use()
        if self._closed:
            raise _session_closed()
        return core.serve(
            srv_type,
            srv_name,
            handler,
            concurrency=concurrency,
            backlog=backlog,
            qos=qos,
            on_error=on_error,
            on_overload=on_overload,
        )

    async def aclose(self) -> None:
        """End the session and everything it started; idempotent.

        First the servers, whose handlers have five seconds to finish and may still call. Then calls
        under way end with `SessionClosed`. It is not cut short by cancellation.
        """
        if self._core is None:
            self._closed = True
            return
        self._core.check_loop()
        self._closed = True
        await self._core.aclose()

    def _open_node(
        self, gateway: LoopGateway, on_graph: Callable[[], None], on_shutdown: Callable[[], None]
    ) -> NodePort:
        """Open the node. A test's session overrides this, to open one in memory."""
        ros_node: type[RosNode] = _import_ros("rosasync.ros.node").RosNode
        return ros_node(self._options, gateway, on_graph, on_shutdown)

    def _open_core(self) -> _Core:
        if self._core is None:
            raise UsageError("the session is not open: use `async with rosasync.Session(…)`")
        return self._core

    def _use(self) -> _Core:
        core = self._core
        if core is None:
            raise (
                SessionClosed("the session is closed")
                if self._closed
                else UsageError("the session is not open: use `async with rosasync.Session(…)`")
            )
        core.check_loop()
        return core

    @property
    def _loop(self) -> asyncio.AbstractEventLoop:
        return self._open_core().loop


class ServiceClient:
    """A service type and name bound to a session; see `Session.client`."""

    __slots__ = ("_endpoint", "_session", "_timeout")

    def __init__(self, session: Session, endpoint: Endpoint, timeout: float | None) -> None:
        self._session = session
        self._endpoint = endpoint
        self._timeout = timeout

    def __repr__(self) -> str:
        return f"<ServiceClient {self.srv_name} [{self.srv_type}]>"

    @property
    def srv_name(self) -> str:
        """The resolved service name."""
        return self._endpoint.key.srv_name

    @property
    def srv_type(self) -> str:
        """The service type's name."""
        return self._endpoint.key.srv_type

    @property
    def ready(self) -> bool:
        """Whether a server is matched, so that a call would be sent at once."""
        return self._session._use().pool.is_ready(self._endpoint)

    async def call(
        self,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        wait: bool = True,
        retry: Retry | None = None,
    ) -> Any:
        """Call the service; see `Session.call`."""
        pool = self._session._use().pool
        message = pool.request(self._endpoint, request)
        seconds = self._timeout if timeout is ... else check_timeout(timeout, None)
        return await pool.call(self._endpoint, message, seconds, wait, retry)

    def start(
        self,
        request: Any = None,
        *,
        timeout: Timeout = ...,
        wait: bool = True,
        retry: Retry | None = None,
    ) -> asyncio.Task[Any]:
        """Start the same call as a task; see `Session.start`."""
        core = self._session._use()
        message = core.pool.request(self._endpoint, request)
        seconds = check_timeout(timeout, self._timeout)
        return core.loop.create_task(core.pool.call(self._endpoint, message, seconds, wait, retry))

    async def wait(self, timeout: float | None = None) -> None:
        """Wait until a server is matched; see `Session.wait_for_service`."""
        pool = self._session._use().pool
        await pool.wait_for_server(self._endpoint, check_timeout(timeout, None))


class _Core:
    """What an open session consists of, without a way back to it.

    So a session that is dropped unclosed can be collected, say so, and end its thread.
    """

    def __init__(self, session: Session) -> None:
        self.loop = asyncio.get_running_loop()
        self.gateway = LoopGateway()
        self.ros = session._open_node(self.gateway, self._graph_changed, self._context_shut_down)
        self.name = self.ros.name
        self.pool = ClientPool(
            self.ros, session._options.limits, session._options.timeout, self._context_shut_down
        )
        self.gate = Gate(self.ros, self.gateway, self.pool, session._options.timeout)
        self.portal = Portal(self.gate)
        self.servers: dict[ServiceServer[Any, Any], None] = {}
        self._ended: asyncio.Task[None] | None = None
        self._session = weakref.ref(session)
        atexit.register(self._exit)

    def serve(
        self, srv_type: Any, srv_name: str, handler: Any, **options: Any
    ) -> ServiceServer[Any, Any]:
        """Make a server that ends with the session."""
        self.pool.check_open()
        server = ServiceServer[Any, Any](
            self.ros, srv_type, srv_name, handler, on_end=self.servers.pop, **options
        )
        self.servers[server] = None
        return server

    def check_loop(self) -> None:
        """Raise `UsageError` on any other loop or thread than the session's."""
        if asyncio._get_running_loop() is not self.loop:
            raise UsageError(
                "a session is used in the loop that opened it; from other threads there is "
                "session.from_thread"
            )

    async def aclose(self) -> None:
        """End everything, once; whoever else closes waits for the same end."""
        # Before the task is created, because an eager one closes the servers at once.
        for server in self.servers:
            server.exclude_caller()
        if self._ended is None:
            self._ended = self.loop.create_task(self._end())
        await until_done(self._ended)

    def abandon(self) -> None:
        """End a session that nobody closed. Called by the garbage collector, on any thread."""
        atexit.unregister(self._exit)
        self.ros.stop()
        self.gate.end()
        self.gateway.close()
        if self.loop.is_closed():
            self._give_up()
        else:
            self.loop.call_soon_threadsafe(self._abandon)

    def _abandon(self) -> None:
        self.pool.end(_session_closed)
        self._give_up()

    def _give_up(self) -> None:
        self._end_servers(_session_closed)
        if self.ros.join():
            self.ros.close()

    def _exit(self) -> None:
        """End the thread at the interpreter's exit; see ExecutorThread."""
        session = self._session()
        if session is not None and not session.closed:
            session._closed = True
            _warn_unclosed(session)
        self.ros.stop()
        self.gate.end()
        self.gateway.close()
        self.ros.join()

    async def _end(self) -> None:
        atexit.unregister(self._exit)
        await asyncio.gather(*(server.aclose() for server in self.servers))
        self.pool.end(_session_closed)
        self.ros.stop()
        self.gate.end()
        self.gateway.close()
        with anyio.move_on_after(ENDING, shield=True):
            await self.ros.stopped()
            self.ros.join()
            self.ros.close()
            return
        logger.warning(
            "a callback of node %s is still running: its executor thread is left behind",
            self.ros.name,
        )

    def _graph_changed(self) -> None:
        self.pool.graph_changed()
        for server in tuple(self.servers):
            server.check_port()

    def _context_shut_down(self) -> None:
        self.pool.end(context_shut_down)
        self._end_servers(context_shut_down)

    def _end_servers(self, ending: Callable[[], Exception]) -> None:
        for server in tuple(self.servers):
            server.end(ending)


def _warn_unclosed(session: Session) -> None:
    warnings.warn(f"unclosed {session!r}", ResourceWarning, source=session, stacklevel=2)


def _session_closed() -> Exception:
    return SessionClosed("the session is closed")


def _import_ros(module: str) -> Any:
    """Import a module that needs rclpy.

    Raises:
        ImportError: rclpy is not there; the message says how to get it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"rosasync needs rclpy, which does not import here ({error}). Without a ROS "
            "installation: pip install 'rosasync[jazzy]' (or [kilted]). With one: source its "
            "setup file, /opt/ros/<distribution>/setup.bash, and use its Python"
        ) from error
