"""Faults of one server: its service port, with responses that are late, lost, held or doubled."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Generic, TypeAlias

from rosasync._core.ports import PortDestroyed, Undeliverable, Unmatched
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from rosasync._core.ports import DeliverRequest, RequestHeader, Service, ServicePort

__all__ = ["Faults", "FaultyService", "OpenService", "StubCall", "set_in_block"]

OpenService: TypeAlias = "Callable[[Service, DeliverRequest], ServicePort]"
"""Opens a service's port."""

REMATCH = 0.05
"""Seconds after which a response is sent again to a client that is not fully discovered."""


@dataclass(eq=False)
class StubCall(Generic[RequestT, ResponseT]):
    """A request that a `StubServer` received.

    Attributes:
        request: the request message.
        response: a copy of the response; None if there is none yet. It is set when the handler
            responds, even if a fault then delays or drops it.
    """

    request: RequestT
    response: ResponseT | None = None


@dataclass
class Faults:
    """What goes wrong between one server and its clients.

    Attributes:
        delay: seconds by which responses are delayed.
        dropping_requests: whether requests are lost.
        dropping_responses: whether responses are lost.
        duplicating: whether responses are sent twice.
        holding: whether responses are held back.
        held: sends the responses that were held back.
        lost_requests: the number of requests that were lost.
    """

    delay: float = 0.0
    dropping_requests: bool = False
    dropping_responses: bool = False
    duplicating: bool = False
    holding: bool = False
    held: list[Callable[[], None]] = field(default_factory=list)
    lost_requests: int = 0

    def release(self) -> None:
        """Send the responses that were held back."""
        held, self.held = self.held, []
        for send in held:
            send()


@contextmanager
def set_in_block(owner: object, name: str, value: object) -> Iterator[None]:
    """Set an attribute in this block."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


class FaultyService:
    """A service port with faults: a `rosasync._core.ports.ServicePort`.

    Args:
        open_service: opens the port that this one wraps.
        service: the service.
        deliver: takes the requests.
        faults: what goes wrong.
        on_call: called with each request that arrives.
    """

    def __init__(
        self,
        open_service: OpenService,
        service: Service,
        deliver: DeliverRequest,
        faults: Faults,
        on_call: Callable[[StubCall[Any, Any]], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._deliver = deliver
        self._faults = faults
        self._on_call = on_call
        # By the identity of the header, which is kept so that no other one takes its place.
        self._calls: dict[int, tuple[RequestHeader, StubCall[Any, Any]]] = {}
        self._closed = False
        self._port = open_service(service, self._arrived)

    @property
    def handle(self) -> Any:
        """The ``rclpy.service.Service``."""
        return self._port.handle

    @property
    def qos(self) -> Any:
        """The ``QoSProfile`` in use."""
        return self._port.qos

    @property
    def destroy_delay(self) -> float:
        """Seconds to wait between `stop` and `close`."""
        return self._port.destroy_delay

    @property
    def repair_time(self) -> float:
        """Seconds after which the middleware sends a lost response again."""
        return self._port.repair_time

    @property
    def destroyed(self) -> bool:
        """Whether something other than rosasync has destroyed the service."""
        return self._port.destroyed

    @property
    def identity(self) -> Hashable:
        """What the graph shows for this service."""
        return self._port.identity

    def client_of(self, header: RequestHeader) -> Hashable:
        """Return the identity of the client that sent a request."""
        return self._port.client_of(header)

    def clients(self) -> frozenset[Hashable]:
        """Identify the clients that the graph shows."""
        return self._port.clients()

    def send(self, header: RequestHeader, response: Any) -> None:
        """Send a response as the faults say. From any thread."""
        faults = self._faults
        copy = deepcopy(response)
        if (entry := self._calls.pop(id(header), None)) is not None:
            entry[1].response = copy
        if faults.dropping_responses:
            return
        if faults.holding:
            faults.held.append(lambda: self._send_later(header, copy))
        elif faults.delay:
            self._loop.call_soon_threadsafe(
                self._loop.call_later, faults.delay, self._send_later, header, copy
            )
        else:
            self._port.send(header, response)
        if faults.duplicating:
            self._loop.call_soon_threadsafe(self._send_later, header, copy)

    def has_clients(self) -> bool:
        """Return whether the graph shows a client."""
        return self._port.has_clients()

    def delivered(self) -> bool:
        """Return whether every client has received every response that was let through."""
        return self._port.delivered()

    def stop(self) -> None:
        """Stop delivering requests; idempotent."""
        self._port.stop()

    def close(self) -> None:
        """Destroy the service; idempotent. Delayed and held responses are lost."""
        self._closed = True
        self._port.close()

    def _arrived(self, request: Any, header: RequestHeader) -> None:
        if self._faults.dropping_requests:
            self._faults.lost_requests += 1
            return
        call = StubCall[Any, Any](deepcopy(request))
        self._calls[id(header)] = header, call
        self._on_call(call)
        self._deliver(request, header)

    def _send_later(self, header: RequestHeader, response: Any) -> None:
        if self._closed:
            return
        try:
            self._port.send(header, response)
        except Unmatched:
            self._loop.call_later(REMATCH, self._send_later, header, response)
        except (Undeliverable, PortDestroyed):
            # The server has counted the response as sent: it is lost on its way.
            return


if TYPE_CHECKING:

    def _fits(service: FaultyService) -> ServicePort:
        return service
