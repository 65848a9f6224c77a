"""What the services of both bridges have in common."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.service import Service

from rosasync.ros.ports import Undeliverable, Unmatched

__all__ = ["has_clients", "make_service", "qos_of", "send_response", "take_requests"]

logger = logging.getLogger("rosasync")

# How rclpy says that a response found no way to its client; see send_response.
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


def send_response(send: Callable[[Any, Any], object], response: Any, header: Any) -> None:
    """Send, by a handle's ``service_send_response``; say in our terms that it was not possible.

    rclpy holds the GIL meanwhile, so that no request is taken in another thread at the same time.
    To a client that was seen to leave, the middleware sends nothing and reports success. One that
    it has not quite discovered it awaits for 0.1 s; then the response is lost, and rclpy warns,
    which is an error in this module, and from there a ``SystemError``, because rclpy does not
    expect it.

    Raises:
        Undeliverable: it reaches nobody.
        Unmatched: it reaches nobody yet.
    """
    try:
        send(response, header)
    except rclpy_implementation.RCLError as error:
        raise Undeliverable(str(error)) from error
    except SystemError as error:
        if not isinstance(error.__cause__, RuntimeWarning):
            raise
        raise Unmatched(str(error.__cause__)) from error


def has_clients(node: Node, service: Any) -> bool:
    """Tell whether the graph shows a client of this service, given as its handle."""
    with node.handle:
        return bool(node.handle.get_count_clients(service.name))


def qos_of(service: Service) -> QoSProfile:
    """Return a copy of the QoS that the service has."""
    return QoSProfile(**service.handle.qos)
