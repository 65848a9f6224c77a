"""What pool and server need of a rcl client or service, so that they can be tested without one."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Protocol

__all__ = [
    "ClientPort",
    "Deliver",
    "DeliverRequest",
    "NodePort",
    "RequestHeader",
    "RequestId",
    "ServicePort",
    "Undeliverable",
    "Unmatched",
]

Deliver = Callable[[int, Any], None]
"""Takes a sequence number and the response to it, on the loop's thread."""


class Undeliverable(Exception):
    """The middleware says that a response reaches nobody."""


class Unmatched(Undeliverable):
    """The client was just made: the way back to it is not there yet. To be sent again."""


class RequestId(Protocol):
    """Whose request it is, and which. Its client is in it, but not to be seen."""

    @property
    def sequence_number(self) -> int:
        """The number its client gave it."""


class RequestHeader(Protocol):
    """What came with a request: to be kept as it is, for the response."""

    @property
    def request_id(self) -> RequestId:
        """Where the response goes."""

    @property
    def source_timestamp(self) -> int:
        """When the request was sent, in ns; 0 or less where that is unknown."""

    @property
    def received_timestamp(self) -> int:
        """When it arrived, in ns; 0 or less where that is unknown."""


DeliverRequest = Callable[[Any, RequestHeader], None]
"""Takes a request and its header, on the loop's thread."""


class ServicePort(Protocol):
    """One rcl service. Every method returns at once, and is called on the loop's thread, but for
    those that say otherwise.
    """

    @property
    def handle(self) -> Any:
        """The rclpy object."""

    @property
    def qos(self) -> Any:
        """The QoS in use."""

    @property
    def linger(self) -> float:
        """Seconds to wait between `stop` and `close`, if there is time."""

    def send(self, header: RequestHeader, response: Any) -> None:
        """Convert and send a response. On any thread, but never during or after `close`.

        Raises:
            Undeliverable: the middleware says that it reaches nobody.
            Unmatched: it reaches nobody yet.
        """

    def has_clients(self) -> bool:
        """Tell whether the graph shows a client. On any thread, but not during `close`."""

    def stop(self) -> None:
        """Deliver no more requests; idempotent. Responses may still be sent."""

    def close(self) -> None:
        """Destroy the service; idempotent."""


class ClientPort(Protocol):
    """One rcl client. Every method is called on the loop's thread and returns at once."""

    def send(self, request: Any) -> int:
        """Send a request and return its sequence number, which grows with every send."""

    def forget(self, sequence_number: int) -> None:
        """Expect no response to this request any more."""

    def ready(self) -> bool:
        """Tell whether a server is matched, so that a request sent now reaches it."""

    def close(self) -> None:
        """Destroy the client; idempotent."""


class NodePort(Protocol):
    """One node. Every method is called on the loop's thread and returns at once."""

    @property
    def graph_events(self) -> bool:
        """Whether the pool is told of changes of the graph, or has to look."""

    def ok(self) -> bool:
        """Tell whether node and context are still up."""

    def describe(self, srv_type: Any, qos: Any) -> tuple[Any, str, Hashable]:
        """Return the service class, the type's name, and the QoS as something to compare.

        Raises:
            TypeError, ValueError: there is no such type, or that is no QoS.
        """

    def request(self, srv_type: Any, request: Any) -> Any:
        """Return a message of the request type, made from a mapping or None where it has to be.

        Raises:
            TypeError, ValueError: it does not fit.
        """

    def resolve(self, srv_name: str) -> str:
        """Return the expanded and remapped name.

        Raises:
            InvalidServiceName: ROS does not allow the name.
        """

    def open_client(self, srv_type: Any, srv_name: str, qos: Any, deliver: Deliver) -> ClientPort:
        """Make a client whose responses go to ``deliver``."""

    def open_service(
        self, srv_type: Any, srv_name: str, qos: Any, deliver: DeliverRequest
    ) -> ServicePort:
        """Make a service whose requests go to ``deliver``."""

    def servers(self, srv_name: str) -> int:
        """Return how many servers of this resolved name the graph shows, whatever their type."""

    def provides(self, srv_type: str, srv_name: str) -> bool:
        """Tell whether the graph shows a server of this resolved name and type."""

    def seen_instead(self, srv_type: str, srv_name: str) -> str:
        """Say, as a clause, what the graph shows where this service is missing."""
