"""The errors of one service's calls, with their messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rosasync.errors import (
    CallError,
    ContextShutdown,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    ServerGone,
    ServiceUnavailable,
)

if TYPE_CHECKING:
    from rosasync.ports import NodePort, Service

__all__ = ["CallErrors"]


class CallErrors:
    """Makes the errors of one service's calls. ``elapsed`` is always in seconds."""

    def __init__(self, service: Service, node: NodePort) -> None:
        self._service = service
        self._node = node

    def unavailable(self, elapsed: float) -> CallError:
        """There is no server."""
        seen = self._node.explain_missing(self._service)
        message = f"no server for {self._service.key.srv_type} after {elapsed:.3g} s; {seen}"
        return self._make(ServiceUnavailable, message, elapsed)

    def queue_timeout(self, elapsed: float, in_flight: int, abandoned: int) -> CallError:
        """There is a server, but no client became free."""
        message = (
            f"no client became free within {elapsed:.3g} s: {in_flight} requests are in flight, "
            f"and {abandoned} abandoned ones still take a place"
        )
        return self._make(QueueTimeout, message, elapsed)

    def response_timeout(self, elapsed: float) -> CallError:
        """The request was sent, and not answered."""
        return self._make(
            ResponseTimeout, f"sent, and not answered within {elapsed:.3g} s", elapsed
        )

    def server_gone(self, elapsed: float) -> CallError:
        """Every server that fits has vanished."""
        return self._make(ServerGone, "every server vanished before it answered", elapsed)

    def client_destroyed(self) -> ContextShutdown:
        """Something else than rosasync has destroyed the rclpy client."""
        return ContextShutdown(
            f"{self._service.key.srv_name}: the client was destroyed by other means than rosasync; "
            "the next call creates a new one"
        )

    def pool_full(self, waiting: int, limit: int) -> PoolFull:
        """The queue is as long as allowed."""
        return PoolFull(
            f"{self._service.key.srv_name}: {waiting} callers wait for a client, and "
            f"Limits.waiting={limit} allows no more"
        )

    def _make(self, kind: type[CallError], message: str, elapsed: float) -> CallError:
        name, type_name, _ = self._service.key
        return kind(f"{name}: {message}", srv_name=name, srv_type=type_name, elapsed=elapsed)
