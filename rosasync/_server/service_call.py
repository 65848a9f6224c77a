"""ServiceCall: one request to a server, to be answered once."""

from __future__ import annotations

import warnings
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from time import monotonic_ns
from typing import TYPE_CHECKING, Any, Generic, Protocol

from rosasync._server.sending import COLLECTED, ResponseSender
from rosasync._status.wire import Outcome
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from rosasync._core.ports import RequestHeader
    from rosasync._server.call_status import CallStatus
    from rosasync.statistics import ServerStatistics
    from rosasync.tracing import ServerTrace

__all__ = ["RequestInfo", "ServiceCall", "TakingServer"]

LATE = 100_000_000
"""Nanoseconds after which the graph is checked for a client, because it may have left."""

_ANSWERED = "answered"


@dataclass(frozen=True, slots=True)
class RequestInfo:
    """What the middleware reports about a request.

    Attributes:
        sequence_number: counts the requests of one client; two clients may use the same.
        source_timestamp: when it was sent, in ns of the system clock; None if unknown.
        received_timestamp: when it arrived, in ns; None if unknown.
    """

    sequence_number: int
    source_timestamp: int | None
    received_timestamp: int | None


class TakingServer(Protocol):
    """The server of a call: a `ServiceServer`, which this module cannot import."""

    @property
    def srv_name(self) -> str:
        """The resolved service name."""

    @property
    def srv_type(self) -> str:
        """The service type's name."""

    @property
    def qos(self) -> Any:
        """A snapshot of the ``QoSProfile`` in use."""

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, or its closing has begun."""

    @property
    def handle(self) -> Any:
        """The ``rclpy.service.Service``."""

    def statistics(self) -> ServerStatistics:
        """Return a snapshot."""

    async def aclose(self, timeout: float | None = ...) -> None:
        """End the server."""


class ServiceCall(Generic[RequestT, ResponseT]):
    """One request, to be answered once.

    Keep it to respond later, in any order, from any task or thread. A call that is dropped
    unanswered is a ``ResourceWarning``.

    Attributes:
        request: the request message.
        server: the `ServiceServer` that took it.
    """

    __slots__ = (
        "__weakref__",
        "_header",
        "_outcome",
        "_received",
        "_response",
        "_sender",
        "request",
        "server",
        "status",
        "trace",
    )

    def __init__(
        self,
        server: TakingServer,
        request: RequestT,
        header: RequestHeader,
        sender: ResponseSender[ResponseT],
        received: int,
        trace: ServerTrace | None,
    ) -> None:
        self.server = server
        self.request = request
        self._header = header
        self._sender = sender
        self._response: ResponseT | None = None
        # None until the call is settled; changed under the sender's lock.
        self._outcome: str | None = None
        self._received = received
        # For the server and its sender, which report what happens to the call.
        self.trace = trace
        # The same, if the server tells its callers. Set by the server.
        self.status: CallStatus | None = None

    def __repr__(self) -> str:
        number = self._header.request_id.sequence_number
        return f"<ServiceCall {self._sender.name} #{number} {self._outcome or 'unanswered'}>"

    def __del__(self) -> None:
        if self._outcome is None and self._sender.count_collected(self.trace):
            if self.status is not None:
                self.status.report(Outcome.FAILED)
            warnings.warn(
                f"{self._sender.name}: {COLLECTED}",
                ResourceWarning,
                source=self,
                stacklevel=2,
            )

    @property
    def info(self) -> RequestInfo:
        """The sequence number and the timestamps."""
        header = self._header
        return RequestInfo(
            header.request_id.sequence_number,
            _timestamp(header.source_timestamp),
            _timestamp(header.received_timestamp),
        )

    @property
    def response(self) -> ResponseT:
        """A response to fill. It is created at the first access, and the same one afterwards."""
        if self._response is None:
            self._response = self._sender.response_type()
        return self._response

    @property
    def responded(self) -> bool:
        """Whether it has been answered."""
        return self._outcome == _ANSWERED

    @property
    def sent(self) -> bool:
        """Whether its response has been sent. Only on the loop's thread.

        False after it was answered if the middleware has not discovered its client completely. Then
        the response is sent again later.
        """
        return self.responded and not self._sender.is_waiting(self._header)

    @property
    def client(self) -> Hashable:
        """What tells its client from others, in all processes; None if it is unknown."""
        return self._sender.client_of(self._header)

    @property
    def settled(self) -> bool:
        """Whether it has been answered or given up."""
        return self._outcome is not None

    @property
    def abandoned(self) -> bool:
        """Whether its caller has left. Always False unless the server has ``status=True``."""
        return self.status is not None and self.status.abandoned

    def respond(self, response: ResponseT | Mapping[str, Any]) -> None:
        """Convert the response and send it, at once and in the calling thread.

        From any thread. The message may be changed or reused afterwards. If the client is gone, the
        response is logged and counted as undeliverable, and no error is raised.

        Args:
            response: a message of the service's response type, or a mapping of its fields.

        Raises:
            TypeError, ValueError: it is something else, or a field does not fit; nothing was sent,
                and the call can still be answered.
            RosasyncError: the middleware refuses the response; it can still be answered.
            UsageError: the call was answered before, or given up because its handler failed.
            SessionClosed, ContextShutdown: the server has ended.
        """
        sender = self._sender
        message = sender.make_response(response)
        with sender.lock:
            sender.begin(self._outcome)
            # Before the send, so that another thread cannot send a second response meanwhile.
            self._outcome = _ANSWERED
        try:
            late = monotonic_ns() - self._received > LATE
            sender.send(self._header, message, self.trace, late=late)
        except BaseException:
            # Nothing was sent. `give_up` may have found the call answered, and the server may have
            # ended; both leave it open.
            self._outcome = None
            raise

    def give_up(
        self,
        reason: str,
        outcome: Outcome = Outcome.FAILED,
        *,
        failed: bool = False,
        error: BaseException | None = None,
    ) -> bool:
        """Leave the request unanswered for good. From any thread.

        Args:
            reason: the outcome for the error of a later `respond`, such as "dropped: …".
            outcome: what its caller is told, if the server has ``status=True``.
            failed: whether its handler failed. If not, the call is counted as dropped.
            error: what the handler raised.

        Returns:
            Whether this settled the call. False if it is settled already, or the server has ended.
        """
        sender = self._sender
        with sender.lock:
            if self._outcome is not None or sender.ending is not None:
                return False
            self._outcome = reason
            sender.count_unanswered(failed=failed)
        if self.trace is not None:
            self.trace.end_unanswered()
        if self.status is not None:
            self.status.report(outcome, error)
        return True


def _timestamp(nanoseconds: int) -> int | None:
    return nanoseconds if nanoseconds > 0 else None
