"""The executor bridge, on rclpy's public API only."""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import Deliver, DeliverMessage, DeliverRequest, RequestHeader
from rosasync._ros.failures import RclpyError, explain, is_destroyed
from rosasync._ros.responder import Responder, client_of
from rosasync._ros.services import make_service, qos_of, take_request
from rosasync._ros.topics import NO_SUBSCRIPTION_EVENTS, ExecutorSubscription
from rosasync.errors import RosasyncError, SessionClosed

__all__ = ["ExecutorBridge"]

BATCH = 100
"""Maximum number of further requests that the executor's thread takes in one callback."""


class ExecutorBridge:
    """Passes responses and requests from the executor, which takes them, to the loop."""

    name = "executor"
    destroy_delay = 0.0

    def __init__(self, node: Node, gateway: LoopGateway, configure: Callable[[Any], None]) -> None:
        self._node = node
        self._configure = configure
        self._gateway = gateway
        # A group for the clients alone, so that no other callback of the node delays them.
        self._group = ReentrantCallbackGroup()
        # One for all subscriptions, and for the clients whose responses come after their messages.
        # It keeps them in order in a MultiThreadedExecutor, which looks at subscriptions first.
        self._ordered = MutuallyExclusiveCallbackGroup()
        self._clients: dict[ExecutorClient, None] = {}
        self._services: dict[ExecutorService, None] = {}
        self._subscriptions: dict[ExecutorSubscription, None] = {}

    def open_client(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver, after_topics: bool
    ) -> ExecutorClient:
        """Create a client that passes its responses to ``deliver`` on the loop's thread."""
        group = self._ordered if after_topics else self._group
        client = self._node.create_client(srv_type, srv_name, qos_profile=qos, callback_group=group)
        try:
            self._configure(client)
        except BaseException:
            self._node.destroy_client(client)
            raise
        opened = ExecutorClient(self._node, client, self._gateway, deliver, self._clients.pop)
        self._clients[opened] = None
        return opened

    def open_service(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: DeliverRequest
    ) -> ExecutorService:
        """Create a service that passes its requests to ``deliver`` on the loop's thread."""
        # One request at a time, so that they keep their order in a MultiThreadedExecutor.
        group = GatedCallbackGroup()
        service = make_service(self._node, srv_type, srv_name, _return_request, qos, group)
        try:
            self._configure(service)
            opened = ExecutorService(
                self._node, service, self._gateway, deliver, self._services.pop
            )
        except BaseException:
            self._node.destroy_service(service)
            raise
        self._services[opened] = None
        group.open = True
        if self._node.executor is not None:
            self._node.executor.wake()
        return opened

    def open_subscription(
        self, msg_type: Any, topic_name: str, qos: Any, deliver: DeliverMessage, raw: bool
    ) -> ExecutorSubscription:
        """Create a subscription that passes its messages to ``deliver`` on the loop's thread."""
        opened = ExecutorSubscription(self._node, self._gateway, deliver, self._subscriptions.pop)
        subscription = self._node.create_subscription(
            msg_type,
            topic_name,
            opened.take,
            qos,
            callback_group=self._ordered,
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
            raw=raw,
        )
        opened.begin(subscription)
        self._subscriptions[opened] = None
        return opened

    def refuse(self) -> None:
        """Make every later send fail, because the context was shut down.

        rcl sends requests even then, and their responses do not arrive.
        """
        for client in self._clients:
            client.refuse()

    def close(self) -> None:
        """Destroy what is left."""
        for client in tuple(self._clients):
            client.close()
        for subscription in tuple(self._subscriptions):
            subscription.close()
        for service in tuple(self._services):
            service.close()


class ExecutorClient:
    """An rclpy client whose futures complete in the executor's thread."""

    def __init__(
        self,
        node: Node,
        client: Any,
        gateway: LoopGateway,
        deliver: Deliver,
        on_close: Callable[[ExecutorClient], object],
    ) -> None:
        self._node = node
        self._client = client
        self._gateway = gateway
        self._deliver = deliver
        self._on_close = on_close
        self._closed = False
        self.handle = client.handle
        # Set by the node, which asks the graph.
        self.identity: bytes | None = None
        self._call_async = client.call_async
        # rcl counts the same way, and does not show its number here.
        self._numbers = itertools.count(1)
        self._pending: dict[int, Any] = {}

    def send(self, request: Any) -> int:
        """Send a request and return a number for it; see `rosasync._core.ports.ClientPort`."""
        try:
            future = self._call_async(request)
        except RclpyError as error:
            raise self._failure(error) from error
        # After the send, because one that fails has no number.
        number = next(self._numbers)
        self._pending[number] = future
        future.add_done_callback(functools.partial(self._complete, number))
        return number

    def ready(self) -> bool:
        """Return whether a server is matched; see `rosasync._core.ports.ClientPort`."""
        try:
            return bool(self._client.service_is_ready())
        except RclpyError as error:
            raise self._failure(error) from error

    def forget(self, sequence_number: int) -> None:
        """Stop expecting a response to this request."""
        future = self._pending.pop(sequence_number, None)
        if future is not None:
            self._client.remove_pending_request(future)

    def refuse(self) -> None:
        """Make every later send fail."""
        self._call_async = self._refuse_request

    def close(self) -> None:
        """Destroy the rclpy client; idempotent."""
        if self._closed:
            return
        self._closed = True
        for number in tuple(self._pending):
            self.forget(number)
        self._on_close(self)
        self._node.destroy_client(self._client)

    def _complete(self, number: int, future: Any) -> None:
        """Pass a completed future to the loop. Called on the executor's thread."""
        if not future.cancelled():
            self._gateway.post_if_open(self._arrived, number, future)

    def _arrived(self, number: int, future: Any) -> None:
        if self._pending.pop(number, None) is not None:
            self._deliver(number, future.result())

    def _refuse_request(self, request: Any) -> Any:
        raise self._failure(RosasyncError("the context was shut down"))

    def _failure(self, error: Exception) -> Exception:
        return explain(self._node, self.handle, error)


class ExecutorService:
    """An rclpy service whose requests the executor takes, and whose responses are sent later.

    The executor calls ``callback(request, response)`` and then
    ``service.send_response(returned, header)``. So the callback returns the request, and
    ``send_response``, replaced on this one service, takes it and its header to the loop. The
    executor continues at once, whenever the response is sent.
    """

    destroy_delay = 0.0

    def __init__(
        self,
        node: Node,
        service: Any,
        gateway: LoopGateway,
        deliver: DeliverRequest,
        on_close: Callable[[ExecutorService], object],
    ) -> None:
        self._node = node
        self._gateway = gateway
        self._deliver = deliver
        self._on_close = on_close
        self._stopped = False
        self._closed = False
        self.handle = service
        self.qos = qos_of(service)
        self._service = service.handle
        self._request_type = service.srv_type.Request
        self._take = self._service.service_take_request
        self._responder = Responder(node, service, self.qos)
        self.send: Callable[[RequestHeader, Any], None] = self._responder.send
        self.client_of = client_of
        # Set by the node, which asks the graph and knows the profile.
        self.identity: bytes | None = None
        self.repair_time = 0.0
        self.clients = self._responder.clients
        self.has_clients = self._responder.has_clients
        self.delivered = self._responder.delivered
        service.send_response = self._taken

    @property
    def destroyed(self) -> bool:
        """Whether something other than rosasync has destroyed the service."""
        return not self._closed and is_destroyed(self._service)

    def stop(self) -> None:
        """Stop delivering requests; idempotent."""
        self._stopped = True

    def close(self) -> None:
        """Destroy the rclpy service; idempotent."""
        self._stopped = True
        if not self._closed:
            self._closed = True
            self._on_close(self)
            self._node.destroy_service(self.handle)

    def _taken(self, request: Any, header: Any) -> None:
        """Pass this request and those queued behind it to the loop. Runs on the executor's thread.

        The queue would overflow if the executor waited again before each request.
        """
        with contextlib.suppress(SessionClosed, InvalidHandle):
            self._gateway.post(self._arrived, request, header)
            with self._service:
                for _ in range(BATCH):
                    pair = take_request(self._take, self._request_type)
                    if pair is None:
                        break
                    self._gateway.post(self._arrived, *pair)

    def _arrived(self, request: Any, header: Any) -> None:
        if not self._stopped:
            self._deliver(request, header)


class GatedCallbackGroup(MutuallyExclusiveCallbackGroup):  # type: ignore[misc]
    """Hides its service from every executor until ``open`` is set, when the service is complete."""

    open = False

    def can_execute(self, entity: Any) -> bool:
        """Return whether an executor may take from the service now."""
        return self.open and bool(super().can_execute(entity))


def _return_request(request: Any, response: object) -> Any:
    return request
