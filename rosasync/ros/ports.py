"""What pool and server need of a rcl client or service, so that they can be tested without one."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, Protocol

__all__ = ["ClientPort", "Deliver", "NodePort"]

Deliver = Callable[[int, Any], None]
"""Takes a sequence number and the response to it, on the loop's thread."""


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

    def servers(self, srv_name: str) -> int:
        """Return how many servers of this resolved name the graph shows, whatever their type."""

    def provides(self, srv_type: str, srv_name: str) -> bool:
        """Tell whether the graph shows a server of this resolved name and type."""

    def seen_instead(self, srv_type: str, srv_name: str) -> str:
        """Say, as a clause, what the graph shows where this service is missing."""
