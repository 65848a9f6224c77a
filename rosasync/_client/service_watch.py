"""The servers of one service, as they come and go."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort, Service

__all__ = ["ServiceState", "watch_servers"]

POLL = 0.25
"""Seconds between two queries if the node reports no changes of the graph."""


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The servers of a service; see `Session.watch_service`.

    Attributes:
        status: ``"up"``: there is a server; ``"gone"``: there is none; ``"replaced"``: there is
            one, and none of those that were there before.
        nodes: the full names of the servers' nodes, as far as the graph shows them.
    """

    status: Literal["up", "gone", "replaced"]
    nodes: tuple[str, ...]


async def watch_servers(
    service: Service, node: NodePort, changed: asyncio.Event, check_open: Callable[[], None]
) -> AsyncIterator[ServiceState]:
    """Yield the state now, and after each change of the servers that fit.

    Args:
        service: the service.
        node: the node whose graph is watched.
        changed: set when the graph has changed, and when the session ends.
        check_open: raises once the session has ended.
    """
    before, queries = None, node.queries
    while True:
        check_open()
        changed.clear()
        servers = queries.find_servers(service)
        if servers != before:
            if not servers:
                yield ServiceState("gone", ())
            else:
                replaced = bool(before) and not servers & (before or servers)
                yield ServiceState("replaced" if replaced else "up", queries.name_servers(service))
            before = servers
            # The graph may have changed while the caller had the state.
            continue
        with suppress(TimeoutError):
            async with asyncio.timeout(None if node.graph_events else POLL):
                await changed.wait()
