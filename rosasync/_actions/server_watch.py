"""ServerWatch: the servers of an action, as the graph shows them."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._actions.active_goal import ActiveGoal
    from rosasync._actions.errors import GoalErrors
    from rosasync._client.pool import ClientPool
    from rosasync._core.ports import Action, NodePort, Servers

__all__ = ["ServerWatch"]

MATCH_TIMEOUT = 1.0
"""Seconds to wait until the topics are matched with a server that accepts goals already."""
POLL_MIN = 0.002
"""Seconds until the first look for these matches. The intervals grow."""

GRAPH_DELAY = 0.05
"""Seconds until the next look at a graph that has no server, although one is matched."""


class Matched(Protocol):
    """Something that is of use once it is matched with a server."""

    def ready(self) -> bool:
        """Return whether it is."""


class ServerWatch:
    """Knows which servers an action has, and waits for one. Confined to the loop's thread.

    Args:
        action: the action.
        node: shows the graph.
        pool: sends goals and cancellations.
        errors: the errors of goals.
        ports: what else has to be matched before a goal is sent, so that nothing is lost that its
            server sends.
    """

    def __init__(
        self,
        action: Action,
        node: NodePort,
        pool: ClientPool,
        errors: GoalErrors,
        ports: tuple[Matched, ...],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._action = action
        self._node = node
        self._pool = pool
        self._errors = errors
        self._ports = ports
        # None after the graph has changed.
        self._servers: Servers | None = None
        self._matched = False

    def reset(self) -> None:
        """Look again when asked: the graph has changed, or the ports are new."""
        self._servers = None
        self._matched = False

    def servers(self) -> Servers:
        """Return the servers that the graph shows.

        Raises:
            ContextShutdown: the node is down.
        """
        if self._servers is None:
            self._servers = self._node.queries.find_servers(self._action.get_result)
        return self._servers

    def servers_now(self) -> Servers:
        """As `servers`, but never from before a change that the graph has not reported."""
        if not self._node.graph_events:
            self._servers = None
        return self.servers()

    def exists(self) -> bool:
        """Return whether the graph shows a server at this moment; raises as `servers`."""
        self._servers = None
        return bool(self.servers())

    def is_single(self) -> bool:
        """Return whether there is no second server, so that what one says holds for the name."""
        with suppress(ContextShutdown):
            return len(self.servers()) <= 1
        return True

    def has_lost(self, goal: ActiveGoal) -> bool:
        """Return whether every server that may have an accepted goal has vanished.

        Raises:
            ContextShutdown: as `servers`.
        """
        before = goal.servers
        return goal.asked and bool(before) and before.isdisjoint(self.servers())

    async def reach(self, goal: ActiveGoal, deadline: float | None, wait: bool | float) -> None:
        """Wait for a server, and then, not for long, until every port is matched with it.

        Args:
            goal: the goal that waits.
            deadline: the loop time until which to wait, None for no deadline.
            wait: whether, or for how many seconds, to wait for a server.

        Raises:
            ServiceUnavailable: there is no server.
            Exception: as `ServicePool.wait_for_server`.
        """
        if wait is False and not self.exists():
            raise self._errors.unavailable(goal)
        service = self._pool.service_of(self._action.send_goal)
        if not service.match():
            now = self._loop.time()
            left = [] if deadline is None else [max(0.0, deadline - now)]
            if wait is not True:
                left.append(MATCH_TIMEOUT if wait is False else wait)
            await service.wait_for_server(min(left, default=None))
        limit = self._loop.time() + MATCH_TIMEOUT
        if deadline is not None:
            limit = min(limit, deadline)
        delay = POLL_MIN
        while not self._match() and self._loop.time() < limit:
            await asyncio.sleep(delay)
            delay *= 1.5

    async def find(self, goal: ActiveGoal, deadline: float | None, wait: bool | float) -> Servers:
        """As `reach`, and return the servers, of which there is one at least.

        The one that was reached may have vanished since, and the next is waited for.
        """
        while True:
            await self.reach(goal, deadline, wait)
            if servers := self.servers_now():
                return servers
            if deadline is not None and self._loop.time() >= deadline:
                raise self._errors.unavailable(goal)
            # Still matched, as the client sees it: it learns of the end apart from the graph.
            await asyncio.sleep(GRAPH_DELAY)

    def _match(self) -> bool:
        if not self._matched:
            cancel = self._pool.service_of(self._action.cancel_goal)
            self._matched = cancel.match() and all(port.ready() for port in self._ports)
        return self._matched
