"""ResultRequests: the requests for the results of an action's goals."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from rosasync._core.ports import PortDestroyed
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import ClientPort, NodePort, Service

__all__ = ["ResultRequests"]

BURST = 5
"""Requests sent at a time: half the depth of a stock server's queue, which silently drops more."""
PERIOD = 0.005
"""Seconds between two bursts, in which a server takes the requests of one."""
POLL_MIN = 0.005
"""Seconds until the first look whether the client is matched, while requests wait for that."""
POLL_MAX = 0.25
"""Maximum number of seconds between two such looks."""


class ResultRequests:
    """Asks for the results of goals. A request is out for as long as its goal runs.

    So it has a client of its own, beside the pool: it takes no place in the window, has no
    deadline, and does not count in the statistics. Nothing tells that the server has taken a
    request, so a goal may be asked for again.

    Confined to the loop's thread.

    Args:
        node: creates the client.
        service: the action's service for results.
        request_type: the class of its requests.
        on_result: called with the bytes of the UUID and the response.
    """

    def __init__(
        self,
        node: NodePort,
        service: Service,
        request_type: type[Any],
        on_result: Callable[[bytes, Any], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._service = service
        self._request_type = request_type
        self._on_result = on_result
        self._port: ClientPort | None = None
        self._queue: OrderedDict[bytes, None] = OrderedDict()
        # Every request that is out, and those of each goal.
        self._keys: dict[int, bytes] = {}
        self._numbers: dict[bytes, list[int]] = {}
        # Runs while requests are queued, and once after a burst.
        self._timer: asyncio.TimerHandle | None = None
        self._left = BURST
        self._poll = POLL_MIN

    def open(self) -> None:
        """Create the client, unless there is one; raises as `NodePort.open_client`."""
        if self._port is None:
            self._port = self._node.open_client(self._service, self._deliver)

    def ready(self) -> bool:
        """Return whether a server is matched."""
        try:
            return self._port is not None and self._port.ready()
        except PortDestroyed:
            self._replace()
            return False

    def ask(self, key: bytes, *, room: bool = False) -> None:
        """Ask for the result of a goal, now or as soon as the pace allows.

        Args:
            key: the bytes of the goal's UUID.
            room: whether the server has just accepted a goal. Then it takes requests, and has room
                for one more than the pace allows.
        """
        self._queue[key] = None
        if room:
            self._left += 1
        waits_for_match = self._poll != POLL_MIN
        if self._timer is None or (self._left and not waits_for_match):
            self._send()

    def forget(self, key: bytes) -> None:
        """Expect no more results of a goal; idempotent."""
        self._queue.pop(key, None)
        for number in self._numbers.pop(key, ()):
            del self._keys[number]
            if self._port is not None:
                self._port.forget(number)

    def close(self) -> None:
        """Destroy the client and drop all requests; idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._queue.clear()
        self._keys.clear()
        self._numbers.clear()
        if self._port is not None:
            self._port.close()
            self._port = None

    def _send(self) -> None:
        # The session notices the shutdown of the context by itself.
        with suppress(ContextShutdown):
            self._send_burst()

    def _send_burst(self) -> None:
        if not self.ready():
            if self._timer is None:
                self._timer = self._loop.call_later(self._poll, self._continue)
                self._poll = min(2 * self._poll, POLL_MAX)
            return
        self._poll = POLL_MIN
        while self._queue and self._left:
            self._left -= 1
            key, _ = self._queue.popitem(last=False)
            if not self._send_one(key):
                break
        if self._timer is None:
            self._timer = self._loop.call_later(PERIOD, self._continue)

    def _send_one(self, key: bytes) -> bool:
        assert self._port is not None
        request = self._request_type()
        request.goal_id.uuid = list(key)
        try:
            number = self._port.send(request)
        except PortDestroyed:
            self._replace()
            self._queue[key] = None
            return False
        self._keys[number] = key
        self._numbers.setdefault(key, []).append(number)
        return True

    def _continue(self) -> None:
        self._timer = None
        self._left = BURST
        if self._queue:
            self._send()

    def _replace(self) -> None:
        """Create another client, and ask again for everything, after something destroyed it."""
        self._port = None
        self._queue.update(dict.fromkeys(self._numbers))
        self._keys.clear()
        self._numbers.clear()
        self.open()

    def _deliver(self, number: int, response: Any) -> None:
        key = self._keys.get(number)
        if key is not None:
            self._on_result(key, response)
