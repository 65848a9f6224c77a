"""The executor bridge, on rclpy's public API only."""

from __future__ import annotations

import contextlib
import itertools
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node

from rosasync.errors import SessionClosed
from rosasync.ros.executor import Mailbox
from rosasync.ros.ports import Deliver

__all__ = ["ExecutorBridge"]


class ExecutorBridge:
    """Has the executor take the responses, and brings them to the loop by a mailbox."""

    name = "executor"

    def __init__(self, node: Node, mailbox: Mailbox) -> None:
        self._node = node
        self._mailbox = mailbox
        # A group of their own, so that no other callback of the node holds the clients back.
        self._group = ReentrantCallbackGroup()

    def open_client(self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver) -> FutureClient:
        """Make a client whose responses go to ``deliver``, on the loop's thread."""
        client = self._node.create_client(
            srv_type, srv_name, qos_profile=qos, callback_group=self._group
        )
        return FutureClient(self._node, client, self._mailbox, deliver)

    def close(self) -> None:
        """Nothing is held besides the clients."""


class FutureClient:
    """A rclpy client whose futures complete in the executor's thread."""

    def __init__(self, node: Node, client: Any, mailbox: Mailbox, deliver: Deliver) -> None:
        self._node = node
        self._client = client
        self._mailbox = mailbox
        self._deliver = deliver
        self.handle = client.handle
        self.ready = client.service_is_ready
        self._numbers = itertools.count(1)
        self._out: dict[int, Any] = {}

    def send(self, request: Any) -> int:
        """Send a request; a number for it, which grows with every send."""
        number = next(self._numbers)
        future = self._client.call_async(request)
        self._out[number] = future
        future.add_done_callback(_Completion(self, number))
        return number

    def forget(self, number: int) -> None:
        """Expect no response to this request any more."""
        future = self._out.pop(number, None)
        if future is not None:
            self._client.remove_pending_request(future)

    def close(self) -> None:
        """Destroy the rclpy client; idempotent."""
        for number in tuple(self._out):
            self.forget(number)
        self._node.destroy_client(self._client)

    def complete(self, number: int, future: Any) -> None:
        """Take a completed future's response to the loop. Called on the executor's thread."""
        if not future.cancelled():
            # After the close there is nobody to be told.
            with contextlib.suppress(SessionClosed):
                self._mailbox.post(self._arrived, number, future)

    def _arrived(self, number: int, future: Any) -> None:
        if self._out.pop(number, None) is not None:
            self._deliver(number, future.result())


class _Completion:
    """The done-callback of one request."""

    __slots__ = ("_client", "_number")

    def __init__(self, client: FutureClient, number: int) -> None:
        self._client = client
        self._number = number

    def __call__(self, future: Any) -> None:
        self._client.complete(self._number, future)
