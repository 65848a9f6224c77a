"""The direct bridge: the middleware signals an eventfd, and the loop takes the responses."""

from __future__ import annotations

import asyncio
import os
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from rosasync.ros.ports import Deliver
from rosasync.ros.rcl import Rcl

__all__ = ["DirectBridge", "Reserved"]

SIGNALS = 16
"""Most eventfds of a session: enough to tell its clients apart, few enough to have always."""


class Reserved(CallbackGroup):  # type: ignore[misc]
    """Keeps its clients and services from every executor: the loop takes from them itself.

    An executor ignores an entity whose group answers False here (rclpy, executors.py).
    """

    def can_execute(self, entity: object) -> bool:
        """Never."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Never."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Nothing began."""


class DirectBridge:
    """Takes responses on the loop's thread, when the middleware says that there are some."""

    name = "direct"

    def __init__(self, node: Node, rcl: Rcl, loop: asyncio.AbstractEventLoop) -> None:
        self._node = node
        self._rcl = rcl
        self._loop = loop
        self._group = Reserved()
        self._signals: list[_Signal] = []

    def open_client(self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver) -> DirectClient:
        """Make a client whose responses go to ``deliver``, on the loop's thread."""
        client = self._node.create_client(
            srv_type, srv_name, qos_profile=qos, callback_group=self._group
        )
        return DirectClient(self._node, client, self._rcl, self._signal(), deliver)

    def close(self) -> None:
        """Destroy the clients that are left, then close the eventfds."""
        for signal in self._signals:
            for client in tuple(signal.clients):
                client.close()
            signal.close()
        self._signals.clear()

    def _signal(self) -> _Signal:
        free = min(self._signals, key=lambda signal: len(signal.clients), default=None)
        if free is None or (free.clients and len(self._signals) < SIGNALS):
            free = _Signal(self._loop)
            self._signals.append(free)
        return free


class DirectClient:
    """A rcl client that the loop's thread takes from."""

    __slots__ = (
        "_client",
        "_deliver",
        "_node",
        "_out",
        "_rcl",
        "_response_type",
        "_signal",
        "_signalling",
        "_take",
        "handle",
        "ready",
        "send_request",
    )

    def __init__(
        self, node: Node, client: Any, rcl: Rcl, signal: _Signal, deliver: Deliver
    ) -> None:
        self._node = node
        self._client = client
        self._rcl = rcl
        self._signal = signal
        self._deliver = deliver
        self.handle = client.handle
        self._response_type = client.srv_type.Response
        # rcl checks that its client is valid: a destroyed one is an error here, not a crash.
        self.send_request = self.handle.send_request
        self.ready = self.handle.service_server_is_available
        self._take = self.handle.take_response
        self._out: set[int] = set()
        self._signalling = False
        signal.clients[self] = None

    @property
    def is_waiting(self) -> bool:
        """Whether a response is expected."""
        return bool(self._out)

    def send(self, request: Any) -> int:
        """Send a request; its sequence number."""
        if not self._signalling:
            self._start_signalling()
        sequence_number: int = self.send_request(request)
        out = self._out
        if not out:
            self._signal.waiting[self] = None
        out.add(sequence_number)
        return sequence_number

    def forget(self, sequence_number: int) -> None:
        """Expect no response to this request any more."""
        self._out.discard(sequence_number)
        if not self._out:
            self._signal.waiting.pop(self, None)

    def take(self, most: int) -> int:
        """Take responses until the queue seems empty; how many were this client's."""
        taken = 0
        while taken < most:
            header, response = self._take(self._response_type)
            if header is None:
                break
            taken += 1
            sequence_number = header.request_id.sequence_number
            self._out.discard(sequence_number)
            self._deliver(sequence_number, response)
        if not self._out:
            self._signal.waiting.pop(self, None)
        return taken

    def drain(self, most: int) -> None:
        """Take ``most`` times, whatever comes.

        A response to another process's client, which every client of the name is handed, looks
        like an empty queue, so that one's own may stand behind it.
        """
        for _ in range(most):
            self.take(1)

    def stop_signalling(self) -> None:
        """Let other processes' responses not wake the loop, until the next request."""
        if self._signalling:
            self._signalling = False
            self._rcl.signal_responses(self.handle, None)

    def close(self) -> None:
        """Destroy the rcl client; idempotent."""
        self._signal.clients.pop(self, None)
        self._signal.waiting.pop(self, None)
        self._out.clear()
        self.stop_signalling()
        self._node.destroy_client(self._client)

    def _start_signalling(self) -> None:
        if not self._rcl.signal_responses(self.handle, self._signal.fd):
            raise RuntimeError("the middleware does not support new-response callbacks")
        self._signalling = True


class _Signal:
    """An eventfd that some clients share, and who of them waits for a response."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.clients: dict[DirectClient, None] = {}
        self.waiting: dict[DirectClient, None] = {}
        loop.add_reader(self.fd, self._on_signal)

    def close(self) -> None:
        if not self._loop.is_closed():
            self._loop.remove_reader(self.fd)
        os.close(self.fd)

    def _on_signal(self) -> None:
        """Take as many responses as were signalled, by the client that asked last first.

        Usually each of them belongs to a client that waits for it. Where some are left over, they
        were for other processes, and stand in any of the clients' queues: those that wait are
        drained, the others taken off the signal.
        """
        try:
            left = os.eventfd_read(self.fd)
        except BlockingIOError:
            return
        for client in reversed(tuple(self.waiting)):
            left -= client.take(left)
            if left <= 0:
                return
        for client in tuple(self.clients):
            if not client.is_waiting:
                client.stop_signalling()
            client.drain(left)
