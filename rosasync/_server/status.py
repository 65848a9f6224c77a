"""What a server tells its callers of unanswered calls, and learns of callers that leave."""

from __future__ import annotations

import asyncio
import logging
import weakref
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, Literal

from rosasync._core.ports import PortDestroyed
from rosasync._server.call_status import CallStatus
from rosasync._status.wire import Departure, Outcome, Report, identity_bytes
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._core.ports import ServicePort
    from rosasync._server.service_call import ServiceCall
    from rosasync._status.reporter import Reporter

__all__ = ["ServerStatus", "Status", "check_status"]

logger = logging.getLogger("rosasync")

Status = bool | Literal["quiet"]
"""Whether a server takes part, and with ``"quiet"`` keeps the messages of exceptions to itself."""


class ServerStatus:
    """The calls of one server that takes part. Confined to the loop's thread, but for reports.

    Args:
        srv_name: the resolved service name.
        port: the service.
        reporter: publishes the reports of all servers of the session.
        quiet: whether the messages of exceptions stay here.
        on_abandoned: called with a call whose caller has left, unless it is settled.
    """

    def __init__(
        self,
        srv_name: str,
        port: ServicePort,
        reporter: Reporter,
        *,
        quiet: bool,
        on_abandoned: Callable[[ServiceCall[Any, Any]], None],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._name = srv_name
        self._port = port
        self._identity = identity_bytes(port.identity)
        self._reporter = reporter
        self._quiet = quiet
        self._on_abandoned = on_abandoned
        # Weak, so that a call that its handler drops is collected, and warns.
        self._calls: weakref.WeakValueDictionary[tuple[bytes, int], ServiceCall[Any, Any]] = (
            weakref.WeakValueDictionary()
        )
        # The clients that the graph has shown. One that has sent a request, and is not there yet,
        # has not left.
        self._known: frozenset[Hashable] = frozenset()
        self._looking = False
        reporter.join(self, self._identity, self._on_departure)

    def take(self, call: ServiceCall[Any, Any], client: Hashable, number: int) -> CallStatus | None:
        """Follow a call, if the middleware identifies its client.

        Its caller may have left: what it said of that may have come before the request.
        """
        known = identity_bytes(client)
        if known is None or self._identity is None:
            return None
        self._calls[known, number] = call
        if known not in self._known and not self._looking:
            self._looking = True
            self._loop.call_soon(self.on_graph)
        return CallStatus(known, number, self._report, self._reporter.has_left(known, number))

    def on_graph(self) -> None:
        """Find out which clients have left the graph, with calls that are not settled."""
        self._looking = False
        if not self._calls:
            return
        try:
            clients = self._port.clients()
        except (ContextShutdown, PortDestroyed):
            return
        gone, self._known = self._known - clients, clients
        if gone:
            for (client, _), call in tuple(self._calls.items()):
                if client in gone:
                    self._abandon(call)

    def close(self) -> None:
        """Report the calls that stay unanswered. Call it when no response can be sent any more."""
        for call in tuple(self._calls.values()):
            if call.status is not None and not call.settled:
                call.status.report(Outcome.CLOSED)
        self._calls.clear()
        self._reporter.leave(self)

    def _on_departure(self, departure: Departure) -> None:
        call = self._calls.get((departure.client, departure.number))
        if call is not None:
            self._abandon(call)

    def _abandon(self, call: ServiceCall[Any, Any]) -> None:
        if call.status is not None and not call.settled and not call.status.abandoned:
            call.status.abandoned = True
            self._on_abandoned(call)

    def _report(self, call: CallStatus, outcome: Outcome, error: BaseException | None) -> None:
        if call.abandoned or self._identity is None:
            return
        kind = "" if error is None else f"{type(error).__module__}.{type(error).__qualname__}"
        report = Report(
            srv_name=self._name,
            server=self._identity,
            client=call.client,
            number=call.number,
            outcome=outcome,
            error_type=kind.removeprefix("builtins."),
            error_message="" if error is None or self._quiet else str(error),
        )
        if asyncio._get_running_loop() is self._loop:
            self._publish(report)
            return
        try:
            self._loop.call_soon_threadsafe(self._publish, report)
        except RuntimeError:
            return  # The loop has ended, and the session with it.

    def _publish(self, report: Report) -> None:
        try:
            self._reporter.report(report)
        except (ContextShutdown, PortDestroyed):
            return
        except Exception:
            # The caller learns it by its deadline, as from every other server.
            logger.exception("%s: a report of request #%d failed", self._name, report.number)


def check_status(status: Status) -> Status:
    """Return ``status``.

    Raises:
        ValueError: it is neither a bool nor ``"quiet"``.
    """
    if status is not True and status is not False and status != "quiet":
        raise ValueError(f"status must be True, False or 'quiet', not {status!r}")
    return status
