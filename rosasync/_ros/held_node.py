"""The rclpy node of a session, with its context and the executor of the user that spins it."""

from __future__ import annotations

import asyncio
import contextlib

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidHandle, InvalidNodeNameException
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_node_name import validate_node_name

from rosasync._core.fork import forked, refuse
from rosasync._ros import configuration, discovery, fastdds, names, profile
from rosasync._ros.domain import check_domain, environment_domain
from rosasync._ros.failures import cannot_create
from rosasync._ros.shared_memory import check_ports
from rosasync.errors import UsageError
from rosasync.options import SessionOptions

__all__ = ["HeldNode"]

LEAVE_TIMEOUT = 0.2
"""Maximum number of seconds to wait for a user's executor to begin its next turn."""


class HeldNode:
    """A node that is borrowed; or one that is made, with a context of its own if none is given.

    Args:
        options: the session's.

    Attributes:
        node: the ``rclpy.node.Node``.

    Raises:
        TypeError, ValueError: the node is neither a node nor a valid name.
        UsageError: the context is down, or the ROS domain does not exist.
        RosasyncError: the node or the context cannot be created.
    """

    def __init__(self, options: SessionOptions) -> None:
        self._own = not isinstance(options.node, Node)
        self._own_context: Context | None = None
        self._executor: Executor | None = None
        try:
            self.node: Node = self._make(options) if self._own else options.node
        except BaseException:
            self._shut_context_down()
            raise

    def add_to(self, executor: Executor) -> None:
        """Let a user's executor spin the node; it is removed from it at the end."""
        if executor.add_node(self.node):
            self._executor = executor

    async def leave_executor(self) -> None:
        """Remove an own node from the user's executor, so that it can be destroyed safely.

        If entities are destroyed while an executor adds them to its wait set, its ``spin`` raises
        `InvalidHandle` (rclpy issue 1355). So wait until the executor has begun another turn, but
        only for `LEAVE_TIMEOUT`, because nothing may be spinning it.
        """
        executor = self._executor
        if executor is None or not self._own:
            return
        loop = asyncio.get_running_loop()
        turn = asyncio.Event()

        def report() -> None:
            # The executor may run this after the loop was closed.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(turn.set)

        executor.remove_node(self.node)
        # AttributeError: an executor of Jazzy that was shut down has no guard condition to trigger.
        with contextlib.suppress(AttributeError, InvalidHandle, RuntimeError, TimeoutError):
            # Two tasks: the turn that runs the first may have listed its nodes before the removal.
            executor.create_task(executor.create_task, report)
            async with asyncio.timeout(LEAVE_TIMEOUT):
                await turn.wait()

    def close(self) -> None:
        """Return what was borrowed, and destroy what was made."""
        # Drop the reference: a MultiThreadedExecutor ends its threads when it is collected.
        executor, self._executor = self._executor, None
        if executor is not None and self.node.executor is executor:
            self.node.executor = None
        if self._own_context is not None:
            # Not in a context that was given: its other nodes go on discovering.
            fastdds.end_discovery(self.node)
        if self._own:
            self.node.destroy_node()
        self._shut_context_down()

    def _make(self, options: SessionOptions) -> Node:
        name = options.node
        if not isinstance(name, str):
            kind = type(name).__name__
            raise TypeError(f"node must be a name or an rclpy.node.Node, not {kind}")
        context = options.context
        if context is not None and not context.ok():
            raise UsageError(
                "the context is not initialised, or was shut down: call "
                "rclpy.init(context=context) first, or leave it out"
            )
        try:
            # Here, and not only in `Node`, whose failure prints warnings about what it had made.
            validate_node_name(name)
            return self._make_in(context, name)
        except InvalidNodeNameException as error:
            reason = names.reason_of_name(error)
            raise ValueError(f"{name!r} is not a valid node name: {reason}") from None
        except UsageError:
            raise
        except (RuntimeError, UnicodeError) as error:
            # RCLError, or what C++ throws if the process is out of file descriptors; the second for
            # arguments of the command line.
            raise cannot_create(name, error) from error

    def _make_in(self, given: Context | None, name: str) -> Node:
        """Make a node, and a context for it unless one is given."""
        context = given
        if context is None:
            environment_domain()
            context = self._own_context = Context()
            rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
        if not fastdds.is_present():
            return Node(name, context=context)
        domain = context.get_domain_id()
        check_domain(domain)
        if forked() and discovery.own_ports(domain):
            # Inherited from a stock node of the parent.
            raise refuse()
        if given is not None:
            if not discovery.own_ports(domain):
                check_ports(domain)
            return Node(name, context=context)
        check_ports(domain)
        configuration.configure(domain)
        # The first node of a context makes its participant.
        with _introduced(domain):
            return Node(name, context=context)

    def _shut_context_down(self) -> None:
        if self._own_context is not None:
            self._own_context.try_shutdown()


def _introduced(domain: int) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext() if profile.switched_off() else discovery.introduced(domain)
