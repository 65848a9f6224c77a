"""A process of stock nodes with parameters and lifecycles: ``python -m tests.support.managed``.

Each is a plain ``rclpy`` node. A ``MultiThreadedExecutor`` spins all of them, so a callback that
blocks holds up its own node only.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import threading
from collections.abc import Callable
from typing import Any

from tests.support.executor import spin
from tests.support.process import NodeProcess
from tests.support.times import LIMIT

__all__ = ["NodesProcess"]

VALUES: dict[str, Any] = {
    "bool": True,
    "integer": -(2**63),
    "double": 0.5,
    "string": "grüß dich",
    "byte_array": [b"\x00", b"\xff"],
    "bool_array": [True, False],
    "integer_array": [2**63 - 1, 0],
    "double_array": [0.5, -1.5],
    "string_array": ["a", ""],
    "arm.left.speed": 1.0,
    "arm.right.speed": 2.0,
}
"""The parameters of a node of the kind "parameters", as rclpy declares them."""


class NodesProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.support.managed"

    def __init__(self) -> None:
        super().__init__()
        self._numbers = itertools.count()

    async def add(self, kind: str, name: str = "node") -> str:
        """Create a node, and return its full name, which no other node has."""
        name = f"{name}_{next(self._numbers)}"
        await asyncio.to_thread(self.ask_first, "add", patience=LIMIT, kind=kind, name=name)
        return f"/stock/{name}"

    async def release(self) -> None:
        """Let the callbacks go on that are held."""
        await self.ask("release")

    async def held(self) -> None:
        """Wait until a callback is held."""
        await self.ask("held")


class _Nodes:
    """The child's side: the commands, run in the thread that reads them."""

    def __init__(self, executor: Any) -> None:
        self._executor = executor
        self._held = threading.Event()
        self._released = threading.Event()

    def add(self, kind: str, name: str) -> None:
        make: Callable[[str], Any] = getattr(self, f"_{kind}")
        self._executor.add_node(make(name))

    def held(self) -> None:
        assert self._held.wait(LIMIT)
        self._held.clear()

    def release(self) -> None:
        self._released.set()

    def hold(self) -> None:
        self._held.set()
        assert self._released.wait(LIMIT)
        self._released.clear()

    # Nodes with parameters.

    def _parameters(self, name: str) -> Any:
        from rcl_interfaces.msg import (
            FloatingPointRange,
            IntegerRange,
            ParameterDescriptor,
            SetParametersResult,
        )

        node = _node(name)
        for parameter, value in VALUES.items():
            node.declare_parameter(parameter, value)
        node.declare_parameter("serial", "A1", ParameterDescriptor(read_only=True))
        node.declare_parameter("any", 1, ParameterDescriptor(dynamic_typing=True))
        node.declare_parameter("volume", 5, _ranged(IntegerRange, 0, 11, 1, "how loud"))
        node.declare_parameter("gain", 0.5, _ranged(FloatingPointRange, 0.0, 1.0, 0.25, "in dB"))
        node.declare_parameter("mode", "idle")

        def check(parameters: list[Any]) -> SetParametersResult:
            bad = [
                p.value for p in parameters if p.name == "mode" and p.value not in ("idle", "on")
            ]
            return SetParametersResult(
                successful=not bad, reason=f"no such mode: {bad[0]}" if bad else ""
            )

        node.add_on_set_parameters_callback(check)
        return node

    def _unset(self, name: str) -> Any:
        from rclpy.parameter import Parameter

        node = _node(name)
        node.declare_parameter("first", 1)
        node.declare_parameter("unset", Parameter.Type.INTEGER)
        node.declare_parameter("texts", Parameter.Type.STRING_ARRAY)
        node.declare_parameter("last", "z")
        return node

    def _read_only(self, name: str) -> Any:
        from rcl_interfaces.msg import ParameterDescriptor

        node = _node(name)
        for parameter, value in (("nan", math.nan), ("nans", [math.nan, 1.0]), ("whole", 1.0)):
            node.declare_parameter(parameter, value, ParameterDescriptor(read_only=True))
        return node

    def _undeclared(self, name: str) -> Any:
        return _node(name, allow_undeclared_parameters=True)

    def _no_services(self, name: str) -> Any:
        return _node(name, start_parameter_services=False)

    # Lifecycle nodes.

    def _lifecycle(self, name: str) -> Any:
        return _lifecycle_node(name)

    def _failing(self, name: str) -> Any:
        """Its configuration fails."""
        from rclpy.lifecycle import TransitionCallbackReturn

        return _lifecycle_node(name, on_configure=lambda _: TransitionCallbackReturn.FAILURE)

    def _recovering(self, name: str) -> Any:
        """Its activation raises an exception, from which it recovers."""
        return _lifecycle_node(name, on_activate=_raise)

    def _broken(self, name: str) -> Any:
        """Its configuration raises an exception, from which it does not recover."""
        from rclpy.lifecycle import TransitionCallbackReturn

        return _lifecycle_node(
            name, on_configure=_raise, on_error=lambda _: TransitionCallbackReturn.FAILURE
        )

    def _slow(self, name: str) -> Any:
        """Its configuration is held, and nothing else of the node runs meanwhile."""
        return _lifecycle_node(name, on_configure=self._configure_slowly)

    def _slow_and_talking(self, name: str) -> Any:
        """Its configuration is held, and it answers other calls meanwhile."""
        return _lifecycle_node(name, reentrant=True, on_configure=self._configure_slowly)

    def _configure_slowly(self, _: Any) -> Any:
        from rclpy.lifecycle import TransitionCallbackReturn

        self.hold()
        return TransitionCallbackReturn.SUCCESS


def _node(name: str, **options: Any) -> Any:
    import rclpy

    return rclpy.create_node(name, namespace="/stock", **options)


def _ranged(kind: Any, low: float, high: float, step: float, description: str) -> Any:
    from rcl_interfaces.msg import IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(description=description, additional_constraints="not at night")
    limits = [kind(from_value=low, to_value=high, step=step)]
    if kind is IntegerRange:
        descriptor.integer_range = limits
    else:
        descriptor.floating_point_range = limits
    return descriptor


def _raise(_: Any) -> Any:
    raise OSError("the cable is loose")


def _lifecycle_node(name: str, reentrant: bool = False, **callbacks: Callable[[Any], Any]) -> Any:
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.lifecycle.node import LifecycleNodeMixin
    from rclpy.node import Node

    class Managed(LifecycleNodeMixin, Node):  # type: ignore[misc]
        """As ``rclpy.lifecycle.LifecycleNode``, which does not take a callback group."""

        def __init__(self) -> None:
            Node.__init__(self, name, namespace="/stock")
            self.__dict__.update(callbacks)
            group = ReentrantCallbackGroup() if reentrant else None
            LifecycleNodeMixin.__init__(self, callback_group=group)

    return Managed()


def main() -> None:
    import rclpy
    from rclpy.executors import MultiThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    executor = MultiThreadedExecutor(num_threads=4)
    # The first node reads the middleware's profile, a file that is gone after "ready".
    executor.add_node(_node("first"))
    nodes = _Nodes(executor)
    spin(executor, nodes, nodes.release)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
