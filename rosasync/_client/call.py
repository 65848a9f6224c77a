"""One call: from the queue to the response."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync._client.client import Client
    from rosasync._client.retry import Attempts
    from rosasync._core.ports import Servers
    from rosasync.tracing import CallTrace

__all__ = ["Call"]

NOT_SENT = 0
"""Not a valid sequence number: rcl counts from 1."""
TIMED = 16
"""The first requests are timed, and then one of this many: to time each would make every call more
expensive."""


class Call:
    """One request: queued, sent with a client, then answered or given up.

    Confined to the loop's thread. From `start` to `end` it takes a place in the client's window. A
    call on a lease (``leased``) uses the place of the lease instead.

    Attributes:
        future: receives the response.
        request: the message.
        attempts: sends the request again; None if it is sent only once.
        servers: the servers that the graph showed at the last attempt; None if they are not known
            yet. `Client.learn_servers` sets them then.
        started: whether `start` was called.
        in_flight: whether it takes a place: it has started and not ended.
        trace: follows the call, if something listens.
    """

    __slots__ = (
        "_leased",
        "_sequence_number",
        "attempts",
        "client",
        "future",
        "in_flight",
        "request",
        "servers",
        "started",
        "trace",
    )

    client: Client
    servers: Servers | None
    _sequence_number: int

    def __init__(
        self,
        future: asyncio.Future[Any],
        request: Any,
        attempts: Attempts | None,
        leased: bool = False,
        trace: CallTrace | None = None,
    ) -> None:
        self.future = future
        self.request = request
        self.attempts = attempts
        self.trace = trace
        self.started = False
        self.in_flight = False
        self._leased = leased

    def start(self, client: Client) -> None:
        """Send the request. If that fails, set the error on the future."""
        self.client = client
        self.servers = client.servers
        self.started = self.in_flight = True
        counts = client.counts
        counts.in_flight += 1
        if counts.in_flight > counts.peak:
            counts.peak = counts.in_flight
        try:
            sequence_number = client.send(self.request)
        except Exception as error:
            self.attempts = None
            self._sequence_number = NOT_SENT
            self.future.set_exception(error)
            return
        counts.sent += 1
        client.unanswered[sequence_number] = self
        self._sequence_number = sequence_number
        if sequence_number < TIMED or not sequence_number % TIMED:
            client.time_response(sequence_number)
        if self.trace is not None:
            self.trace.enter("sent")
        if self.attempts is not None:
            self.attempts.begin(self, client, sequence_number)

    def sent_again(self, sequence_number: int) -> None:
        """Expect a response to another attempt as well."""
        self.servers = self.client.servers
        self.client.unanswered[sequence_number] = self
        if self.trace is not None:
            self.trace.enter("sent again")

    def lose_servers(self, error: Callable[[], Exception]) -> None:
        """Go to the next server if the call may be retried; otherwise set the error."""
        if self.attempts is not None:
            self.attempts.lose_servers(error)
        elif not self.future.done():
            self.future.set_exception(error())

    def end(self) -> None:
        """Return the place to the client: the response has arrived, or the caller has left."""
        self.in_flight = False
        client = self.client
        client.counts.in_flight -= 1
        if self.attempts is not None:
            self.attempts.end()
        elif client.unanswered.pop(self._sequence_number, None) is not None:
            client.abandon(self._sequence_number, self.servers)
        if not self._leased:
            client.release()
