"""Checks and resolves service names, types and QoS."""

from __future__ import annotations

from typing import Any

from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_services_default
from rclpy.validate_full_topic_name import validate_full_topic_name

from rosasync._core.ports import Service
from rosasync._ros.failures import uses_node
from rosasync._ros.messages import service_type, type_name
from rosasync.errors import InvalidServiceName
from rosasync.statistics import ServiceKey

__all__ = ["DEPTH", "DEPTH_WITHOUT_HEARTBEATS", "default_qos", "describe", "resolve_name"]

DEPTH = 1000
"""History of clients and servers by default. Beside other processes' calls, the ten of rclpy's
default get lost."""
DEPTH_WITHOUT_HEARTBEATS = 10
"""History of clients, at least, without the profile: where packets get lost, a deep history blocks
behind each of them for 3 s (docs/explanation/network.md)."""


def describe(node: Node, srv_type: Any, srv_name: str, qos: Any) -> Service:
    """Check and resolve a service; see `rosasync._core.ports.NodePort.describe`."""
    if qos is not None and not isinstance(qos, QoSProfile):
        raise TypeError(f"qos must be an rclpy QoSProfile, not {type(qos).__name__}")
    srv_class = service_type(srv_type)
    qos_key = None if qos is None else str(qos)
    key = ServiceKey(resolve_name(node, srv_name), type_name(srv_class), qos_key)
    return Service(srv_class, srv_name, qos, key)


def default_qos(depth: int = DEPTH) -> QoSProfile:
    """Return the service default with another history."""
    qos = QoSProfile(depth=depth)
    for name in ("history", "reliability", "durability"):
        setattr(qos, name, getattr(qos_profile_services_default, name))
    return qos


def resolve_name(node: Node, srv_name: str) -> str:
    """Return the expanded and remapped name of a service.

    Raises:
        InvalidServiceName: ROS does not allow the name.
        TypeError: not a str.
    """
    if not isinstance(srv_name, str):
        raise TypeError(f"a service name must be a str, not {type(srv_name).__name__}")
    if not srv_name.isascii():
        # rclpy's bindings raise a TypeError for what cannot be encoded, such as lone surrogates.
        raise InvalidServiceName(
            f"{srv_name!r} is not a valid service name: it may have letters from a to z, digits, "
            "underscores, slashes and ~ at its start"
        )
    try:
        with uses_node(node):
            name = expand_topic_name(srv_name, node.get_name(), node.get_namespace())
            validate_full_topic_name(name, is_service=True)
            return str(node.resolve_service_name(srv_name))
    except (InvalidServiceNameException, InvalidTopicNameException, ValueError) as error:
        reason = str(error).strip().replace("\n", " ")
        raise InvalidServiceName(f"{srv_name!r} is not a valid service name: {reason}") from None
