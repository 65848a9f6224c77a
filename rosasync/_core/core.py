"""The parts of an open session, and how they end together."""

from __future__ import annotations

import _thread
import asyncio
import atexit
import functools
import logging
import os
import sys
import threading
import warnings
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import anyio

from rosasync._actions.registry import Actions
from rosasync._actions.server import ActionServer
from rosasync._client.graph_watch import GraphWatch
from rosasync._client.pool import ClientPool
from rosasync._core.aio import until_done
from rosasync._core.arguments import ArgumentChecker
from rosasync._core.fork import check_fork
from rosasync._core.gateway import LoopGateway
from rosasync._core.portal import Portal
from rosasync._server.server import ServiceServer
from rosasync._status.reporter import Reporter
from rosasync.errors import ContextShutdown, SessionClosed, UsageError
from rosasync.statistics import SessionStatistics
from rosasync.tracing import Tracing

if TYPE_CHECKING:
    from rosasync._actions.server import ServeService
    from rosasync._core.ports import NodePort
    from rosasync.options import SessionOptions

__all__ = ["Core", "OpenNode"]

logger = logging.getLogger("rosasync")

END_TIMEOUT = 5.0
"""Seconds to wait for a running callback of the node before its thread is left behind."""

OpenNode = Callable[[LoopGateway, Callable[[], None], Callable[[], None]], "NodePort"]
"""Opens a node. Takes the gateway, and the callbacks for graph changes and context shutdown."""


class Core:
    """The parts of an open session. It does not refer to the session itself.

    So a session that is dropped unclosed is garbage-collected, warns, and ends its thread.
    """

    def __init__(self, session: object, options: SessionOptions, open_node: OpenNode) -> None:
        self.loop = asyncio.get_running_loop()
        self.timeout = options.timeout
        self.gateway = LoopGateway()
        self.node = open_node(self.gateway, self._graph_changed, self._context_shut_down)
        self.name = self.node.name
        self.arguments = ArgumentChecker(self.node)
        self.tracing = Tracing(options.trace)
        graph_watch = GraphWatch(self.node, self._context_shut_down)
        self.pool = ClientPool(
            self.node, self.arguments, options.limits, options.timeout, graph_watch, self.tracing
        )
        self.actions = Actions(
            self.node,
            self.pool,
            graph_watch,
            self.tracing,
            options.timeout,
            self._context_shut_down,
        )
        self.portal = Portal(
            self.node, self.gateway, self.arguments, self.pool, self.actions, options.timeout
        )
        self.reporter = Reporter(self.node)
        # A server removes itself when it ends, by its `on_end`.
        self.servers: dict[ServiceServer[Any, Any], None] = {}
        # The same. Their services are among the servers.
        self.action_servers: dict[ActionServer[Any, Any, Any], None] = {}
        self.closed = False
        self._session = weakref.ref(session)
        self._end_task: asyncio.Task[None] | None = None
        self._cleaned_up = threading.Event()
        self._process = os.getpid()
        # Weak, because what the session serves may refer to the session.
        self._at_exit = functools.partial(_exit, weakref.ref(self))
        atexit.register(self._at_exit)

    @property
    def inherited(self) -> bool:
        """Whether this process was forked from the session's, which alone can end it."""
        return os.getpid() != self._process

    def check_loop(self) -> None:
        """Raise `UsageError` on any other loop or thread than the session's."""
        if asyncio._get_running_loop() is not self.loop:
            raise UsageError(self._explain_loop())

    def _explain_loop(self) -> str:
        """Return what is wrong with the caller's loop or thread, and what to do."""
        check_fork()
        name = f"session {self.name!r}"
        if self.node.executor_thread == threading.get_ident():
            return (
                f"{name}: this is a callback of the node, on the executor's thread: "
                "use session.from_thread.submit(…) here"
            )
        if not self.gateway.on_thread:
            return f"{name} belongs to the loop of another thread: use session.from_thread here"
        if asyncio._get_running_loop() is None:
            return f"{name} is used without a running event loop: use it in a coroutine of its loop"
        hint = ""
        if "pytest_asyncio" in sys.modules:
            hint = "; in a test, give the fixture that opens it the loop_scope of the test"
        return (
            f"{name} belongs to another event loop, and asyncio.run makes a new one each time: "
            f"open a session in each loop, or run everything in one{hint}"
        )

    def serve(
        self, srv_type: Any, srv_name: str, handler: Any, **options: Any
    ) -> ServiceServer[Any, Any]:
        """Create a server that ends with the session."""
        if self.closed:
            raise session_closed()
        self.pool.check_open()
        server = ServiceServer[Any, Any](
            self.node,
            srv_type,
            srv_name,
            handler,
            on_end=self.servers.pop,
            tracing=self.tracing.for_servers(),
            reporter=self.reporter,
            **options,
        )
        self.servers[server] = None
        return server

    def serve_action(
        self, serve: ServeService, action_type: Any, action_name: str, handler: Any, **options: Any
    ) -> ActionServer[Any, Any, Any]:
        """Create an action server that ends with the session; ``serve`` serves its services."""
        if self.closed:
            raise session_closed()
        self.pool.check_open()
        with self.tracing.muted():
            server = ActionServer[Any, Any, Any](
                self.node,
                serve,
                self.node.describe_action(action_type, action_name),
                handler,
                on_end=self.action_servers.pop,
                tracing=self.tracing,
                **options,
            )
        self.action_servers[server] = None
        return server

    def statistics(self) -> SessionStatistics:
        """Take a snapshot of the statistics; see `rosasync.Session.statistics`."""
        return SessionStatistics(
            bridge=self.node.bridge,
            pool=self.pool.statistics(),
            servers=tuple(server.statistics() for server in self.servers),
            action_servers=tuple(server.statistics() for server in self.action_servers),
        )

    async def aclose(self) -> None:
        """End everything; idempotent. All callers wait for the same task."""
        self.closed = True
        if self.inherited:
            return
        # Before the task is created, because an eager one closes the servers at once.
        for action_server in self.action_servers:
            action_server.exclude_caller()
        for server in self.servers:
            server.exclude_caller()
        if self._end_task is None:
            self._end_task = self.loop.create_task(self._end())
        await until_done(self._end_task)

    def abandon(self, session: object) -> None:
        """Clean up after a session that was never closed. From any thread, for ``__del__``.

        The garbage collector may run this while the thread holds any lock. So it takes none, which
        also rules out a ``threading.Thread``.
        """
        if self.inherited:
            return
        warning = f"unclosed {session!r}"
        self.closed = True
        self.node.stop()
        try:
            self.loop.call_soon_threadsafe(self._abandon)
        except RuntimeError:
            # The loop is closed.
            _thread.start_new_thread(self._clean_up, ())
        # Last, because a filter may turn the warning into an error.
        _warn(warning, session)

    def _abandon(self) -> None:
        self.actions.end(session_closed)
        self.pool.end(session_closed)
        self._clean_up()

    def _clean_up(self) -> None:
        self.gateway.close()
        self._end_servers(session_closed)
        if self.node.join():
            self.node.close()
        atexit.unregister(self._at_exit)
        self._cleaned_up.set()

    def exit(self) -> None:
        """End the executor thread, because the interpreter aborts if it exits while one spins."""
        if self.inherited:
            return
        session = self._session()
        warning = None
        if session is not None and not self.closed:
            warning = f"unclosed {session!r}"
            self.closed = True
        elif self.closed and self._end_task is None and self.loop.is_closed():
            self._cleaned_up.wait(END_TIMEOUT)
        self.node.stop()
        self.gateway.close()
        self.node.join()
        if warning is not None:
            _warn(warning, session)

    async def _end(self) -> None:
        # Each step also if the end of the loop cancels this task, as `asyncio.run` does.
        try:
            # First, while their services can still send the results.
            await asyncio.gather(*(server.aclose() for server in self.action_servers))
            await asyncio.gather(*(server.aclose() for server in self.servers))
            await self.actions.aclose(session_closed)
        finally:
            self.actions.end(session_closed)
            self.pool.end(session_closed)
            self._end_servers(session_closed)
            self.node.stop()
            self.gateway.close()
            await self._close_node()

    async def _close_node(self) -> None:
        stuck = False
        try:
            with anyio.move_on_after(END_TIMEOUT, shield=True) as scope:
                await self.node.wait_stopped()
            stuck = scope.cancelled_caught
        finally:
            if not stuck and self.node.join():
                self.node.close()
            else:
                logger.warning(
                    "a callback of node %s still runs after %g s, so the executor thread is left "
                    "behind: find a callback of the node that blocks",
                    self.name,
                    END_TIMEOUT,
                )
            # Last: if a second Ctrl-C interrupts the end, the interpreter's exit completes it.
            atexit.unregister(self._at_exit)

    def _graph_changed(self) -> None:
        self.pool.graph_changed()
        self.reporter.on_graph()
        for server in tuple(self.servers):
            server.on_graph()
        for action_server in tuple(self.action_servers):
            action_server.on_graph()

    def _context_shut_down(self) -> None:
        self.actions.end(ContextShutdown)
        self.pool.end(ContextShutdown)
        self._end_servers(ContextShutdown)

    def _end_servers(self, ending: Callable[[], Exception]) -> None:
        for action_server in tuple(self.action_servers):
            action_server.end(ending)
        for server in tuple(self.servers):
            server.end(ending)


def _exit(reference: weakref.ref[Core]) -> None:
    core = reference()
    if core is not None:
        core.exit()


def session_closed() -> SessionClosed:
    """Make the error for a session that has been closed."""
    return SessionClosed("the session is closed: open a new one")


def _warn(message: str, session: object) -> None:
    warnings.warn(message, ResourceWarning, source=session, stacklevel=3)
