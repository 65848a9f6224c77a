"""Which bridge a session uses, and how its clients and services publish their calls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import rclpy
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.qos import qos_profile_system_default
from rclpy.service_introspection import ServiceIntrospectionState

from rosasync._core.gateway import LoopGateway
from rosasync._ros import rcl
from rosasync._ros.direct_bridge import DirectBridge
from rosasync._ros.executor_bridge import ExecutorBridge
from rosasync.errors import UsageError
from rosasync.options import SessionOptions

__all__ = ["Bridge", "load_rcl", "open_bridge", "takes_callbacks"]

Bridge: TypeAlias = DirectBridge | ExecutorBridge

DIRECT_TRIED = ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp")
"""The middlewares for which ``bridge="auto"`` chooses the direct bridge."""


def load_rcl(executor: Executor | None) -> rcl.Rcl | None:
    """Return librcl; None if it cannot be used here, or not beside this executor of the node."""
    return None if takes_callbacks(executor) else rcl.load()


def open_bridge(
    options: SessionOptions, node: Node, gateway: LoopGateway, librcl: rcl.Rcl | None
) -> Bridge:
    """Open the bridge that the options ask for.

    Raises:
        UsageError: it does not work here.
    """
    tried = rclpy.get_rmw_implementation_identifier() in DIRECT_TRIED
    if options.bridge == "direct" and librcl is None:
        raise UsageError(
            "bridge='direct' does not work here: either an EventsExecutor spins the node and "
            "takes the responses, or this platform does not support it; use bridge='auto'"
        )
    introspect = _introspection(options.introspection, node)
    if librcl is None or options.bridge == "executor" or (options.bridge == "auto" and not tried):
        if options.busy_poll:
            raise UsageError(
                "busy_poll needs the direct bridge, which is not in use here: leave it out, "
                "or see `rosasync doctor` for the reason"
            )
        return ExecutorBridge(node, gateway, introspect)
    return DirectBridge(node, librcl, gateway.loop, introspect, options.busy_poll)


def takes_callbacks(executor: Executor | None) -> bool:
    """Return whether this executor sets the middleware's callbacks itself, like EventsExecutor."""
    return any(kind.__name__ == "EventsExecutor" for kind in type(executor).__mro__)


def _introspection(level: str, node: Node) -> Callable[[Any], None]:
    """Return what makes a client or service publish its calls, as ``introspection`` says."""

    def introspect(entity: Any) -> None:
        if level != "off":
            state = getattr(ServiceIntrospectionState, level.upper())
            entity.configure_introspection(node.get_clock(), qos_profile_system_default, state)

    return introspect
