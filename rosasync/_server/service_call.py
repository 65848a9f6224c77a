"""ServiceCall: one request to a server, and the sending of its response."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import warnings
from collections.abc import Callable, Coroutine
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass
from time import monotonic, monotonic_ns
from typing import TYPE_CHECKING, Any, Generic

from rosasync._core.ports import PortDestroyed, Undeliverable, Unmatched
from rosasync.errors import ContextShutdown, UsageError
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from rosasync._core.ports import RequestHeader, ServicePort
    from rosasync._server.server import ServiceServer
    from rosasync.tracing import ServerTrace

__all__ = ["CallCounts", "RequestInfo", "ResponseSender", "ServiceCall", "service_destroyed"]

logger = logging.getLogger("rosasync")

RESEND = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 1.6, 1.6, 1.6, 1.6)
"""Seconds to wait before each further attempt to send a response to a client that the middleware
has not discovered completely."""
MAX_UNSENT = 1000
"""Maximum number of responses of a server that wait to be sent again."""
DELIVERY_TIME = 0.5
"""Maximum number of seconds between a response and the end of its service that it delays. Repairs
of lost packets take several of the middleware's heartbeats (20 ms, or 3 s by its own default)."""
DELIVERY_INTERVAL = 0.01
"""Seconds between two queries whether the last responses were received."""
LATE = 100_000_000
"""Nanoseconds after which the graph is checked for a client, because it may have left."""

_ANSWERED = "answered"


@dataclass(frozen=True, slots=True)
class RequestInfo:
    """What the middleware reports about a request.

    Attributes:
        sequence_number: counts the requests of one client; two clients may use the same.
        source_timestamp: when it was sent, in ns of the system clock; None if unknown.
        received_timestamp: when it arrived, in ns; None if unknown.
    """

    sequence_number: int
    source_timestamp: int | None
    received_timestamp: int | None


class ServiceCall(Generic[RequestT, ResponseT]):
    """One request, to be answered once.

    Keep it to respond later, in any order, from any task or thread. A call that is dropped
    unanswered is a ``ResourceWarning``.

    Attributes:
        request: the request message.
        server: the server that took it.
    """

    __slots__ = (
        "__weakref__",
        "_header",
        "_outcome",
        "_received",
        "_response",
        "_sender",
        "request",
        "server",
        "trace",
    )

    def __init__(
        self,
        server: ServiceServer[RequestT, ResponseT],
        request: RequestT,
        header: RequestHeader,
        sender: ResponseSender[ResponseT],
        received: int,
        trace: ServerTrace | None,
    ) -> None:
        self.server = server
        self.request = request
        self._header = header
        self._sender = sender
        self._response: ResponseT | None = None
        # None until the call is settled; changed under the sender's lock.
        self._outcome: str | None = None
        self._received = received
        # For the server and its sender, which report what happens to the call.
        self.trace = trace

    def __repr__(self) -> str:
        number = self._header.request_id.sequence_number
        return f"<ServiceCall {self._sender.name} #{number} {self._outcome or 'unanswered'}>"

    def __del__(self) -> None:
        if self._outcome is None and self._sender.count_collected(self.trace):
            warnings.warn(
                f"{self._sender.name}: a call was dropped unanswered, so its client waits in vain: "
                "keep the call, and call its respond() once",
                ResourceWarning,
                source=self,
                stacklevel=2,
            )

    @property
    def info(self) -> RequestInfo:
        """The sequence number and the timestamps."""
        header = self._header
        return RequestInfo(
            header.request_id.sequence_number,
            _timestamp(header.source_timestamp),
            _timestamp(header.received_timestamp),
        )

    @property
    def response(self) -> ResponseT:
        """A response to fill. It is created at the first access, and the same one afterwards."""
        if self._response is None:
            self._response = self._sender.response_type()
        return self._response

    @property
    def responded(self) -> bool:
        """Whether it has been answered."""
        return self._outcome == _ANSWERED

    @property
    def settled(self) -> bool:
        """Whether it has been answered or given up."""
        return self._outcome is not None

    def respond(self, response: ResponseT) -> None:
        """Convert the response and send it, at once and in the calling thread.

        From any thread. The message may be changed or reused afterwards. If the client is gone, the
        response is logged and counted as undeliverable, and no error is raised.

        Args:
            response: a message of the service's response type.

        Raises:
            TypeError: it is something else; the call can still be answered.
            UsageError: the call was answered before, or given up because its handler failed.
            SessionClosed, ContextShutdown: the server has ended.
        """
        sender = self._sender
        sender.check_type(response)
        with sender.lock:
            sender.begin(self._outcome)
            self._outcome = _ANSWERED
        try:
            late = monotonic_ns() - self._received > LATE
            sender.send(self, self._header, response, late=late)
        except BaseException:
            self._outcome = None
            raise

    def give_up(self, reason: str, *, failed: bool = False) -> bool:
        """Leave the request unanswered for good. From any thread.

        Args:
            reason: the outcome for the error of a later `respond`, such as "dropped: …".
            failed: whether its handler failed. If not, the call is counted as dropped.

        Returns:
            Whether this settled the call. False if it is settled already, or the server has ended.
        """
        sender = self._sender
        with sender.lock:
            if self._outcome is not None or sender.ending is not None:
                return False
            self._outcome = reason
            sender.count_unanswered(failed=failed)
        if self.trace is not None:
            self.trace.end_unanswered()
        return True


@dataclass(slots=True)
class CallCounts:
    """What has happened to the calls of a server.

    The first four are changed on the loop's thread, the others under the sender's lock.
    """

    taken: int = 0
    rejected: int = 0
    deferred: int = 0
    failed: int = 0
    responded: int = 0
    undeliverable: int = 0
    dropped: int = 0
    failed_unanswered: int = 0

    @property
    def unanswered(self) -> int:
        """How many calls are neither answered nor given up."""
        settled = self.responded + self.undeliverable + self.dropped + self.failed_unanswered
        return self.taken - settled


class ResponseSender(Generic[ResponseT]):
    """Sends the responses of a server, from any thread, and ends between two sends.

    Attributes:
        name: the resolved service name.
        response_type: the class of the responses.
        lock: protects the outcome of every call, and the state here. Held for a few assignments,
            never across a send. Reentrant, because the garbage collector may run any ``__del__``
            under it.
        ending: creates the error for later responses, once there is one.
    """

    def __init__(
        self,
        name: str,
        type_name: str,
        response_type: type[ResponseT],
        port: ServicePort,
        counts: CallCounts,
        spawn: Callable[[Coroutine[Any, Any, None]], None],
        on_destroyed: Callable[[], None],
    ) -> None:
        self.name = name
        self.response_type = response_type
        self.lock = threading.RLock()
        self.ending: Callable[[], Exception] | None = None
        self._type_name = type_name
        self._port = port
        self._counts = counts
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._resender = Resender(self, spawn)
        self._on_destroyed = on_destroyed
        self._last_sent = -math.inf
        self._idle = threading.Condition(self.lock)
        self._sending = 0

    def check_open(self) -> None:
        """Raise the error for later responses, if there is one."""
        if self.ending is not None:
            raise self.ending()

    def check_type(self, response: ResponseT) -> None:
        """Raise `TypeError` unless this is a response of the service."""
        if not isinstance(response, self.response_type):
            raise TypeError(
                f"{self.name}: a response of {self._type_name} is a "
                f"{_name_of(self.response_type)}, not a {_name_of(type(response))}"
            )

    def begin(self, outcome: str | None = None) -> None:
        """Announce a `send`, under the lock: `close` waits for it.

        Raises:
            UsageError: the call has an outcome already.
            SessionClosed, ContextShutdown: the server has ended.
        """
        if self.ending is not None:
            raise self.ending()
        if outcome is not None:
            raise UsageError(f"{self.name}: this call was {outcome}")
        self._sending += 1

    def send(
        self,
        call: ServiceCall[Any, ResponseT],
        header: RequestHeader,
        response: ResponseT,
        *,
        late: bool,
    ) -> None:
        """Send the response of a call, or have it sent again later. Call `begin` first.

        Args:
            call: the call.
            header: the header of its request.
            response: the response.
            late: whether the client may have left since it sent the request.

        Raises:
            ContextShutdown: the rclpy service was destroyed.
        """
        if self._try(call, header, response, late):
            return
        unsent = _Unsent(call, header, deepcopy(response))
        try:
            if threading.get_ident() == self._thread:
                self._resender.add(unsent)
            else:
                self._loop.call_soon_threadsafe(self._resender.add, unsent)
        except RuntimeError:
            self.give_up(call, "the event loop is closed")

    def send_again(
        self, call: ServiceCall[Any, ResponseT], header: RequestHeader, response: ResponseT
    ) -> bool:
        """Send a response that could not be sent before.

        Returns:
            False if its client cannot get it yet.

        Raises:
            SessionClosed, ContextShutdown: the server has ended.
        """
        with self.lock:
            self.begin()
        return self._try(call, header, response, late=True)

    def give_up(self, call: ServiceCall[Any, ResponseT], reason: object) -> None:
        """Count and log a response that cannot be delivered."""
        with self.lock:
            self._counts.undeliverable += 1
        logger.warning("%s: the response to %r cannot be delivered: %s", self.name, call, reason)
        if call.trace is not None:
            call.trace.end("undeliverable")

    def count_unanswered(self, *, failed: bool) -> None:
        """Count a call that was given up. Call it under the lock."""
        if failed:
            self._counts.failed_unanswered += 1
        else:
            self._counts.dropped += 1

    def count_collected(self, trace: ServerTrace | None) -> bool:
        """Count a call that was garbage-collected unanswered, in a later turn of the loop.

        Args:
            trace: the trace of the call.

        Returns:
            False if the server or the loop has ended, so that there is nothing to warn of.
        """
        # Takes no lock: the garbage collector may run this in a thread that holds one.
        if self.ending is not None:
            return False
        try:
            self._loop.call_soon_threadsafe(self._count_dropped, trace)
        except RuntimeError:
            return False
        return True

    async def wait_until_delivered(self, timeout: float) -> None:
        """Wait until the clients have received the last responses, or may be expected to have.

        The middleware drops what is not received yet when its service is destroyed. Responses that
        are older than `DELIVERY_TIME` are not waited for: their clients may have been killed.

        Args:
            timeout: maximum number of seconds to wait.
        """
        until = min(self._last_sent + DELIVERY_TIME, monotonic() + timeout)
        with suppress(ContextShutdown, PortDestroyed):
            while monotonic() < until and self._is_undelivered():  # noqa: ASYNC110
                await asyncio.sleep(DELIVERY_INTERVAL)

    def shut(self, ending: Callable[[], Exception]) -> None:
        """Refuse further responses; the first ``ending`` stays."""
        with self.lock:
            if self.ending is None:
                self.ending = ending

    def close(self, ending: Callable[[], Exception]) -> None:
        """Refuse further responses, and wait for those being sent; blocks that long.

        Calls that are unanswered then are counted as dropped.
        """
        self.shut(ending)
        with self.lock:
            self._idle.wait_for(lambda: not self._sending)
            self._counts.dropped += self._counts.unanswered

    def _is_undelivered(self) -> bool:
        """Return whether a client may not have received the last responses yet."""
        return self._port.has_clients() and not self._port.delivered()

    def _count_dropped(self, trace: ServerTrace | None) -> None:
        with self.lock:
            # Otherwise `close` has counted the call.
            if self.ending is None:
                self._counts.dropped += 1
        if trace is not None:
            trace.end_unanswered()

    def _try(
        self,
        call: ServiceCall[Any, ResponseT],
        header: RequestHeader,
        response: ResponseT,
        late: bool,
    ) -> bool:
        sent = False
        try:
            self._port.send(header, response)
            if late and not self._port.has_clients():
                raise Undeliverable("the service has no client any more")
            sent = True
            # Before `_sending` is counted down, so that `close` finds the trace ended.
            if call.trace is not None:
                call.trace.end("answered")
        except Unmatched:
            return False
        except Undeliverable as error:
            self.give_up(call, error)
        except PortDestroyed as error:
            # Now, not in the later turn that ends the server: the error that is raised below must
            # not count as a failure of the handler.
            self.shut(lambda: service_destroyed(self.name))
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._on_destroyed)
            raise service_destroyed(self.name) from error
        finally:
            with self.lock:
                if sent:
                    self._counts.responded += 1
                    self._last_sent = monotonic()
                self._sending -= 1
                if self.ending is not None:
                    self._idle.notify_all()
        return True


@dataclass(slots=True, eq=False)
class _Unsent:
    """A response that its client could not get yet."""

    call: ServiceCall[Any, Any]
    header: RequestHeader
    response: Any
    attempts: int = 0
    due: float = 0.0


class Resender:
    """Repeats responses whose clients the middleware has not discovered completely.

    Confined to the loop's thread. One task serves all responses of a server, and ends when none is
    left. The delays grow, because an attempt may block the process for 0.1 s.
    """

    def __init__(
        self,
        sender: ResponseSender[Any],
        spawn: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        self._sender = sender
        self._spawn = spawn
        self._loop = asyncio.get_running_loop()
        # In the order of their arrival. The task runs while there are any.
        self._unsent: dict[_Unsent, None] = {}

    def add(self, unsent: _Unsent) -> None:
        """Repeat a response for about ten seconds. Beyond MAX_UNSENT, the oldest is given up.

        Raises:
            RuntimeError: the loop is closed.
        """
        if self._sender.ending is not None:
            return
        idle = not self._unsent
        if len(self._unsent) >= MAX_UNSENT:
            oldest = next(iter(self._unsent))
            del self._unsent[oldest]
            self._sender.give_up(oldest.call, f"{MAX_UNSENT} later ones wait to be sent again")
        unsent.due = self._loop.time() + RESEND[0]
        self._unsent[unsent] = None
        if idle:
            self._spawn(self._run())

    async def _run(self) -> None:
        try:
            while self._unsent:
                # The shortest delay, because a response that is added now is due after it.
                await asyncio.sleep(RESEND[0])
                now = self._loop.time()
                for unsent in [unsent for unsent in self._unsent if unsent.due <= now]:
                    if unsent in self._unsent and not self._settle(unsent):
                        return
                    await asyncio.sleep(0)
        finally:
            self._unsent.clear()

    def _settle(self, unsent: _Unsent) -> bool:
        """Try once more to send a response; return whether the server is still open."""
        sender = self._sender
        if sender.ending is not None:
            return False
        unsent.attempts += 1
        try:
            sent = sender.send_again(unsent.call, unsent.header, unsent.response)
        except Exception as error:
            sent = True
            if sender.ending is not None:
                return False
            sender.give_up(unsent.call, error)
        if not sent and unsent.attempts < len(RESEND):
            unsent.due = self._loop.time() + RESEND[unsent.attempts]
            return True
        del self._unsent[unsent]
        if not sent:
            sender.give_up(unsent.call, "its client was not discovered in time")
        return True


def service_destroyed(name: str) -> ContextShutdown:
    """Return the error for a service that something other than rosasync has destroyed."""
    return ContextShutdown(f"{name}: the rclpy service was destroyed under the server")


def _timestamp(nanoseconds: int) -> int | None:
    return nanoseconds if nanoseconds > 0 else None


def _name_of(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
