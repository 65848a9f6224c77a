"""The direct bridge: the middleware signals an eventfd, and the loop takes the responses."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node

from rosasync._core.ports import Deliver, DeliverMessage, DeliverRequest
from rosasync._ros.busy_poll import BusyPoll
from rosasync._ros.failures import RclpyError, check_up, explain, is_destroyed
from rosasync._ros.rcl import Rcl
from rosasync._ros.responder import Responder, client_of
from rosasync._ros.services import make_service, qos_of, take_requests
from rosasync._ros.signals import PacedSignal, Signal, Signals
from rosasync._ros.topics import NO_SUBSCRIPTION_EVENTS, DirectSubscription, take_messages
from rosasync.errors import RosasyncError

__all__ = ["DESTROY_DELAY", "DirectBridge", "DirectCallbackGroup"]

logger = logging.getLogger("rosasync")

DESTROY_DELAY = 0.02
"""Seconds from the end of signalling to the destruction. A thread of the middleware may be about to
enter the listener, and would use it after it was freed (rmw_fastrtps issue 632)."""


class DirectCallbackGroup(CallbackGroup):  # type: ignore[misc]
    """Hides its clients and services from every executor: the loop takes from them itself.

    An executor ignores an entity whose group answers False here (rclpy, executors.py).
    """

    def can_execute(self, entity: object) -> bool:
        """Return False."""
        return False

    def beginning_execution(self, entity: object) -> bool:
        """Return False."""
        return False

    def ending_execution(self, entity: object) -> None:
        """Do nothing, because nothing began."""


class DirectBridge:
    """Takes responses and requests on the loop's thread, when the middleware signals them."""

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
        self._subscriptions: Signals[DirectSubscription] = Signals(loop, take_messages)
        self._raw_subscriptions: Signals[DirectSubscription] = Signals(
            loop, take_messages, PacedSignal
        )
        self._poll = BusyPoll(loop, busy_poll) if busy_poll else None
        self._loop = loop
        # What destroys an entity, with its timer that runs after DESTROY_DELAY, or `close` sooner.
        self._retired: dict[Callable[[], object], asyncio.TimerHandle] = {}

    def open_client(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver, after_topics: bool
    ) -> DirectClient:
        """Create a client that passes its responses to ``deliver`` on the loop's thread.

        They may overtake messages of topics until `DirectSubscription.drain` is called.
        """
        client = self._node.create_client(
            srv_type, srv_name, qos_profile=qos, callback_group=self._group
        )
        try:
            self._configure(client)
            return DirectClient(
                self._node, client, self._rcl, self._clients, self._poll, deliver, self._retire
            )
        except BaseException:
            self._node.destroy_client(client)
            raise

    def open_service(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: DeliverRequest
    ) -> DirectService:
        """Create a service that passes its requests to ``deliver`` on the loop's thread."""
        service = make_service(self._node, srv_type, srv_name, _never_called, qos, self._group)
        try:
            self._configure(service)
            return DirectService(self._node, service, self._rcl, self._services, deliver)
        except BaseException:
            self._node.destroy_service(service)
            raise

    def open_subscription(
        self, msg_type: Any, topic_name: str, qos: Any, deliver: DeliverMessage, raw: bool
    ) -> DirectSubscription:
        """Create a subscription that passes its messages to ``deliver`` on the loop's thread."""
        subscription = self._node.create_subscription(
            msg_type,
            topic_name,
            _ignore_message,
            qos,
            callback_group=self._group,
            event_callbacks=NO_SUBSCRIPTION_EVENTS,
            raw=raw,
        )
        try:
            signals = self._raw_subscriptions if raw else self._subscriptions
            return DirectSubscription(
                self._node, subscription, self._rcl, signals, deliver, self._retire
            )
        except BaseException:
            self._node.destroy_subscription(subscription)
            raise

    def refuse(self) -> None:
        """Make every later send fail, because the context was shut down.

        rcl sends requests even then, and their responses do not arrive.
        """
        for client in self._clients.members:
            client.refuse()

    def close(self) -> None:
        """Destroy what is left, then close the eventfds."""
        for client in self._clients.members:
            client.close()
        for subscription in (*self._subscriptions.members, *self._raw_subscriptions.members):
            subscription.close()
        for destroy in tuple(self._retired):
            self._destroy(destroy)
        self._clients.close()
        self._subscriptions.close()
        self._raw_subscriptions.close()
        for service in self._services.members:
            service.close()
        self._services.close()

    def _retire(self, destroy: Callable[[], object]) -> None:
        """Destroy an entity that has stopped signalling, once no thread can be in its listener."""
        if self._loop.is_closed():
            destroy()
        else:
            self._retired[destroy] = self._loop.call_later(DESTROY_DELAY, self._destroy, destroy)

    def _destroy(self, destroy: Callable[[], object]) -> None:
        self._retired.pop(destroy).cancel()
        destroy()


class DirectClient:
    """An rcl client that the loop's thread takes from."""

    __slots__ = (
        "_client",
        "_closed",
        "_deliver",
        "_node",
        "_pending",
        "_poll",
        "_rcl",
        "_response_type",
        "_retire",
        "_signal",
        "_signalling",
        "_signals",
        "_take",
        "handle",
        "identity",
        "quick",
        "send_request",
    )

    def __init__(
        self,
        node: Node,
        client: Any,
        rcl: Rcl,
        signals: Signals[DirectClient],
        poll: BusyPoll | None,
        deliver: Deliver,
        retire: Callable[[Callable[[], object]], None],
    ) -> None:
        self._node = node
        self._client = client
        self._retire = retire
        self._closed = False
        self._rcl = rcl
        self._signals = signals
        self._poll = poll
        self._deliver = deliver
        self.handle = client.handle
        # Set by the node, which asks the graph.
        self.identity: bytes | None = None
        self._response_type = client.srv_type.Response
        # rcl checks that its client is valid: after the destruction these raise.
        self.send_request = self.handle.send_request
        self._take = self.handle.take_response
        # The unanswered requests, with the loop time of the send if the client is busy-polled.
        self._pending: dict[int, float] = {}
        self._signalling = False
        self.quick = False
        self._signal = signals.join(self)

    @property
    def is_waiting(self) -> bool:
        """Whether a response is expected."""
        return bool(self._pending)

    def send(self, request: Any) -> int:
        """Send a request and return its sequence number; see `rosasync._core.ports.ClientPort`."""
        try:
            if self.quick:
                self.stop_signalling()
            elif not self._signalling:
                self.start_signalling()
            sequence_number: int = self.send_request(request)
        except RclpyError as error:
            raise self._failure(error) from error
        pending = self._pending
        if not pending:
            self._signal.waiting[self] = None
        poll = self._poll
        pending[sequence_number] = 0.0 if poll is None else poll.sent(self)
        return sequence_number

    def ready(self) -> bool:
        """Return whether a server is matched; see `rosasync._core.ports.ClientPort`."""
        try:
            return bool(self.handle.service_server_is_available())
        except RclpyError as error:
            raise self._failure(error) from error

    def forget(self, sequence_number: int) -> None:
        """Stop expecting a response to this request."""
        self._pending.pop(sequence_number, None)
        if not self._pending:
            self._signal.waiting.pop(self, None)

    def take(self, most: int) -> int:
        """Take up to ``most`` responses until the queue seems empty; return the number taken."""
        taken = 0
        while taken < most:
            try:
                header, response = self._take(self._response_type)
            except RclpyError as error:
                self._take_failed(error)
                break
            if header is None:
                break
            taken += 1
            sequence_number = header.request_id.sequence_number
            sent = self._pending.pop(sequence_number, None)
            if self._poll is not None and sent is not None:
                self._poll.answered(self, sent)
            try:
                self._deliver(sequence_number, response)
            except Exception as error:
                # Go on: the signal for the responses that follow was already consumed.
                _report(self._signals.loop, self._deliver, error)
        if not self._pending:
            self._signal.waiting.pop(self, None)
        return taken

    def take_all(self) -> None:
        """Take responses until the queue seems empty."""
        self.take(sys.maxsize)

    def drain(self, most: int) -> None:
        """Take ``most`` times.

        A response to another process's client also reaches this one. Taking it looks like an empty
        queue, although a response to this client may follow.
        """
        for _ in range(most):
            self.take(1)

    def stop_signalling(self) -> None:
        """Keep responses to other processes from waking the loop, until the next request."""
        if self._signalling:
            self._signalling = False
            self._rcl.signal_responses(self.handle, None)

    def refuse(self) -> None:
        """Make every later send fail."""
        self.send_request = self._refuse_request

    def close(self) -> None:
        """Stop taking, and have the rcl client destroyed; idempotent."""
        if self._closed:
            return
        self._closed = True
        self._pending.clear()
        self.stop_signalling()
        self._signals.leave(self, self._signal)
        if self._poll is not None:
            self._poll.leave(self)
        self._retire(partial(self._node.destroy_client, self._client))

    def start_signalling(self) -> None:
        """Let responses wake the loop, including those that are queued already."""
        if self._rcl.signal_responses(self.handle, self._signal.fd):
            self._signalling = True
        elif not is_destroyed(self.handle):
            check_up(self._node)
            raise RosasyncError(
                "the middleware does not support new-response callbacks: use bridge='executor'"
            )

    def _refuse_request(self, request: Any) -> int:
        raise self._failure(RosasyncError("the context was shut down"))

    def _take_failed(self, error: Exception) -> None:
        if is_destroyed(self.handle):
            self._pending.clear()
        else:
            logger.error(
                "a response could not be read, and its call will time out: compare the versions "
                "of the type's package on both sides (%s)",
                error,
            )

    def _failure(self, error: Exception) -> Exception:
        return explain(self._node, self.handle, error)


class DirectService:
    """An rcl service that the loop's thread takes from."""

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
        self._deliver = deliver
        self.handle = service
        self.qos = qos_of(service)
        self._service = service.handle
        self._request_type = service.srv_type.Request
        self._take = self._service.service_take_request
        self._responder = Responder(node, service, self.qos)
        self.send = self._responder.send
        self.client_of = client_of
        # Set by the node, which asks the graph and knows the profile.
        self.identity: bytes | None = None
        self.repair_time = 0.0
        self.clients = self._responder.clients
        self.has_clients = self._responder.has_clients
        self.delivered = self._responder.delivered
        self._closed = False
        self._stopped = False
        self._signal = signals.join(self)
        if not rcl.signal_requests(self._service, self._signal.fd):
            self.close()
            check_up(node)
            raise RosasyncError(
                "the middleware does not support new-request callbacks: use bridge='executor'"
            )

    @property
    def destroyed(self) -> bool:
        """Whether something other than rosasync has destroyed the service."""
        return not self._closed and is_destroyed(self._service)

    def take(self, most: int) -> None:
        """Take ``most`` times and then deliver, so that the queue is emptied soon."""
        if not self._service.pointer:
            return
        for request, header in take_requests(self._take, self._request_type, most):
            try:
                self._deliver(request, header)
            except Exception as error:
                # Go on: the requests that follow have been taken already.
                _report(self._signals.loop, self._deliver, error)

    def stop(self) -> None:
        """Stop delivering requests; idempotent."""
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
    """Take as many responses as were signalled, starting with the client that began to wait last.

    Usually each of them belongs to a client that waits for it. Any others were for other processes,
    and may be in the queue of any client. So every client is drained, and those that wait for
    nothing stop signalling.
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


def _report(loop: asyncio.AbstractEventLoop, callback: object, error: Exception) -> None:
    loop.call_exception_handler({"message": f"{callback!r} failed", "exception": error})


def _never_called(request: object, response: object) -> None:
    """Never called: no executor takes from a service in a `DirectCallbackGroup`."""


def _ignore_message(message: object) -> None:
    """Never called: no executor takes from a subscription in a `DirectCallbackGroup`."""
