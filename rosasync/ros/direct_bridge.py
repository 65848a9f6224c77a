"""The direct bridge: the middleware signals an eventfd, and the loop takes the responses."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from rosasync.ports import Deliver, DeliverRequest, RequestHeader
from rosasync.ros.busy_poll import BusyPoll
from rosasync.ros.rcl import Rcl
from rosasync.ros.services import Responder, make_service, qos_of, take_requests
from rosasync.ros.signals import Signal, Signals

__all__ = ["DESTROY_DELAY", "DirectBridge", "DirectCallbackGroup"]

DESTROY_DELAY = 0.02
"""Seconds from the end of signalling to the destruction: a thread of the middleware may be on its
way into the listener, which it then uses after it was freed (rmw_fastrtps issue 632)."""


class DirectCallbackGroup(CallbackGroup):  # type: ignore[misc]
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
    """Takes responses and requests on the loop's thread, when the middleware says so."""

    name = "direct"
    destroy_delay = DESTROY_DELAY

    def __init__(
        self,
        node: Node,
        rcl: Rcl,
        loop: asyncio.AbstractEventLoop,
        configure: Callable[[Any], None],
        busy_poll: float,
    ) -> None:
        self._node = node
        self._configure = configure
        self._rcl = rcl
        self._group = DirectCallbackGroup()
        self._clients: Signals[DirectClient] = Signals(loop, _take_responses)
        self._services: Signals[DirectService] = Signals(loop, _take_requests)
        self._poll = BusyPoll(loop, busy_poll) if busy_poll else None
        self._loop = loop
        self._retired: dict[Any, asyncio.TimerHandle] = {}

    def open_client(self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver) -> DirectClient:
        """Make a client whose responses go to ``deliver``, on the loop's thread."""
        client = self._node.create_client(
            srv_type, srv_name, qos_profile=qos, callback_group=self._group
        )
        self._configure(client)
        return DirectClient(client, self._rcl, self._clients, self._poll, deliver, self._retire)

    def open_service(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: DeliverRequest
    ) -> DirectService:
        """Make a service whose requests go to ``deliver``, on the loop's thread."""
        service = make_service(self._node, srv_type, srv_name, _nothing, qos, self._group)
        self._configure(service)
        return DirectService(self._node, service, self._rcl, self._services, deliver)

    def close(self) -> None:
        """Destroy the clients and services that are left, then close the eventfds."""
        for client in self._clients.members:
            client.close()
        for retired in tuple(self._retired):
            self._destroy(retired)
        self._clients.close()
        for service in self._services.members:
            service.close()
        self._services.close()

    def _retire(self, client: Any) -> None:
        """Destroy a client that signals no more, when no thread can be in its listener."""
        if self._loop.is_closed():
            self._node.destroy_client(client)
        else:
            self._retired[client] = self._loop.call_later(DESTROY_DELAY, self._destroy, client)

    def _destroy(self, client: Any) -> None:
        self._retired.pop(client).cancel()
        self._node.destroy_client(client)


class DirectClient:
    """A rcl client that the loop's thread takes from."""

    __slots__ = (
        "_client",
        "_closed",
        "_deliver",
        "_out",
        "_poll",
        "_rcl",
        "_response_type",
        "_retire",
        "_signal",
        "_signalling",
        "_signals",
        "_take",
        "handle",
        "quick",
        "ready",
        "send_request",
    )

    def __init__(
        self,
        client: Any,
        rcl: Rcl,
        signals: Signals[DirectClient],
        poll: BusyPoll | None,
        deliver: Deliver,
        retire: Callable[[Any], None],
    ) -> None:
        self._client = client
        self._retire = retire
        self._closed = False
        self._rcl = rcl
        self._signals = signals
        self._signal = signals.join(self)
        self._poll = poll
        self._deliver = deliver
        self.handle = client.handle
        self._response_type = client.srv_type.Response
        # rcl checks that its client is valid: a destroyed one is an error here, not a crash.
        self.send_request = self.handle.send_request
        self.ready = self.handle.service_server_is_available
        self._take = self.handle.take_response
        self._out: dict[int, float] = {}
        self._signalling = False
        self.quick = False

    @property
    def is_waiting(self) -> bool:
        """Whether a response is expected."""
        return bool(self._out)

    def send(self, request: Any) -> int:
        """Send a request; its sequence number."""
        if self.quick:
            self.stop_signalling()
        elif not self._signalling:
            self.start_signalling()
        sequence_number: int = self.send_request(request)
        out = self._out
        if not out:
            self._signal.waiting[self] = None
        poll = self._poll
        out[sequence_number] = 0.0 if poll is None else poll.sent(self)
        return sequence_number

    def forget(self, sequence_number: int) -> None:
        """Expect no response to this request any more."""
        self._out.pop(sequence_number, None)
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
            sent = self._out.pop(sequence_number, None)
            if self._poll is not None and sent is not None:
                self._poll.answered(self, sent)
            self._deliver(sequence_number, response)
        if not self._out:
            self._signal.waiting.pop(self, None)
        return taken

    def take_all(self) -> None:
        """Take responses until the queue seems empty."""
        self.take(sys.maxsize)

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
        """Stop taking, and have the rcl client destroyed; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._out.clear()
        self.stop_signalling()
        self._signals.leave(self, self._signal)
        if self._poll is not None:
            self._poll.leave(self)
        self._retire(self._client)

    def start_signalling(self) -> None:
        """Have responses wake the loop, those that have come already too."""
        if not self._rcl.signal_responses(self.handle, self._signal.fd):
            raise RuntimeError("the middleware does not support new-response callbacks")
        self._signalling = True


class DirectService:
    """A rcl service that the loop's thread takes from."""

    destroy_delay = DESTROY_DELAY

    def __init__(
        self,
        node: Node,
        service: Any,
        rcl: Rcl,
        signals: Signals[DirectService],
        deliver: DeliverRequest,
    ) -> None:
        self._node = node
        self._rcl = rcl
        self._signals = signals
        self._signal = signals.join(self)
        self._deliver = deliver
        self.handle = service
        self.qos = qos_of(service)
        self._service = service.handle
        self._request_type = service.srv_type.Request
        self._take = self._service.service_take_request
        self._responder = Responder(node, service)
        self.has_clients = self._responder.has_clients
        self._closed = False
        self._stopped = False
        if not rcl.signal_requests(self._service, self._signal.fd):
            self.close()
            raise RuntimeError("the middleware does not support new-request callbacks")

    @property
    def destroyed(self) -> bool:
        """Whether something else than rosasync has destroyed the service."""
        return self._responder.destroyed

    def send(self, header: RequestHeader, response: Any) -> None:
        """Convert and send a response."""
        self._responder.send(response, header.request_id)

    def take(self, most: int) -> None:
        """Take ``most`` times, and only then deliver: the sooner the queue is empty, the better."""
        for request, header in take_requests(self._take, self._request_type, most):
            self._deliver(request, header)

    def stop(self) -> None:
        """Deliver no more requests; idempotent."""
        if not self._stopped:
            self._stopped = True
            self._rcl.signal_requests(self._service, None)
            self._signals.leave(self, self._signal)

    def close(self) -> None:
        """Destroy the rcl service; idempotent."""
        self.stop()
        if not self._closed:
            self._closed = True
            self._node.destroy_service(self.handle)


def _take_responses(signal: Signal[DirectClient], left: int) -> None:
    """Take as many responses as were signalled, by the client that asked last first.

    Usually each of them belongs to a client that waits for it. Where some are left over, they were
    for other processes, and stand in any of the clients' queues: those that wait are drained, the
    others taken off the signal.
    """
    for client in reversed(tuple(signal.waiting)):
        left -= client.take(left)
        if left <= 0:
            return
    for client in tuple(signal.members):
        if not client.is_waiting:
            client.stop_signalling()
        client.drain(left)


def _take_requests(signal: Signal[DirectService], signalled: int) -> None:
    for service in tuple(signal.members):
        service.take(signalled)


def _nothing(request: object, response: object) -> None:
    """Is never called: no executor takes from a service of the group `DirectCallbackGroup`."""
