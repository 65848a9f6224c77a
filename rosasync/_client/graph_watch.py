"""Watches the ROS graph: its generations, and polling while callers wait."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort

__all__ = ["GraphWatch", "Watcher"]

POLL_MIN = 0.002
"""Seconds until the first poll for a match, which takes milliseconds."""
POLL_GROWTH = 1.1
"""Each poll comes later than the one before by this factor, so a match that takes long is noticed
after about a tenth of that time at most: Fast DDS waits 0.3 s if it opens a port while it cannot
tell whether the port's reader is alive."""
POLL_MAX = 0.25
"""Maximum number of seconds between two polls while callers wait for a match."""
POLL_CONTEXT = 0.5
"""Seconds between two polls of the context while requests or goals are out. They are needed because
rclpy's signal handler shuts every context of the process down without an event."""


class Watcher(Protocol):
    """A service, or the actions of a session, which depend on the graph."""

    @property
    def is_busy(self) -> bool:
        """Whether there are callers, requests without a caller, or goals that are out."""

    @property
    def awaits_match(self) -> bool:
        """Whether callers wait for a client to be matched."""

    def on_graph(self) -> None:
        """Check the graph again, which may be the same as before.

        Raises:
            ContextShutdown: the node is down.
        """


class GraphWatch:
    """Makes the services and actions of a session check the graph when it may have changed.

    Confined to the loop's thread. A change of the graph begins a new generation, in which the match
    of every client is checked again. A match is not an event of the graph, so one timer for all of
    them polls for it. The timer starts when a caller waits for a match, or a request or a goal is
    sent, and stops when a poll finds neither callers nor requests nor goals.

    Attributes:
        generation: counts the changes of the graph.
        polling: whether the timer runs.
    """

    def __init__(self, node: NodePort, on_shutdown: Callable[[], object]) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._on_shutdown = on_shutdown
        self._watchers: list[Watcher] = []
        self.generation = 0
        self.polling = False
        self._timer: asyncio.TimerHandle | None = None
        self._delay = POLL_MIN
        self._closed = False

    def add(self, watcher: Watcher) -> None:
        """Add something that depends on the graph, for as long as the session lasts."""
        self._watchers.append(watcher)

    def changed(self) -> None:
        """Begin a new generation: the graph has changed."""
        if self._closed:
            return
        self.advance()
        self._check()
        if any(watcher.awaits_match for watcher in self._watchers):
            self.poll_soon()

    def advance(self) -> None:
        """Begin a new generation without checking anything."""
        self.generation += 1

    def poll_soon(self) -> None:
        """Poll after `POLL_MIN` seconds, then at growing intervals while callers wait."""
        self._delay = POLL_MIN
        self._poll_in(POLL_MIN)

    def keep_polling(self) -> None:
        """Start the timer unless it runs."""
        if not self.polling and not self._closed:
            if not self._node.graph_events:
                self.advance()
            self._poll_in(POLL_CONTEXT)

    def close(self) -> None:
        """Stop the timer; idempotent."""
        self._closed = True
        self.polling = False
        if self._timer is not None:
            self._timer.cancel()

    def _poll_in(self, delay: float) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if not self._closed:
            self.polling = True
            self._timer = self._loop.call_later(delay, self._poll)

    def _poll(self) -> None:
        self._timer = None
        if not self._node.ok():
            self.polling = False
            self._on_shutdown()
            return
        if not self._node.graph_events:
            self.advance()
        # `polling` stays set during this, because a dispatch would start the slow timer otherwise.
        try:
            self._check()
        finally:
            self._poll_again()

    def _poll_again(self) -> None:
        if self._timer is not None or self._closed:
            return
        if any(watcher.awaits_match for watcher in self._watchers):
            self._delay = min(self._delay * POLL_GROWTH, POLL_MAX)
            self._poll_in(self._delay)
        elif any(watcher.is_busy for watcher in self._watchers):
            self._poll_in(POLL_CONTEXT)
        else:
            self.polling = False

    @contextmanager
    def reports_shutdown(self) -> Iterator[None]:
        """Report a `ContextShutdown` that the block raises, and suppress it."""
        try:
            yield
        except ContextShutdown:
            self._on_shutdown()

    def _check(self) -> None:
        with self.reports_shutdown():
            for watcher in tuple(self._watchers):
                watcher.on_graph()
