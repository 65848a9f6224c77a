"""Recording: the calls of a session, or of other nodes, saved as YAML and replayed by a stub."""

from __future__ import annotations

import asyncio
import logging
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Hashable, Iterable
from contextlib import ExitStack, asynccontextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rosasync._core.safe_yaml import YamlError, load, read_bytes
from rosasync._core.text import count
from rosasync._ros.messages import to_dict, to_message
from rosasync._ros.types import service_type, type_name
from rosasync.testing._hooks import GraphSession, Hooks

if TYPE_CHECKING:
    from rosasync._core.ports import ClientPort, Deliver, Service
    from rosasync.session import Session
    from rosasync.testing._hooks import OpenClient

__all__ = ["RecordedCall", "Recording"]

logger = logging.getLogger("rosasync")

FORMAT = 1
"""The version of the files."""
REQUESTS = (0, 1)
"""The ``event_type`` of events that carry requests: sent, received."""
PREFIX = 12
"""Bytes of an RTPS id that identify the participant."""


@dataclass
class RecordedCall:
    """A call and its response, as plain values.

    Attributes:
        srv_name: the resolved name of the service.
        srv_type: the name of its type.
        request: the fields of the request.
        response: the fields of the response; None if it was not answered.
    """

    srv_name: str
    srv_type: str
    request: dict[str, Any]
    response: dict[str, Any] | None = None


class Recording:
    """Calls and their responses, in the order of the calls.

    Record the calls of a session with `session`, or those of other nodes with `listen`. Replay them
    with `Graph.replay`.

    Attributes:
        calls: the recorded calls.
    """

    def __init__(self, calls: Iterable[RecordedCall] = ()) -> None:
        self.calls: list[RecordedCall] = list(calls)

    def __repr__(self) -> str:
        return f"<Recording {count(len(self.calls), 'call')}>"

    # Recording.

    def session(self, node: Any = "rosasync", **options: Any) -> Session:
        """Create a session on real ROS that records its calls.

        For a session in memory, see `Graph.session`.

        Args:
            node: as for `rosasync.Session`.
            options: those of `rosasync.Session`.
        """
        return GraphSession(Hooks(wrap_client=self.wrap_client), None, node, **options)

    @asynccontextmanager
    async def listen(
        self, session: Session, *services: tuple[type[Any] | str, str]
    ) -> AsyncIterator[Self]:
        """Record the calls of other nodes in this block, by their introspection events.

        Clients or servers of these services must publish the contents of their calls: those of a
        ``Session(introspection="contents")``, or those for which ``configure_introspection`` was
        called. Calls before the events are discovered are missing.

        Args:
            session: an open session on real ROS.
            services: the type and the name of each service.
        """
        # Only now, because a graph in memory needs no rclpy.
        from rosasync._ros.inspect import subscribe

        loop = asyncio.get_running_loop()
        node = session.node
        with ExitStack() as subscriptions:
            for srv_type, srv_name in services:
                kind = service_type(srv_type)
                listener = _Listener(self, type_name(kind), node.resolve_service_name(srv_name))
                topic = f"{listener.srv_name}/_service_event"
                post = partial(_post, loop, listener.take)
                subscriptions.callback(subscribe(node, kind.Event, topic, post))
            yield self

    def wrap_client(self, opener: OpenClient, service: Service, deliver: Deliver) -> ClientPort:
        """Open a client that records its calls."""
        return _RecordingClient(opener, service, deliver, self)

    # Files.

    def save(self, path: str | Path) -> None:
        """Write the calls to a YAML file.

        Raises:
            ImportError: PyYAML is not installed.
            OSError: the file cannot be written.
        """
        import yaml

        content = {"rosasync-recording": FORMAT, "calls": [asdict(call) for call in self.calls]}
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        Path(path).write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file that `save` has written, or that was written by hand.

        Raises:
            ImportError: PyYAML is not installed.
            OSError: the file cannot be read.
            ValueError: it is not a recording, is larger than 64 MiB, or a field does not fit the
                type of its service.
            TypeError: a field's value is of the wrong kind.
        """
        try:
            content = load(read_bytes(path))
        except YamlError as error:
            raise ValueError(f"{path}: {error}") from None
        if not isinstance(content, dict) or content.get("rosasync-recording") != FORMAT:
            raise ValueError(f"{path} is not a recording of format {FORMAT}")
        calls = content.get("calls") or []
        if not isinstance(calls, list):
            raise ValueError(f"{path}: {calls!r} is not a list of calls")
        return cls(_checked(path, entry) for entry in calls)


def _post(loop: asyncio.AbstractEventLoop, take: Callable[[Any], None], event: Any) -> None:
    """Pass an event from the executor's thread to the loop's."""
    loop.call_soon_threadsafe(take, event)


def _checked(path: str | Path, entry: Any) -> RecordedCall:
    try:
        call = RecordedCall(**entry)
    except TypeError as error:
        raise ValueError(f"{path}: {entry!r} is not a recorded call: {error}") from None
    kind = service_type(call.srv_type)
    to_message(kind.Request, call.request)
    if call.response is not None:
        to_message(kind.Response, call.response)
    return call


class _RecordingClient:
    """A client port that records: a `rosasync._core.ports.ClientPort`."""

    def __init__(
        self, opener: OpenClient, service: Service, deliver: Deliver, recording: Recording
    ) -> None:
        self._service = service
        self._deliver = deliver
        self._recording = recording
        self._unanswered: dict[int, RecordedCall] = {}
        self._port = opener(service, self._answered)

    @property
    def identity(self) -> Hashable:
        """What servers know the client by."""
        return self._port.identity

    def send(self, request: Any) -> int:
        """Send a request and record it."""
        name, kind, _ = self._service.key
        call = RecordedCall(name, kind, to_dict(request))
        number = self._port.send(request)
        self._unanswered[number] = call
        self._recording.calls.append(call)
        return number

    def forget(self, sequence_number: int) -> None:
        """Stop expecting a response to this request."""
        self._unanswered.pop(sequence_number, None)
        self._port.forget(sequence_number)

    def ready(self) -> bool:
        """Return whether a server is matched."""
        return self._port.ready()

    def close(self) -> None:
        """Destroy the client; idempotent."""
        self._port.close()

    def _answered(self, sequence_number: int, response: Any) -> None:
        if (call := self._unanswered.pop(sequence_number, None)) is not None:
            call.response = to_dict(response)
        self._deliver(sequence_number, response)


class _Listener:
    """Records the introspection events of one service. Confined to the loop's thread.

    If both sides publish, each call is seen twice: the first event of a kind counts.
    """

    def __init__(self, recording: Recording, srv_type: str, srv_name: str) -> None:
        self.srv_name = srv_name
        self._srv_type = srv_type
        self._recording = recording
        self._calls: dict[tuple[bytes, int], RecordedCall] = {}
        # By participant and sequence number: calls that one side has reported, and how it calls
        # the client.
        self._one_sided: defaultdict[tuple[bytes, int], list[tuple[int, RecordedCall]]]
        self._one_sided = defaultdict(list)
        # Whether the warning about events without contents was logged.
        self._warned = False

    def take(self, event: Any) -> None:
        """Record an event."""
        contents = [*event.request, *event.response]
        if not contents:
            self._warn()
            return
        key = bytes(bytearray(event.info.client_gid)), int(event.info.sequence_number)
        fields = to_dict(contents[0])
        call = self._calls.get(key)
        if event.info.event_type in REQUESTS:
            if call is None:
                self._calls[key] = self._reported_before(key, fields) or self._add(key, fields)
        elif call is not None and call.response is None:
            call.response = fields

    def _add(self, key: tuple[bytes, int], request: dict[str, Any]) -> RecordedCall:
        client, number = key
        call = RecordedCall(self.srv_name, self._srv_type, request)
        self._one_sided[client[:PREFIX], number].append((client[-1], call))
        self._recording.calls.append(call)
        return call

    def _reported_before(
        self, key: tuple[bytes, int], request: dict[str, Any]
    ) -> RecordedCall | None:
        """Return the call if the other side has reported it under another id of the client.

        On Jazzy, the client gives the id of its request writer, the server that of the client's
        response reader. They have the participant in common, and differ in the kind of the entity,
        the last byte.
        """
        client, number = key
        reported = self._one_sided[client[:PREFIX], number]
        for entry in reported:
            kind, call = entry
            if kind != client[-1] and call.request == request:
                reported.remove(entry)
                return call
        return None

    def _warn(self) -> None:
        if not self._warned:
            self._warned = True
            logger.warning(
                "%s: its introspection events have no contents, so they cannot be recorded: use "
                'introspection="contents"',
                self.srv_name,
            )


if TYPE_CHECKING:

    def _fits(client: _RecordingClient) -> ClientPort:
        return client
