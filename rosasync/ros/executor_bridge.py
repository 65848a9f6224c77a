"""The executor bridge, on rclpy's public API only."""

from __future__ import annotations

import contextlib
import functools
import itertools
import weakref
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from rosasync.errors import SessionClosed
from rosasync.gateway import LoopGateway
from rosasync.ports import Deliver, DeliverRequest, RequestHeader
from rosasync.ros.services import Responder, make_service, qos_of

__all__ = ["ExecutorBridge"]

BATCH = 100
"""Most requests that the executor's thread takes at once."""


class ExecutorBridge:
    """Has the executor take responses and requests, and brings them to the loop by a mailbox."""

    name = "executor"
    destroy_delay = 0.0

    def __init__(self, node: Node, gateway: LoopGateway, configure: Callable[[Any], None]) -> None:
        self._node = node
        self._configure = configure
        self._gateway = gateway
        # A group of their own, so that no other callback of the node holds the clients back.
        self._group = ReentrantCallbackGroup()
        self._services: weakref.WeakSet[ExecutorService] = weakref.WeakSet()

    def open_client(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver
    ) -> ExecutorClient:
        """Make a client whose responses go to ``deliver``, on the loop's thread."""
        client = self._node.create_client(
            srv_type, srv_name, qos_profile=qos, callback_group=self._group
        )
        self._configure(client)
        return ExecutorClient(self._node, client, self._gateway, deliver)

    def open_service(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: DeliverRequest
    ) -> ExecutorService:
        """Make a service whose requests go to ``deliver``, on the loop's thread."""
        service = ExecutorService(self._node, self._gateway, deliver)
        service.open(srv_type, srv_name, qos, self._configure)
        self._services.add(service)
        return service

    def close(self) -> None:
        """Destroy the services that are left; nothing else is held."""
        for service in tuple(self._services):
            service.close()


class ExecutorClient:
    """A rclpy client whose futures complete in the executor's thread."""

    def __init__(self, node: Node, client: Any, gateway: LoopGateway, deliver: Deliver) -> None:
        self._node = node
        self._client = client
        self._gateway = gateway
        self._deliver = deliver
        self.handle = client.handle
        self.ready = client.service_is_ready
        self._numbers = itertools.count(1)
        self._out: dict[int, Any] = {}

    def send(self, request: Any) -> int:
        """Send a request; a number for it, which grows with every send."""
        number = next(self._numbers)
        future = self._client.call_async(request)
        self._out[number] = future
        future.add_done_callback(functools.partial(self._complete, number))
        return number

    def forget(self, number: int) -> None:
        """Expect no response to this request any more."""
        future = self._out.pop(number, None)
        if future is not None:
            self._client.remove_pending_request(future)

    def close(self) -> None:
        """Destroy the rclpy client; idempotent."""
        for number in tuple(self._out):
            self.forget(number)
        self._node.destroy_client(self._client)

    def _complete(self, number: int, future: Any) -> None:
        """Take a completed future's response to the loop. Called on the executor's thread."""
        if not future.cancelled():
            # After the close there is nobody to be told.
            with contextlib.suppress(SessionClosed):
                self._gateway.post(self._arrived, number, future)

    def _arrived(self, number: int, future: Any) -> None:
        if self._out.pop(number, None) is not None:
            self._deliver(number, future.result())


class ExecutorService:
    """A rclpy service whose requests the executor takes, and whose responses are ours to send.

    The executor calls ``callback(request, response)`` and then
    ``service.send_response(returned, header)``. So the callback returns the request, and
    ``send_response``, replaced on this one service, takes it and its header to the loop. The
    executor goes on at once, whenever the response will be sent.
    """

    destroy_delay = 0.0

    def __init__(self, node: Node, gateway: LoopGateway, deliver: DeliverRequest) -> None:
        self._node = node
        self._gateway = gateway
        self._deliver = deliver
        # One at a time, so that requests keep their order in a MultiThreadedExecutor.
        self._group = GatedCallbackGroup()
        self._stopped = False
        self._closed = False

    def open(
        self, srv_type: Any, srv_name: str, qos: Any, configure: Callable[[Any], None]
    ) -> None:
        """Create the service, and only then let an executor take from it."""
        service = make_service(self._node, srv_type, srv_name, _request, qos, self._group)
        configure(service)
        self.handle = service
        self.qos = qos_of(service)
        self._request_type = srv_type.Request
        self._take = service.handle.service_take_request
        self._responder = Responder(self._node, service)
        self.has_clients = self._responder.has_clients
        service.send_response = self._taken
        self._group.shut = False
        if self._node.executor is not None:
            self._node.executor.wake()

    @property
    def destroyed(self) -> bool:
        """Whether something else than rosasync has destroyed the service."""
        return self._responder.destroyed

    def send(self, header: RequestHeader, response: Any) -> None:
        """Convert and send a response."""
        self._responder.send(response, header.request_id)

    def stop(self) -> None:
        """Deliver no more requests; idempotent."""
        self._stopped = True

    def close(self) -> None:
        """Destroy the rclpy service; idempotent."""
        self._stopped = True
        if not self._closed:
            self._closed = True
            self._node.destroy_service(self.handle)

    def _taken(self, request: Any, header: Any) -> None:
        """Take this request to the loop, and those behind it. Called on the executor's thread.

        An executor that waits again before every request is too slow for its queue.
        """
        with contextlib.suppress(SessionClosed, InvalidHandle):
            self._gateway.post(self._arrived, request, header)
            with self.handle.handle:
                for _ in range(BATCH):
                    request, header = self._take(self._request_type)
                    if header is None:
                        break
                    self._gateway.post(self._arrived, request, header)

    def _arrived(self, request: Any, header: Any) -> None:
        if not self._stopped:
            self._deliver(request, header)


class GatedCallbackGroup(MutuallyExclusiveCallbackGroup):  # type: ignore[misc]
    """Keeps its service from every executor until it is opened."""

    shut = True

    def can_execute(self, entity: Any) -> bool:
        """Tell whether an executor may take from the service now."""
        return not self.shut and bool(super().can_execute(entity))


def _request(request: Any, response: object) -> Any:
    return request
