"""The clients' side: takes the reports of servers, and tells servers which callers have left."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from functools import partial
from typing import TYPE_CHECKING, Any

from rosasync._core.ports import PortDestroyed, TopicQos
from rosasync._status.wire import (
    Departure,
    Report,
    departure_topic,
    identity_bytes,
    process_of,
    report_topic,
)
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort, PublisherPort, Servers, SubscriptionPort

__all__ = ["BURST", "REPORTS", "Listener"]

logger = logging.getLogger("rosasync")

BURST = TopicQos(depth=1000)
"""For the departures of a burst: a thousand callers may leave at once."""
REPORTS = TopicQos(depth=100, latched=True)
"""For reports. The last are kept for a listener that is about to be matched: the first call of a
client may fail sooner. Of other clients' requests, they say nothing to it."""


class Listener:
    """The reports of all servers that take part, for all clients of a session.

    Nothing is created before a server takes part: its process publishes reports. Then there are a
    subscription and a publisher for each such process, whatever the number of its services. Both
    end when the process has left the graph. Confined to the loop's thread.

    Args:
        node: creates the topics.
    """

    def __init__(self, node: NodePort) -> None:
        self._node = node
        self._clients: dict[bytes, Callable[[Report], None]] = {}
        self._processes: dict[str, _Process] = {}

    def join(self, client: Hashable, on_report: Callable[[Report], None]) -> None:
        """Pass the reports about a client's requests to ``on_report``."""
        if (known := identity_bytes(client)) is not None:
            self._clients[known] = on_report

    def leave(self, client: Hashable) -> None:
        """Forget a client; idempotent."""
        if isinstance(client, bytes):
            self._clients.pop(client, None)

    def on_servers(self, servers: Servers) -> None:
        """Listen to the processes of these servers that take part; for every new generation."""
        for known, process in tuple(self._processes.items()):
            if not self._takes_part(known):
                process.close()
                del self._processes[known]
        for name in {process_of(server) for server in servers}:
            if name is None or name in self._processes:
                continue
            if self._takes_part(name):
                self._processes[name] = _Process(self._node, name, partial(self._take, name))

    def hears(self, servers: Servers) -> bool:
        """Return whether all of these servers take part, and both sides are matched."""
        processes = [self._processes.get(process_of(server) or "") for server in servers]
        return bool(processes) and all(p is not None and p.is_matched() for p in processes)

    def depart(self, client: Hashable, number: int, servers: Servers) -> bool:
        """Tell the servers of a request that its caller has left.

        Returns:
            Whether all of them take part, so that they drop the request.
        """
        known = identity_bytes(client)
        processes = [self._processes.get(process_of(server) or "") for server in servers]
        if known is None or not processes:
            return False
        told = [process is not None and process.tell(known, number) for process in processes]
        return all(told)

    def close(self) -> None:
        """Destroy the topics; idempotent."""
        for process in self._processes.values():
            process.close()
        self._processes.clear()
        self._clients.clear()

    def _takes_part(self, process: str) -> bool:
        """Return whether a process publishes reports itself, and not only another in its name."""
        publishers = self._node.queries.find_publishers(report_topic(process))
        return process in map(process_of, publishers)

    def _take(self, process: str, message: Any) -> None:
        """Take a message from the topic of a process."""
        try:
            report = Report.read(message)
        except ValueError as error:
            logger.debug("a message on the topic of reports is none: %s", error)
            return
        on_report = self._clients.get(report.client)
        if on_report is not None and process_of(report.server) == process:
            on_report(report)


class _Process:
    """The two topics of a process whose servers take part."""

    def __init__(self, node: NodePort, name: str, on_message: Callable[[Any], None]) -> None:
        from diagnostic_msgs.msg import DiagnosticStatus
        from service_msgs.msg import ServiceEventInfo

        self._node = node
        self._type = ServiceEventInfo
        self._departures: PublisherPort = node.open_publisher(
            ServiceEventInfo, departure_topic(name), BURST
        )
        self._reports: SubscriptionPort = node.open_subscription(
            DiagnosticStatus, report_topic(name), REPORTS, on_message
        )

    def is_matched(self) -> bool:
        """Return whether departures are received, and reports would be."""
        try:
            return bool(self._departures.subscriptions() and self._reports.publishers())
        except (PortDestroyed, ContextShutdown):
            return False

    def tell(self, client: bytes, number: int) -> bool:
        """Publish a departure, and return whether the process receives it."""
        if not self.is_matched():
            return False
        departure = Departure(client, number)
        try:
            self._departures.publish(self._node.make_message(self._type, departure.to_mapping()))
        except (PortDestroyed, ContextShutdown):
            return False
        return True

    def close(self) -> None:
        """Destroy both."""
        self._departures.close()
        self._reports.close()
