"""The errors of a service's calls, and their messages."""

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
    from rosasync._client.retry import Attempts
    from rosasync._core.ports import NodePort, Service

__all__ = ["CallErrors"]


class CallErrors:
    """Makes the errors of one service's calls. ``elapsed`` is in seconds."""

    def __init__(self, service: Service, node: NodePort) -> None:
        self._service = service
        self._node = node

    def unavailable(self, elapsed: float) -> CallError:
        """Return the error for a call that found no server."""
        seen = self._node.explain_missing(self._service)
        message = f"no server for {self._service.key.srv_type} after {elapsed:.3g} s; {seen}"
        return self._make(ServiceUnavailable, message, elapsed)

    def queue_timeout(self, elapsed: float, in_flight: int, abandoned: int) -> CallError:
        """Return the error for a call that found a server, but no free client."""
        message = (
            f"no client became free within {elapsed:.3g} s: {in_flight} requests are in flight, "
            f"and {abandoned} abandoned requests (cancelled or timed out) still count; the server "
            "is slower than its callers"
        )
        return self._make(QueueTimeout, message, elapsed)

    def response_timeout(self, elapsed: float, attempts: Attempts | None) -> CallError:
        """Return the error for a request that was sent and not answered."""
        message = f"the request was sent, but not answered within {elapsed:.3g} s"
        if attempts is not None:
            message += attempts.explain_timeout()
        return self._make(ResponseTimeout, message, elapsed)

    def server_gone(self, elapsed: float) -> CallError:
        """Return the error for a request whose servers have all vanished."""
        return self._make(ServerGone, "every server vanished before it answered", elapsed)

    def client_destroyed(self) -> ContextShutdown:
        """Return the error for an rclpy client that something other than rosasync has destroyed."""
        return ContextShutdown(
            f"{self._service.key.srv_name}: the client was destroyed by something other than "
            "rosasync; the next call creates a new one"
        )

    def pool_full(self, waiting: int, limit: int) -> PoolFull:
        """Return the error for a call that finds the queue full."""
        return PoolFull(
            f"{self._service.key.srv_name}: {waiting} callers already wait for a client, and "
            f"Limits.waiting={limit} allows no more: the server is slower than its callers"
        )

    def _make(self, kind: type[CallError], message: str, elapsed: float) -> CallError:
        name, type_name, _ = self._service.key
        return kind(f"{name}: {message}", srv_name=name, srv_type=type_name, elapsed=elapsed)
