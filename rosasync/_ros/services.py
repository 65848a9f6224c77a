"""Functions for the services of both bridges."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.service import Service

__all__ = ["make_service", "qos_of", "take_request", "take_requests"]

logger = logging.getLogger("rosasync")


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


def take_request(take: Callable[[Any], Any], request_type: type) -> tuple[Any, Any] | None:
    """Take a request by a handle's ``service_take_request``.

    Returns:
        The request and its header; None if there was no request, or one that cannot be read.
    """
    try:
        request, header = take(request_type)
    except rclpy_implementation.RCLError as error:
        logger.error(
            "a request could not be read and is dropped: compare the versions of the type's "
            "package on both sides (%s)",
            error,
        )
        return None
    return None if header is None else (request, header)


def take_requests(take: Callable[[Any], Any], request_type: type, most: int) -> list[Any]:
    """Take ``most`` times and return the pairs of request and header.

    The middleware reports a request that cannot be read as an error, which is logged, or as an
    empty queue. So neither ends the loop: further requests may follow.
    """
    taken = []
    for _ in range(most):
        pair = take_request(take, request_type)
        if pair is not None:
            taken.append(pair)
    return taken


def qos_of(service: Service) -> QoSProfile:
    """Return a copy of the QoS of a service.

    Raises:
        InvalidHandle: it was destroyed, for example because another thread shuts the context down.
    """
    # rclpy crashes if it is destroyed in the meantime.
    with service.handle:
        return QoSProfile(**service.handle.qos)
