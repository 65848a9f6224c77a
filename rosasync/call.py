"""One call and its attempts: from the queue to the response."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync.client import Client
    from rosasync.options import Retry
    from rosasync.ports import Servers

__all__ = ["Call"]

NOT_SENT = 0
"""Not a valid sequence number: rcl counts from 1."""


class Call:
    """One request: queued, sent with a client, then answered or given up.

    Confined to the loop's thread. From `start` to `end` it takes a place in the client's window. A
    call on a lease (``leased``) uses the place of the lease instead.

    Attributes:
        future: receives the response.
        servers: the servers that the graph showed at the last attempt; None if they are not known
            yet. `Client.learn_servers` sets them then.
        started: whether `start` was called.
        in_flight: whether it takes a place: it has started and not ended.
    """

    __slots__ = (
        "_attempts",
        "_leased",
        "_retry",
        "_sequence_number",
        "client",
        "future",
        "in_flight",
        "request",
        "servers",
        "started",
    )

    client: Client
    servers: Servers | None
    _attempts: _Attempts
    _sequence_number: int

    def __init__(
        self, future: asyncio.Future[Any], request: Any, retry: Retry | None, leased: bool = False
    ) -> None:
        self.future = future
        self.request = request
        self.started = False
        self.in_flight = False
        self._leased = leased
        self._retry = retry

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
            self._retry = None
            self._sequence_number = NOT_SENT
            self.future.set_exception(error)
            return
        client.unanswered[sequence_number] = self
        self._sequence_number = sequence_number
        if self._retry is not None:
            self._attempts = _Attempts(self, client, self._retry, sequence_number)

    def end(self) -> None:
        """Return the place to the client: the response has arrived, or the caller has left."""
        self.in_flight = False
        client = self.client
        client.counts.in_flight -= 1
        if self._retry is not None:
            self._attempts.end()
            del self._attempts  # Break the reference cycle.
        elif client.unanswered.pop(self._sequence_number, None) is not None:
            client.abandon(self._sequence_number, self.servers)
        if not self._leased:
            client.release()


class _Attempts:
    """Sends the request of one call again while it is unanswered.

    Each attempt except the last starts the timer for the next one. `end` stops it.
    """

    __slots__ = ("_call", "_client", "_delay", "_retry", "_sent", "_timer")

    def __init__(self, call: Call, client: Client, retry: Retry, sequence_number: int) -> None:
        self._call = call
        self._client = client
        self._retry = retry
        self._sent = [sequence_number]
        self._delay = retry.after
        self._timer: asyncio.TimerHandle | None = None
        self._arm()

    def _arm(self) -> None:
        if len(self._sent) < self._retry.attempts:
            self._timer = self._call.future.get_loop().call_later(self._delay, self._send_again)
            self._delay *= self._retry.backoff

    def _send_again(self) -> None:
        future = self._call.future
        if future.done():
            return
        try:
            sequence_number = self._client.send(self._call.request)
        except Exception as error:
            future.set_exception(error)
            return
        self._call.servers = self._client.servers
        self._client.unanswered[sequence_number] = self._call
        self._sent.append(sequence_number)
        self._client.counts.retried += 1
        self._arm()

    def end(self) -> None:
        """Abandon the attempts that are still outstanding.

        A server's queue keeps the order of one client's requests. So the attempts that were sent
        before an answered one have left the queue. Those sent after it may still be there, and keep
        their places.
        """
        if self._timer is not None:
            self._timer.cancel()
        client = self._client
        answered = max((n for n in self._sent if n not in client.unanswered), default=-1)
        for sequence_number in self._sent:
            if client.unanswered.pop(sequence_number, None) is None:
                continue
            if sequence_number > answered:
                client.abandon(sequence_number, self._call.servers)
            else:
                client.forget_later(sequence_number)
