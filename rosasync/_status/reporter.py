"""The servers' side: reports what they will not answer, and learns which callers have left."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rosasync._core.ports import PortDestroyed
from rosasync._status.listener import BURST, REPORTS
from rosasync._status.wire import Departure, departure_topic, process_of, report_topic
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort, PublisherPort, SubscriptionPort
    from rosasync._status.wire import Report

__all__ = ["Reporter"]

logger = logging.getLogger("rosasync")


class Reporter:
    """The reports of all servers of a session that take part.

    The publisher of the reports is what shows callers that the process takes part. The first
    server creates it. The subscription to the departures is created when a caller listens to the
    reports. Confined to the loop's thread.

    Args:
        node: creates the topics.
    """

    def __init__(self, node: NodePort) -> None:
        self._node = node
        self._on_departures: dict[object, Callable[[Departure], None]] = {}
        # The last ones. Requests come another way, and may come later than the departures.
        self._departed: OrderedDict[tuple[bytes, int], None] = OrderedDict()
        self._process: str | None = None
        self._reports: PublisherPort | None = None
        self._departures: SubscriptionPort | None = None
        self._type: Any = None

    def join(
        self, server: object, identity: bytes | None, on_departure: Callable[[Departure], None]
    ) -> None:
        """Take part with a server, if the middleware identifies it.

        Args:
            server: the server, for `leave`.
            identity: what its callers know it by.
            on_departure: called with every departure that reaches this process.
        """
        process = process_of(identity)
        if process is None:
            logger.warning(
                "status=True has no effect: the middleware does not identify servers; rosasync "
                "was tested with rmw_fastrtps_cpp"
            )
            return
        self._on_departures[server] = on_departure
        if self._reports is None:
            from diagnostic_msgs.msg import DiagnosticStatus

            self._process, self._type = process, DiagnosticStatus
            self._reports = self._node.open_publisher(
                DiagnosticStatus, report_topic(process), REPORTS
            )
        self.on_graph()

    def leave(self, server: object) -> None:
        """Take part no longer; idempotent. The topics stay until the end of the session."""
        self._on_departures.pop(server, None)

    def on_graph(self) -> None:
        """Listen to departures once a caller listens to the reports; after a graph change."""
        if self._departures is None and self._process is not None and self._is_heard():
            from service_msgs.msg import ServiceEventInfo

            self._departures = self._node.open_subscription(
                ServiceEventInfo, departure_topic(self._process), BURST, self._on_message
            )

    def report(self, report: Report) -> None:
        """Publish a report. The last are kept for listeners that come soon."""
        if self._reports is not None:
            message = self._node.make_message(self._type, report.to_mapping())
            self._reports.publish(message)

    def has_left(self, client: bytes, number: int) -> bool:
        """Return whether the caller of a request that arrives now has left already."""
        return (client, number) in self._departed

    def _is_heard(self) -> bool:
        try:
            return self._reports is not None and self._reports.subscriptions() > 0
        except (PortDestroyed, ContextShutdown):
            return False

    def _on_message(self, message: Any) -> None:
        try:
            departure = Departure.read(message)
        except ValueError as error:
            logger.debug("a message on the topic of departures is none: %s", error)
            return
        self._departed[departure.client, departure.number] = None
        if len(self._departed) > BURST.depth:
            self._departed.popitem(last=False)
        for on_departure in tuple(self._on_departures.values()):
            on_departure(departure)
