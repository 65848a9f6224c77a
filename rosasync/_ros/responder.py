"""Sending responses, without blocking repeatedly for a client that cannot receive them."""

from __future__ import annotations

import ctypes
import re
import struct
import threading
import warnings
from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass
from time import monotonic
from typing import Any, NoReturn, TypeGuard

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.service import Service

from rosasync._core.ports import RequestHeader, Undeliverable, Unmatched
from rosasync._ros import fastdds
from rosasync._ros.checks import checker
from rosasync._ros.endpoints import (
    GUID_PREFIX,
    gid_of,
    incompatibility,
    prefixes,
    request_writers,
    response_readers,
)
from rosasync._ros.failures import RclpyError, explain, is_destroyed, reason_of, uses_node
from rosasync._ros.fastdds import acknowledged
from rosasync._ros.messages import make_message
from rosasync.errors import RosasyncError

__all__ = ["Responder", "client_of"]

SLOW_SEND = 0.05
"""Seconds from which a send is slow: it may have waited for a client that is not matched."""
WATCH_TIME = 3.0
"""Seconds after a failed send for which the graph is checked before every send."""
POLL_INTERVAL = 0.05
"""Seconds between two queries of the graph."""
MATCH_DELAYS = (0.05, 0.2, 0.8, 3.2)
"""Seconds for which a client has to be visible before a failed send to it is repeated, and then
between further sends. On a machine with other work a match may take longer than a send waits."""
MOST_UNREACHED = 1000
"""Maximum number of clients that are remembered as unreached."""
NOT_MATCHED = "the client was not matched in time"
"""The reason of a failed send for which rclpy gives none."""

INFO = struct.Struct("<qq16sq")
"""``rmw_service_info_t``: two timestamps, and a request id of a GUID and a sequence number."""

# rclpy reports a failed send by a RuntimeWarning only, which the filters of the program may ignore.
# But for every warning, before it applies the filters, CPython stores their version in the registry
# of the module that warns. So a registry that is not empty shows that there was a warning.
__warningregistry__: dict[Any, Any] = {}
# Its text, that the client will not receive the response, would be on stderr, and would be wrong:
# the response is sent again.
warnings.filterwarnings("ignore", category=RuntimeWarning, module=re.escape(__name__) + "$")
# Held from a send until the registry was looked at, because all threads share it. Reentrant,
# because the garbage collector may run a __del__ that sends.
_sends = threading.RLock()


@dataclass(slots=True)
class Unreached:
    """A client that a send has not reached.

    Attributes:
        failures: the number of sends that failed although the graph showed the reader.
        due: when to send again; None until the graph shows the reader.
    """

    failures: int = 0
    due: float | None = None


class ClientGraph:
    """The clients of one service as the graph shows them, queried once in `POLL_INTERVAL`."""

    def __init__(self, node: Node, srv_name: str) -> None:
        self._node = node
        self._srv_name = srv_name
        self._poll_at = 0.0
        self.readers: dict[bytes, QoSProfile] = {}
        self.writers: Counter[bytes] = Counter()
        # Whether requests name their client by a GUID of the graph, as far as known. Those of
        # Cyclone DDS have a number of its own.
        self._uses_guids = fastdds.is_present()

    def refresh(self, now: float) -> bool:
        """Query the graph if it is time, and return whether it was."""
        if now < self._poll_at:
            return False
        self._poll_at = now + POLL_INTERVAL
        with uses_node(self._node):
            readers = response_readers(self._node, self._srv_name)
            self.readers = {gid_of(reader): reader.qos_profile for reader in readers}
            self.writers = Counter(prefixes(request_writers(self._node, self._srv_name)))
        return True

    @property
    def empty(self) -> bool:
        """Whether no client is visible: all have left, or the middleware names topics otherwise."""
        return not self.readers and not self.writers

    def identifies(self, client: bytes | None) -> TypeGuard[bytes]:
        """Return whether the graph would show the client of a request by this identity."""
        if client is None:
            return False
        self._uses_guids = self._uses_guids or self.has_process(client)
        return self._uses_guids

    def has_process(self, guid: bytes) -> bool:
        """Return whether the process of this reader still has a client of the service."""
        return guid in self.readers or guid[:GUID_PREFIX] in self.writers

    def half_known(self) -> bool:
        """Return whether a process shows more request writers than response readers."""
        readers = Counter(guid[:GUID_PREFIX] for guid in self.readers)
        return bool(self.writers - readers)


class Responder:
    """Sends the responses of one service. Its methods may be called on any thread.

    The middleware waits for a client that is not matched, by default for 0.1 s, and then drops the
    response. rclpy holds the GIL during that time, so the whole process stops. A client is not
    matched if a packet of its discovery was lost, or if its QoS does not fit. After a slow send,
    the client is identified. Further responses to it are sent only when the graph shows that they
    can arrive, so that one client stops the process only once, or a few times at growing intervals
    if it is visible and still not matched.
    """

    def __init__(self, node: Node, service: Service, qos: QoSProfile) -> None:
        self._node = node
        self._handle = service.handle
        self._send = service.handle.service_send_response
        self._response_type = service.srv_type.Response
        self._fits = checker(self._response_type)
        self._srv_name = str(service.service_name)
        self._qos = qos
        self._graph = ClientGraph(node, self._srv_name)
        self._watching = False
        self._watch_until = 0.0
        # Changed by single operations only, because several threads may send.
        self._unreached: dict[bytes, Unreached] = {}

    def send(self, header: RequestHeader, response: Any) -> None:
        """Convert and send a response.

        Raises:
            Undeliverable: the client cannot get it.
            Unmatched: the client cannot get it yet.
            PortDestroyed: the service was destroyed.
            ContextShutdown: the node is down.
            TypeError, ValueError: a field has a value that cannot be sent.
            RosasyncError: the middleware refuses the response.
        """
        if not self._fits(response):
            response = make_message(self._response_type, response)
        unreached = self._check(header) if self._watching else None
        failure = None
        with _sends:
            started = monotonic()
            try:
                # It raises for a destroyed service even while an executor still holds it.
                with self._handle:
                    self._send(response, header.request_id)
            except RclpyError as error:
                raise self._failure(error) from error
            except SystemError as error:
                # A filter has turned the warning into an error, which rclpy does not handle.
                if not isinstance(error.__cause__, RuntimeWarning):
                    raise
                failure = str(error.__cause__)
            slow = monotonic() - started >= SLOW_SEND
            if __warningregistry__:
                __warningregistry__.clear()
                failure = failure or NOT_MATCHED
        if failure is not None:
            self._fail(header, failure)
        if slow:
            self._check_visible(header)
        elif unreached is not None:
            self._unreached.pop(unreached, None)

    def clients(self) -> frozenset[Hashable]:
        """Identify the clients that the graph shows, by the GUIDs of their response readers.

        Raises:
            ContextShutdown: the node is down.
        """
        with uses_node(self._node):
            readers = response_readers(self._node, self._srv_name)
            return frozenset(gid_of(reader) for reader in readers)

    def has_clients(self) -> bool:
        """Return whether the graph shows a client.

        Raises:
            ContextShutdown: the node is down.
        """
        with uses_node(self._node), self._node.handle:
            return bool(self._node.handle.get_count_clients(self._srv_name))

    def delivered(self) -> bool:
        """Return whether every client is known to have received every response.

        Raises:
            PortDestroyed: the service was destroyed.
            ContextShutdown: the node is down.
        """
        try:
            with self._handle:
                return acknowledged(self._handle)
        except RclpyError as error:
            raise explain(self._node, self._handle, error) from error

    def _failure(self, error: Exception) -> Exception:
        if is_destroyed(self._handle):
            return explain(self._node, self._handle, error)
        # Not `Undeliverable`: it is the response that is at fault, not its client.
        return RosasyncError(f"the middleware refuses the response: {reason_of(error)}")

    def _check_visible(self, header: RequestHeader) -> None:
        """Raise if the graph does not show the client: the middleware dropped the response."""
        guid = client_of(header)
        self._graph.refresh(monotonic())
        if not self._graph.identifies(guid) or self._graph.empty:
            return
        if guid not in self._graph.readers:
            self._fail(header, NOT_MATCHED)

    def _fail(self, header: RequestHeader, reason: str) -> NoReturn:
        """Remember the client and raise the error that says whether to send again."""
        now = monotonic()
        self._watch_until = now + WATCH_TIME
        self._watching = True
        guid = client_of(header)
        self._graph.refresh(now)
        if not self._graph.identifies(guid):
            raise Unmatched(reason)
        known = self._unreached.get(guid)
        if known is None:
            self._unreached[guid] = Unreached()
            for oldest in tuple(self._unreached)[:-MOST_UNREACHED]:
                self._unreached.pop(oldest, None)
        else:
            known.failures += 1
            known.due = None
        self._check_qos(guid)
        raise Unmatched(reason)

    def _check(self, header: RequestHeader) -> bytes | None:
        """Raise if a send to this client would block.

        Returns:
            The client, if an earlier send has not reached it.
        """
        now = monotonic()
        watching = now < self._watch_until
        if not watching and not self._unreached:
            self._watching = False
            return None
        guid = client_of(header)
        if not watching and guid not in self._unreached:
            return None
        self._refresh(now)
        if self._graph.identifies(guid):
            self._check_client(guid, now)
        else:
            self._check_all()
        return guid if guid in self._unreached else None

    def _check_all(self) -> None:
        """Raise if the graph shows any client that a send might wait for."""
        if self._graph.half_known() or any(map(self._check_reader, self._graph.readers.values())):
            raise Unmatched("a client of the service is not matched")

    def _check_client(self, guid: bytes, now: float) -> None:
        if self._graph.empty:
            return
        self._check_qos(guid)
        if guid not in self._graph.readers:
            if self._graph.has_process(guid):
                raise Unmatched("the client is not discovered completely")
            return  # It has left, and the middleware drops the response without waiting.
        known = self._unreached.get(guid)
        if known is None:
            return
        if known.failures == len(MATCH_DELAYS):
            raise Undeliverable("the client is visible, but the middleware does not match it")
        if known.due is None:
            known.due = now + MATCH_DELAYS[known.failures]
        if now < known.due:
            raise Unmatched("the client was discovered just now")

    def _check_qos(self, guid: bytes) -> None:
        reader = self._graph.readers.get(guid)
        reason = None if reader is None else self._check_reader(reader)
        if reason is not None:
            raise Undeliverable(f"the QoS of the client does not match the server's: {reason}")

    def _check_reader(self, reader: QoSProfile) -> str | None:
        return incompatibility(self._qos, reader)

    def _refresh(self, now: float) -> None:
        """Query the graph if it is time, and forget the clients that have left it."""
        if self._graph.refresh(now):
            for guid in tuple(self._unreached):
                if not self._graph.has_process(guid):
                    self._unreached.pop(guid, None)


def client_of(header: RequestHeader) -> bytes | None:
    """Return the GUID of the response reader of the client that sent a request.

    rclpy does not show it, so it is read from the C structure behind the header: a pybind11 object
    holds the address of that structure right behind the head that every object has. What is read
    counts only if the other fields agree with the header's attributes.
    """
    kind = type(header)
    if kind.__name__ != "rmw_service_info_t" or kind.__basicsize__ <= object.__basicsize__:
        return None
    address = ctypes.c_void_p.from_address(id(header) + object.__basicsize__).value
    if not address:
        return None
    sent, received, guid, number = INFO.unpack(ctypes.string_at(address, INFO.size))
    expected = (
        header.source_timestamp,
        header.received_timestamp,
        header.request_id.sequence_number,
    )
    return bytes(guid) if (sent, received, number) == expected else None
