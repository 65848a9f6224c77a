"""The opening of a session and of its node."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._core.aio import call_in_thread
from rosasync._core.core import Core, session_closed
from rosasync._ros.middleware import check_middleware
from rosasync.errors import UsageError

if TYPE_CHECKING:
    from rosasync._core.gateway import LoopGateway
    from rosasync._core.ports import NodePort
    from rosasync._ros.node import RosNode
    from rosasync.options import SessionOptions

__all__ = ["NodeOpener", "Opening", "RosOpener"]


class NodeOpener(Protocol):
    """Opens the nodes of sessions: rclpy's, or those of `rosasync.testing`."""

    async def load(self) -> None:
        """Import what `open` needs, while the loop runs other tasks."""

    def open(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> NodePort:
        """Open a node; blocks. The callbacks run on the loop's thread."""


class RosOpener:
    """Opens nodes of rclpy, which it imports at the first opening."""

    async def load(self) -> None:
        """Import rclpy, and what it loads for the first node, in a thread.

        Raises:
            ImportError: rclpy is not installed, or the middleware that the environment names; the
                message says what to do.
        """
        await call_in_thread(_load, "rosasync import")

    def open(
        self,
        options: SessionOptions,
        gateway: LoopGateway,
        on_graph: Callable[[], None],
        on_shutdown: Callable[[], None],
    ) -> NodePort:
        """Open a node; raises as `rosasync._ros.node.RosNode`."""
        ros_node: type[RosNode] = _import("rosasync._ros.node").RosNode
        return ros_node(options, gateway, on_graph, on_shutdown)


class Opening:
    """Whether a session is open, and its parts from then on.

    Args:
        options: the session's.

    Attributes:
        opener: opens the node. A session of `rosasync.testing` has one of its own.
        core: the parts of the session, from its opening on; also after its end.
    """

    def __init__(self, options: SessionOptions) -> None:
        self.options = options
        self.opener: NodeOpener = RosOpener()
        self.core: Core | None = None
        # Whether it was closed before it was open. Once it is open, `Core.closed` counts.
        self._closed = False
        self._in_progress = False

    @property
    def closed(self) -> bool:
        """Whether the session has been closed, or has begun to close."""
        return self._closed if self.core is None else self.core.closed

    async def open(self, session: object) -> None:
        """Open the session; see `rosasync.Session.open`. It is not kept alive by its parts."""
        if self.core is not None or self._closed or self._in_progress:
            raise UsageError("a session can be opened only once: create a new one")
        self._in_progress = True
        try:
            await self.opener.load()
        finally:
            self._in_progress = False
        # Asked only now: it may have been closed while this task waited for the import.
        if self._closed:
            raise session_closed()
        self.core = Core(session, self.options, partial(self.opener.open, self.options))

    async def aclose(self) -> None:
        """End the session; see `rosasync.Session.aclose`."""
        if self.core is None:
            self._closed = True
            return
        if not self.core.inherited:
            self.core.check_loop()
        await self.core.aclose()

    def parts(self) -> Core:
        """Return the parts, also of a session that has ended.

        Raises:
            UsageError: the session was never open.
        """
        if self.core is None:
            raise _not_open()
        return self.core

    def use(self) -> Core:
        """Return the parts, for an operation of the session's loop.

        Raises:
            UsageError: the session is not open, or belongs to another loop or thread.
            SessionClosed: it was closed before it was open.
        """
        core = self.core
        if core is None:
            raise session_closed() if self._closed else _not_open()
        core.check_loop()
        return core


def _not_open() -> UsageError:
    return UsageError(
        "the session is not open: use `async with rosasync.Session(…) as session:`, or "
        "`await session.open()`"
    )


def _load() -> None:
    _import("rosasync._ros.node")
    _import("rosasync._ros.type_supports").load()


def _import(module: str) -> Any:
    """Import a module that needs rclpy; raises as `RosOpener.load`."""
    check_middleware()
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"rosasync needs rclpy, which cannot be imported here ({error}). Without a ROS "
            "installation: pip install 'rosasync[jazzy]' (or [kilted]). With one: source its "
            "setup file, /opt/ros/<distribution>/setup.bash, and use its Python"
        ) from error
