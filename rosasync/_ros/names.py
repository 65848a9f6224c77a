"""Checks and resolves the names and types of services and actions."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

from rclpy.exceptions import InvalidServiceNameException, InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_services_default
from rclpy.validate_full_topic_name import validate_full_topic_name
from rclpy.validate_topic_name import validate_topic_name

from rosasync._core.ports import Action, Service
from rosasync._ros.checks import checker
from rosasync._ros.failures import reason_of, uses_node
from rosasync._ros.types import action_type, service_type, type_name
from rosasync.errors import InvalidServiceName
from rosasync.statistics import ServiceKey

__all__ = [
    "DEPTH",
    "DEPTH_WITHOUT_HEARTBEATS",
    "SEND_GOAL",
    "default_qos",
    "describe",
    "describe_action",
    "reason_of_name",
    "resolve_name",
]

DEPTH = 1000
"""History of clients and servers by default. Beside other processes' calls, the ten of rclpy's
default get lost."""
DEPTH_WITHOUT_HEARTBEATS = 10
"""History of clients, at least, without the profile: where packets get lost, a deep history blocks
behind each of them for 3 s (docs/explanation/network.md)."""

SEND_GOAL = "/_action/send_goal"
"""How the name of the service ends that accepts the goals of an action."""


_RCL_SAYS = (
    (r"^Invalid [a-z ]+: ", ""),
    (r"^topic name '.*' is invalid: ", ""),
    (r"^(topic|node) name token ", "a part of it "),
    (r"^(topic|node) name ", "it "),
    (r"must not be empty string", "must not be empty"),
)
"""The words of rcl, and what they are here."""


def describe(node: Node, srv_type: Any, srv_name: str, qos: Any) -> Service:
    """Check and resolve a service; see `rosasync._core.ports.NodePort.describe`."""
    if qos is not None and not isinstance(qos, QoSProfile):
        raise TypeError(f"qos must be an rclpy QoSProfile, not {type(qos).__name__}")
    srv_class = service_type(srv_type)
    qos_key = None if qos is None else str(qos)
    key = ServiceKey(resolve_name(node, srv_name), type_name(srv_class), qos_key)
    return Service(srv_class, srv_name, qos, key, checker(srv_class.Request))


def describe_action(node: Node, wanted: Any, action_name: str) -> Action:
    """Check and resolve an action; see `rosasync._core.ports.NodePort.describe_action`."""
    action_class = action_type(wanted)
    # Checked by itself first, so that an error has the name that the caller gave. It is not
    # remapped: rcl remaps the names of its services and topics.
    expanded = expand_name(node, action_name, "action")
    implementation = action_class.Impl
    prefix = f"{action_name}/_action"
    return Action(
        action_class,
        expanded,
        type_name(action_class),
        describe(node, implementation.SendGoalService, f"{action_name}{SEND_GOAL}", None),
        describe(node, implementation.CancelGoalService, f"{prefix}/cancel_goal", None),
        # The feedback comes before the result.
        replace(
            describe(node, implementation.GetResultService, f"{prefix}/get_result", None),
            after_topics=True,
        ),
        f"{prefix}/feedback",
        f"{prefix}/status",
    )


def default_qos(depth: int = DEPTH) -> QoSProfile:
    """Return the service default with another history."""
    qos = QoSProfile(depth=depth)
    for name in ("history", "reliability", "durability"):
        setattr(qos, name, getattr(qos_profile_services_default, name))
    return qos


def resolve_name(node: Node, srv_name: str, kind: str = "service") -> str:
    """Return the expanded and remapped name of a service, or of another ``kind``.

    Raises:
        InvalidServiceName: ROS does not allow the name.
        TypeError: not a str.
    """
    name = expand_name(node, srv_name, kind)
    with uses_node(node):
        return str(node.resolve_service_name(name))


def expand_name(node: Node, given: str, kind: str) -> str:
    """Return the full name of a service or an action, not remapped.

    Raises:
        InvalidServiceName: ROS does not allow the name.
        TypeError: not a str.
    """
    if not isinstance(given, str):
        raise TypeError(f"the name of the {kind} must be a str, not {type(given).__name__}")
    if not given.isascii():
        # rclpy's bindings raise a TypeError for what cannot be encoded, such as lone surrogates.
        raise InvalidServiceName(
            f"{given!r} is not a valid {kind} name: it may have letters from a to z, digits, "
            "underscores, slashes and ~ at its start"
        )
    try:
        return _expand(node, given)
    except (InvalidServiceNameException, InvalidTopicNameException, ValueError) as error:
        raise InvalidServiceName(
            f"{given!r} is not a valid {kind} name: {reason_of_name(error)}{_suggest(node, given)}"
        ) from None


def reason_of_name(error: Exception) -> str:
    """Return why rcl refuses a name, without the name and a mark under the place in it."""
    reason, _, shown = str(error).strip().partition(":\n")
    reason = reason_of(ValueError(reason))
    for begin, instead in _RCL_SAYS:
        reason = re.sub(begin, instead, reason)
    place = shown.rpartition("\n")[2].find("^") - len("  '")
    return f"{reason} (at character {place + 1})" if place >= 0 else reason


def _expand(node: Node, given: str) -> str:
    with uses_node(node):
        # First, because it says where the mistake is.
        validate_topic_name(given, is_service=True)
        name = expand_topic_name(given, node.get_name(), node.get_namespace())
        validate_full_topic_name(name, is_service=True)
        return str(name)


def _suggest(node: Node, given: str) -> str:
    """Return a hint with a similar name that is allowed; empty if there is none."""
    similar = re.sub(r"[^a-zA-Z0-9_/]", "_", given)
    similar = re.sub(r"/+", "/", similar).rstrip("/")
    similar = re.sub(r"(^|/)(?=[0-9])", r"\1_", similar)
    try:
        _expand(node, similar)
    except (InvalidServiceNameException, InvalidTopicNameException, ValueError):
        return ""
    return f"; {similar!r} is a valid one"
