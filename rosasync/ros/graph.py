"""Graph events: servers appearing and vanishing, seen by whoever spins the node."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable

from rosasync.ros.rcl import Rcl

__all__ = ["GraphWaitable"]

_all: weakref.WeakSet[GraphWaitable] = weakref.WeakSet()


class GraphWaitable(Waitable):  # type: ignore[misc]
    """Waits on the node's graph guard condition and tells of every change.

    The guard condition is the context's: the first wait set that sees it triggered resets it. So
    a waitable that is woken tells its fellows of the same context as well.
    """

    def __init__(self, node: Node, rcl: Rcl, on_change: Callable[[], None]) -> None:
        # The callback group knows its entities by weak reference, the waitable keeps the group.
        super().__init__(ReentrantCallbackGroup())
        self._node = node
        self._rcl = rcl
        self._on_change = on_change
        self._entered = False
        self._index: int | None = None
        _all.add(self)
        node.add_waitable(self)

    def close(self) -> None:
        """Leave the node; idempotent."""
        _all.discard(self)
        if self in self._node.waitables:
            self._node.remove_waitable(self)

    def __enter__(self) -> None:
        self._entered = False
        self._node.handle.__enter__()
        self._entered = True

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._entered = False
        self._node.handle.__exit__(exc_type, exc, traceback)

    def get_num_entities(self) -> NumberOfEntities:
        """One guard condition."""
        return NumberOfEntities(num_gcs=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add the guard condition, unless the node has been destroyed."""
        self._index = None
        if self._entered:
            self._index = self._rcl.add_graph_guard(self._node.handle, wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        """Tell whether the graph has changed."""
        return self._index is not None and wait_set.is_ready("guard_condition", self._index)

    def take_data(self) -> None:
        """The wait has reset the guard condition: there is nothing to take."""

    async def execute(self, taken_data: None) -> None:
        """Tell every waitable of the context."""
        for waitable in tuple(_all):
            if waitable._node.context is self._node.context:
                waitable._on_change()
