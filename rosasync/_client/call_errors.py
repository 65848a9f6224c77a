"""The errors of a service's calls, and their messages."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from rosasync._core.text import count, duration
from rosasync._status.wire import Outcome
from rosasync.errors import (
    CallError,
    ContextShutdown,
    HandlerFailed,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    ServerGone,
    ServerOverloaded,
    ServiceUnavailable,
)

if TYPE_CHECKING:
    from rosasync._client.retry import Plan
    from rosasync._core.ports import GraphPort, Service
    from rosasync._status.wire import Report

__all__ = ["AllServersGone", "CallErrors", "NoServer", "Refused"]


SETTLED = 1.0
"""Seconds after which something should have arrived from every process that is visible."""

SHARED = 20
"""How long a description of the graph is used again, in multiples of the time that it took."""


class AllServersGone(Exception):
    """Every server that had a request has vanished. Callers get `ServerGone` for it."""


class NoServer(Exception):
    """There was no server for as long as the call may wait for one."""


class Refused(Exception):
    """The server has reported that it will not answer. Callers get the error for the report."""

    def __init__(self, report: Report) -> None:
        super().__init__(report.outcome.value)
        self.report = report


class CallErrors:
    """Makes the errors of one service's calls. ``elapsed`` is in seconds."""

    def __init__(self, service: Service, queries: GraphPort, clock: Callable[[], float]) -> None:
        self._service = service
        self._queries = queries
        self._clock = clock
        # The last explanation of what the graph shows, and until when it may be used again.
        self._seen = ""
        self._seen_until = -math.inf

    def unavailable(self, elapsed: float) -> CallError:
        """Return the error for a call that found no server."""
        seen = self._explain_missing()
        message = f"no server for {self._service.key.srv_type} after {duration(elapsed)}; {seen}"
        return self._make(ServiceUnavailable, message, elapsed)

    def no_time_left(self) -> CallError:
        """Return the error for a call that begins with no time left."""
        message = "no time was left when the call was made (timeout=0 or less): nothing was sent"
        return self._make(QueueTimeout, message, 0.0)

    def queue_timeout(self, elapsed: float, in_flight: int, abandoned: int) -> CallError:
        """Return the error for a call that found a server, but no free client."""
        message = (
            f"no client became free within {duration(elapsed)}: {count(in_flight, 'request')} in "
            f"flight, and {count(abandoned, 'abandoned request')} (cancelled or timed out) still "
            "counted; the server is slower than its callers"
        )
        return self._make(QueueTimeout, message, elapsed)

    def too_late(self, elapsed: float, needed: float, left: float) -> CallError:
        """Return the error for a call that was not sent, because its answer would come too late."""
        message = (
            f"not sent within {elapsed:.3g} s: the server answers after {needed:.2g} s now, and "
            f"{left:.2g} s were left when the call's turn came; the server is slower than its "
            "callers"
        )
        return self._make(QueueTimeout, message, elapsed)

    def response_timeout(self, elapsed: float, plan: Plan | None) -> CallError:
        """Return the error for a request that was sent and not answered."""
        message = f"the request was sent, but not answered within {duration(elapsed)}"
        if plan is not None:
            message += plan.explain_timeout()
        with contextlib.suppress(ContextShutdown):
            if elapsed >= SETTLED and (silence := self._queries.explain_silence(self._service)):
                message += f"; {silence}"
        return self._make(ResponseTimeout, message, elapsed)

    def server_gone(self, elapsed: float) -> CallError:
        """Return the error for a request whose servers have all vanished."""
        return self._make(ServerGone, "every server vanished before it answered", elapsed)

    def refused(self, elapsed: float, report: Report) -> CallError:
        """Return the error for a request that the server has reported not to answer."""
        if report.outcome is Outcome.CLOSED:
            return self._make(ServerGone, "the server closed before it answered", elapsed)
        if report.outcome is Outcome.DROPPED:
            message = "the server dropped the request, because too many were waiting there"
            return self._make(ServerOverloaded, message, elapsed)
        message = f"the handler failed: {report.error_type or 'it dropped the call unanswered'}"
        error = self._make(
            HandlerFailed, f"{message}: {report.error_message}".removesuffix(": "), elapsed
        )
        assert isinstance(error, HandlerFailed)
        error.error_type, error.error_message = report.error_type, report.error_message
        return error

    def client_destroyed(self) -> ContextShutdown:
        """Return the error for an rclpy client that something other than rosasync has destroyed."""
        return ContextShutdown(
            f"{self._service.key.srv_name}: the client was destroyed by something other than "
            "rosasync; the next call creates a new one"
        )

    def pool_full(self, waiting: int, limit: int) -> PoolFull:
        """Return the error for a call that finds the queue full."""
        return PoolFull(
            f"{self._service.key.srv_name}: {count(waiting, 'caller')} in the queue for a client, "
            f"and Limits.waiting={limit}: the server is slower than its callers, so call less "
            "often, or raise the limit"
        )

    def _explain_missing(self) -> str:
        """Describe what the graph shows instead of this service.

        In a large graph this takes milliseconds, and many calls may time out together. So one
        description serves for `SHARED` times as long as it took: the loop spends one part in that
        many on it, however many calls fail.
        """
        now = self._clock()
        if now >= self._seen_until:
            self._seen = self._queries.explain_missing(self._service)
            ended = self._clock()
            self._seen_until = ended + SHARED * (ended - now)
        return self._seen

    def _make(self, kind: type[CallError], message: str, elapsed: float) -> CallError:
        name, type_name, _ = self._service.key
        return kind(f"{name}: {message}", srv_name=name, srv_type=type_name, elapsed=elapsed)
