"""What the services of both bridges have in common."""

from __future__ import annotations

import logging
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync.ports import PortDestroyed, Undeliverable, Unmatched

__all__ = ["Responder", "make_service", "qos_of", "take_requests"]

logger = logging.getLogger("rosasync")

WARY = 3.0
"""Seconds for which the graph is asked before each send, after one that was in vain. Less than a
server tries for, because the graph may show for ever what is no client."""
GUID_PREFIX = 12
LOOK = 0.05
"""Seconds between two looks at the graph."""

# How rclpy says that a response found no way to its client; see Responder.
warnings.filterwarnings("error", category=RuntimeWarning, module=r"rosasync\.ros\.services$")


def make_service(
    node: Node,
    srv_type: Any,
    srv_name: str,
    callback: Callable[[Any, Any], Any],
    qos: QoSProfile,
    group: CallbackGroup,
) -> Service:
    """Create a service of a node."""
    return node.create_service(srv_type, srv_name, callback, qos_profile=qos, callback_group=group)


def take_requests(take: Callable[[Any], Any], request_type: type, most: int) -> list[Any]:
    """Take ``most`` times, by a handle's ``service_take_request``.

    One that cannot be read does not hide those behind it: it is taken as an error, which is logged,
    or as nothing, which looks like an empty queue.

    Returns:
        What came: pairs of request and header.
    """
    taken = []
    for _ in range(most):
        try:
            request, header = take(request_type)
        except rclpy_implementation.RCLError as error:
            logger.error("a request could not be taken: %s", error)
            continue
        if header is not None:
            taken.append((request, header))
    return taken


class Responder:
    """Sends the responses of one service. Its methods may be called on any thread.

    rclpy holds the GIL while it sends, so that no request is taken in another thread meanwhile.
    To a client that was seen to leave, the middleware sends nothing and reports success. One that
    it has not quite discovered, because a packet of the discovery was lost, it awaits for 0.1 s;
    then the response is lost, and rclpy warns, which is an error in this module, and from there a
    ``SystemError``, because rclpy does not expect it. Ten clients with ten requests each would stop
    the process for ten seconds. So after one such wait the graph is asked before each send, for a
    while: a client of which it shows the writer but not yet the reader is worth no attempt.
    """

    def __init__(self, node: Node, service: Service) -> None:
        self._node = node
        self._handle = service.handle
        self._send = service.handle.service_send_response
        self._wary_until = 0.0
        self._look_again = 0.0
        self._incomplete = False

    def send(self, response: Any, request_id: Any) -> None:
        """Send, by the service's handle; say in our terms that it was not possible.

        Raises:
            Undeliverable: it reaches nobody.
            Unmatched: it reaches nobody yet.
            PortDestroyed: the service was destroyed.
        """
        if self._wary_until and self._awaits_reader():
            raise Unmatched("a client is not quite discovered")
        try:
            self._send(response, request_id)
        except rclpy_implementation.RCLError as error:
            if self.destroyed:
                raise PortDestroyed(str(error)) from error
            raise Undeliverable(str(error)) from error
        except SystemError as error:
            if not isinstance(error.__cause__, RuntimeWarning):
                raise
            self._wary_until = monotonic() + WARY
            raise Unmatched(str(error.__cause__)) from error

    @property
    def destroyed(self) -> bool:
        """Whether something else than rosasync has destroyed the service."""
        try:
            with self._handle:
                return False
        except InvalidHandle:
            return True

    def has_clients(self) -> bool:
        """Tell whether the graph shows a client."""
        with self._node.handle:
            return bool(self._node.handle.get_count_clients(self._handle.name))

    def _awaits_reader(self) -> bool:
        """Tell whether the graph shows more of a process's writers than of its readers."""
        now = monotonic()
        if now >= self._wary_until:
            self._wary_until = 0.0
            return False
        if now >= self._look_again:
            # The names that rmw makes of a service's (design.ros2.org, topic_and_service_names).
            requests, responses = f"rq{self._handle.name}Request", f"rr{self._handle.name}Reply"
            writers = self._node.get_publishers_info_by_topic(requests, no_mangle=True)
            readers = self._node.get_subscriptions_info_by_topic(responses, no_mangle=True)
            self._incomplete = bool(_by_process(writers) - _by_process(readers))
            self._look_again = now + LOOK
        return self._incomplete


def _by_process(endpoints: Iterable[TopicEndpointInfo]) -> Counter[tuple[int, ...]]:
    """Count endpoints by participant, whose GUID begins theirs (RTPS 2.5, 9.3.1)."""
    return Counter(tuple(endpoint.endpoint_gid[:GUID_PREFIX]) for endpoint in endpoints)


def qos_of(service: Service) -> QoSProfile:
    """Return a copy of the QoS that the service has."""
    return QoSProfile(**service.handle.qos)
