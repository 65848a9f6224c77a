"""The messages by which servers and callers tell each other how a call has ended: pure.

A server reports on a topic of its process, as a ``diagnostic_msgs/msg/DiagnosticStatus``, which the
usual tools show. A caller that leaves says so on another topic of the server's process, as a
``service_msgs/msg/ServiceEventInfo``. Both name the request by its client, which is the GUID of the
reader of its responses, and by its sequence number.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from enum import Enum
from typing import Any

__all__ = [
    "DEPARTURE_TYPE",
    "LEFT",
    "REPORT_TYPE",
    "Departure",
    "Outcome",
    "Report",
    "departure_topic",
    "identity_bytes",
    "process_of",
    "report_topic",
]

REPORT_TYPE = "diagnostic_msgs/msg/DiagnosticStatus"
DEPARTURE_TYPE = "service_msgs/msg/ServiceEventInfo"
LEFT = 255
"""The event type of a departure. ``ServiceEventInfo`` itself defines 0 to 3, for introspection."""

IDENTITY, PROCESS = 16, 12
"""Bytes of an endpoint's GUID, and those at its start that name its process (RTPS 2.5, 9.3.1)."""
WARN = b"\x01"
"""``DiagnosticStatus.WARN``."""


class Outcome(Enum):
    """Why a server does not answer a request."""

    FAILED = "failed"
    """The handler raised."""
    DROPPED = "dropped"
    """Too many requests waited."""
    CLOSED = "closed"
    """The server has ended."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a server says of a request that it will not answer.

    Attributes:
        srv_name: the resolved name of the service.
        server: the server.
        client: the client that sent the request.
        number: the request's sequence number.
        outcome: why there is no answer.
        error_type: the type of the exception that the handler raised; empty if it did not.
        error_message: its message; empty if the server does not disclose it.
    """

    srv_name: str
    server: bytes
    client: bytes
    number: int
    outcome: Outcome
    error_type: str = ""
    error_message: str = ""

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields of the message."""
        values = {
            "client": self.client.hex(),
            "request": str(self.number),
            "outcome": self.outcome.value,
            "error_type": self.error_type,
        }
        return {
            "level": WARN,
            "name": self.srv_name,
            "message": self.error_message,
            "hardware_id": self.server.hex(),
            "values": [{"key": key, "value": value} for key, value in values.items()],
        }

    @classmethod
    def read(cls, message: Any) -> Report:
        """Return the report in a message.

        Raises:
            ValueError: it is none. Any program may publish on the topic.
        """
        values = {pair.key: pair.value for pair in message.values}
        try:
            return cls(
                srv_name=message.name,
                server=bytes.fromhex(message.hardware_id),
                client=bytes.fromhex(values["client"]),
                number=int(values["request"]),
                outcome=Outcome(values["outcome"]),
                error_type=values["error_type"],
                error_message=message.message,
            )
        except KeyError as error:
            raise ValueError(f"a report without the value {error}") from None


@dataclass(frozen=True, slots=True)
class Departure:
    """That the caller of a request does not wait any more.

    Attributes:
        client: the client that sent the request.
        number: the request's sequence number.
    """

    client: bytes
    number: int

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields of the message."""
        return {
            "event_type": LEFT,
            "client_gid": list(self.client),
            "sequence_number": self.number,
        }

    @classmethod
    def read(cls, message: Any) -> Departure:
        """Return the departure in a message.

        Raises:
            ValueError: it is none. Any program may publish on the topic.
        """
        if message.event_type != LEFT:
            raise ValueError(f"an event of type {message.event_type}")
        return cls(bytes(bytearray(message.client_gid)), message.sequence_number)


def identity_bytes(identity: Hashable) -> bytes | None:
    """Return the identity of a client or server as bytes; None if the middleware has none."""
    return identity if isinstance(identity, bytes) and len(identity) == IDENTITY else None


def process_of(identity: Hashable) -> str | None:
    """Return the name of the process of a client or server, as it stands in the topics' names."""
    known = identity_bytes(identity)
    return None if known is None else f"p{known[:PROCESS].hex()}"


def report_topic(process: str) -> str:
    """Return the hidden topic on which the servers of a process report."""
    return f"/_rosasync/{process}/reports"


def departure_topic(process: str) -> str:
    """Return the hidden topic on which callers tell the servers of a process that they leave."""
    return f"/_rosasync/{process}/departures"
