"""Translates rclpy's errors into those of rosasync."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node

from rosasync._core.ports import PortDestroyed, Service
from rosasync.errors import ContextShutdown, RosasyncError, UsageError

__all__ = [
    "RclpyError",
    "cannot_create",
    "check_up",
    "explain",
    "is_destroyed",
    "is_up",
    "reason_of",
    "refusal",
    "topic_refusal",
    "uses_node",
]

RclpyError = (InvalidHandle, rclpy_implementation.RCLError)
"""What rclpy raises if an entity was destroyed, or if rcl reports an error."""


_SOURCE = re.compile(r",?\s*\bat \S+\.(?:c|cc|cpp|h|hpp):\d+")
"""Where rcl has raised an error, which it appends to each message."""


_OPENING = (
    (r"logging directory|log directory", "set ROS_LOG_DIR to a folder that can be written"),
    (r"resolve peer", "check the names in ROS_STATIC_PEERS"),
    (r"SECURITY ERROR", "check ROS_SECURITY_KEYSTORE, or unset ROS_SECURITY_ENABLE"),
    (r"create participant", "check the transports in FASTDDS_BUILTIN_TRANSPORTS and your profile"),
    (r"Couldn't parse|Enclave|^\[|surrogates", "check what follows --ros-args on the command line"),
)
"""What to do about errors of rclpy that prevent a node, by what they say."""


def cannot_create(name: str, error: Exception) -> RosasyncError:
    """Return the error to raise if rclpy cannot create a node of this name."""
    reason = reason_of(error)
    found = [advice for pattern, advice in _OPENING if re.search(pattern, reason)]
    advice = f": {found[0]}" if found else ""
    return RosasyncError(f"rclpy cannot create the node {name!r} ({reason}){advice}")


def reason_of(error: Exception) -> str:
    """Return what rclpy says of an error in one line, without the source files of rcl."""
    return " ".join(_SOURCE.sub("", str(error)).split())


def is_up(node: Node) -> bool:
    """Return whether the node and its context are up."""
    return bool(node.context.ok()) and not is_destroyed(node.handle)


def is_destroyed(handle: Any) -> bool:
    """Return whether an entity was destroyed, or will be once it is no longer in use."""
    try:
        with handle:
            return not handle.pointer
    except InvalidHandle:
        return True


def check_up(node: Node) -> None:
    """Raise `ContextShutdown` if the node or its context is down."""
    if not is_up(node):
        raise ContextShutdown()


def explain(node: Node, handle: Any, error: Exception) -> Exception:
    """Return the error to raise after an operation on a client or service has failed.

    Args:
        node: the node of the entity.
        handle: the rclpy handle of the entity.
        error: what rclpy raised.
    """
    if not is_up(node):
        return ContextShutdown()
    if is_destroyed(handle):
        return PortDestroyed("the rclpy entity was destroyed")
    return RosasyncError(f"rclpy reports an error of an entity: {reason_of(error)}")


@contextmanager
def uses_node(node: Node) -> Iterator[None]:
    """Translate the errors of operations on a node.

    Raises:
        ContextShutdown: the node or its context is down.
        RosasyncError: rcl reports another error.
    """
    check_up(node)
    try:
        yield
    except RclpyError as error:
        check_up(node)
        raise RosasyncError(f"rclpy reports an error of the node: {reason_of(error)}") from error


def refusal(node: Node, service: Service, kind: str, error: Exception) -> Exception:
    """Return the error to raise after rclpy has failed to create a client or service."""
    if not is_up(node):
        return ContextShutdown()
    srv_name, srv_type, _ = service.key
    if "incompatible type" in str(error):
        return UsageError(
            f"{srv_name}: this process already has a client or server of this name with another "
            f"type than {srv_type}, and the middleware allows only one type: check which type is "
            "the right one; or use another name, or close the server, node or session of the other "
            "one first"
        )
    return RosasyncError(
        f"{srv_name}: the middleware refused to create the {kind} of type {srv_type}; check the "
        f"name, the QoS and how many entities this process has ({reason_of(error)})"
    )


def topic_refusal(node: Node, topic_name: str, error: Exception) -> Exception:
    """Return the error to raise after rclpy has failed to create a publisher or subscription."""
    if not is_up(node):
        return ContextShutdown()
    return RosasyncError(
        f"{topic_name}: the middleware refused the topic; check whether this process uses the name "
        f"with another type ({reason_of(error)})"
    )
