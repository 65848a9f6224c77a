"""What happens to a node on other threads, carried into the session's loop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable

from rosasync._core.gateway import LoopGateway

__all__ = ["NodeEvents"]

logger = logging.getLogger("rosasync")

CALLBACK_RAISED = "a callback of the node raised an exception; the session goes on"


class NodeEvents:
    """Reports what the executor's thread, or the one that shuts the context down, tells it.

    Created on the loop's thread; the methods may be called from any thread.

    Args:
        gateway: the way into the loop.
        on_graph: called on the loop's thread after a change of the graph, once for all changes that
            come before its turn.
        on_shutdown: called on the loop's thread when the context is shut down.

    Attributes:
        left: set when the executor thread no longer runs for the session.
    """

    def __init__(
        self,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> None:
        self.left = asyncio.Event()
        self._gateway = gateway
        self._on_graph = on_graph
        self._on_shutdown = on_shutdown
        # Set by other threads, and reset on the loop's before `on_graph`, so that a change during
        # it is reported again.
        self._graph_pending = False

    def post_graph(self) -> None:
        """Report a change of the graph."""
        if not self._graph_pending:
            self._graph_pending = True
            self._gateway.post_if_open(self._report_graph)

    def post_shutdown(self) -> None:
        """Report that the context was shut down."""
        self._gateway.post_if_open(self._on_shutdown)

    def post_left(self) -> None:
        """Report that the executor thread no longer runs for the session.

        Not by the gateway, which is closed by then.
        """
        with contextlib.suppress(RuntimeError):
            self._gateway.loop.call_soon_threadsafe(self.left.set)

    def post_error(self, error: Exception) -> None:
        """Report an exception of a callback of the node to the loop's exception handler."""
        context = {"message": CALLBACK_RAISED, "exception": error}
        if self._gateway.closed:
            logger.error(CALLBACK_RAISED, exc_info=error)
        else:
            self._gateway.post_if_open(self._gateway.loop.call_exception_handler, context)

    def _report_graph(self) -> None:
        self._graph_pending = False
        self._on_graph()
