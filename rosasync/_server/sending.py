"""The sending of a server's responses, from any thread."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from copy import deepcopy
from time import monotonic
from typing import TYPE_CHECKING, Any, Generic

from rosasync._core.ports import PortDestroyed, Undeliverable, Unmatched
from rosasync._server.counts import CallCounts
from rosasync._server.resending import Resender, Unsent
from rosasync.errors import ContextShutdown, UsageError
from rosasync.typing import ResponseT

if TYPE_CHECKING:
    from rosasync._core.ports import RequestHeader, ServicePort
    from rosasync._server.handler_tasks import Spawn
    from rosasync.tracing import ServerTrace

__all__ = ["COLLECTED", "ResponseSender", "service_destroyed"]

logger = logging.getLogger("rosasync")

DELIVERY_TIME = 0.5
"""Maximum number of seconds between a response and the end of its service that it delays, beside
the time after which the middleware repairs a lost packet (20 ms, or 3 s by its own default)."""
DELIVERY_INTERVAL = 0.01
"""Seconds between two queries whether the last responses were received."""

COLLECTED = (
    "a call was dropped unanswered, so its client gets no response: keep the call, and call its "
    "respond() once"
)
"""What is wrong with a call that is garbage-collected unanswered."""


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
        from_mapping: Callable[[Mapping[str, Any]], ResponseT],
        port: ServicePort,
        counts: CallCounts,
        spawn: Spawn,
        on_destroyed: Callable[[], None],
    ) -> None:
        self.name = name
        self.response_type = response_type
        self.lock = threading.RLock()
        self._warned = False
        self.ending: Callable[[], Exception] | None = None
        self._type_name = type_name
        self._from_mapping = from_mapping
        self._port = port
        self._counts = counts
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._resender = Resender(
            self._send_again,
            lambda unsent, reason: self._give_up(unsent.header, unsent.trace, reason),
            lambda: self.ending is not None,
            spawn,
        )
        self._on_destroyed = on_destroyed
        self._last_sent = -math.inf
        self._idle = threading.Condition(self.lock)
        self._sending = 0

    def client_of(self, header: RequestHeader) -> Hashable:
        """Return the identity of the client that sent a request; None if it is unknown."""
        return self._port.client_of(header)

    def is_waiting(self, header: RequestHeader) -> bool:
        """Return whether the response to a request waits to be sent again."""
        return self._resender.has(header)

    @property
    def age(self) -> float:
        """The seconds since the last response was sent; infinite if there was none."""
        return monotonic() - self._last_sent

    def check_open(self) -> None:
        """Raise the error for later responses, if there is one."""
        if self.ending is not None:
            raise self.ending()

    def make_response(self, response: ResponseT | Mapping[str, Any]) -> ResponseT:
        """Return the response to send, from a message or a mapping of its fields.

        Raises:
            TypeError, ValueError: it is something else, or a field does not fit.
        """
        if isinstance(response, self.response_type):
            return response
        if isinstance(response, Mapping):
            return self._from_mapping(response)
        raise TypeError(
            f"{self.name}: a response of {self._type_name} is a {_name_of(self.response_type)}, or "
            f"a mapping of its fields, not a {_name_of(type(response))}"
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
        header: RequestHeader,
        response: ResponseT,
        trace: ServerTrace | None,
        *,
        late: bool,
    ) -> None:
        """Send a response, or have it sent again later. Call `begin` first.

        Args:
            header: the header of its request.
            response: the response.
            trace: the trace of the call.
            late: whether the client may have left since it sent the request.

        Raises:
            ContextShutdown: the rclpy service was destroyed.
            Exception: the response was not sent, because it cannot be converted or the middleware
                refuses it.
        """
        if self._try(header, response, trace, late):
            return
        unsent = Unsent(header, deepcopy(response), trace)
        try:
            if threading.get_ident() == self._thread:
                self._resender.add(unsent)
            else:
                self._loop.call_soon_threadsafe(self._resender.add, unsent)
        except RuntimeError:
            self._give_up(header, trace, "the event loop is closed")

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
        are older than `DELIVERY_TIME` and a repair are not waited for: their clients may have been
        killed.

        Args:
            timeout: maximum number of seconds to wait.
        """
        longest = DELIVERY_TIME + self._port.repair_time
        until = min(self._last_sent + longest, monotonic() + timeout)
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

    def _send_again(self, unsent: Unsent) -> bool:
        """Send a response that could not be sent before.

        Returns:
            False if its client cannot get it yet.

        Raises:
            SessionClosed, ContextShutdown: the server has ended.
        """
        with self.lock:
            self.begin()
        return self._try(unsent.header, unsent.response, unsent.trace, late=True)

    def _give_up(self, header: RequestHeader, trace: ServerTrace | None, reason: object) -> None:
        """Count and log a response that cannot be delivered."""
        with self.lock:
            self._counts.undeliverable += 1
        logger.warning(
            "%s: the response to request #%d cannot be delivered: %s",
            self.name,
            header.request_id.sequence_number,
            reason,
        )
        if trace is not None:
            trace.end("undeliverable")

    def _is_undelivered(self) -> bool:
        """Return whether a client may not have received the last responses yet."""
        return self._port.has_clients() and not self._port.delivered()

    def _count_dropped(self, trace: ServerTrace | None) -> None:
        with self.lock:
            # Otherwise `close` has counted the call.
            if self.ending is None:
                self._counts.dropped += 1
        if not self._warned:
            # Python hides the ResourceWarning, unless it is asked for it.
            self._warned = True
            logger.warning("%s: %s. This is reported once for each server", self.name, COLLECTED)
        if trace is not None:
            trace.end_unanswered()

    def _try(
        self,
        header: RequestHeader,
        response: ResponseT,
        trace: ServerTrace | None,
        late: bool,
    ) -> bool:
        """Send a response; return False if its client cannot get it yet.

        Only what was sent is counted as answered. Every other exception than those below goes to
        the caller, whose response is at fault.
        """
        sent = False
        try:
            self._port.send(header, response)
            if late and not self._port.has_clients():
                raise Undeliverable("the service has no client any more")
            sent = True
            # Before `_sending` is counted down, so that `close` finds the trace ended.
            if trace is not None:
                trace.end("answered")
        except Unmatched:
            return False
        except Undeliverable as error:
            self._give_up(header, trace, error)
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


def service_destroyed(name: str) -> ContextShutdown:
    """Return the error for a service that something other than rosasync has destroyed."""
    return ContextShutdown(f"{name}: the rclpy service was destroyed under the server")


def _name_of(kind: type) -> str:
    """Return the name by which a class is imported, without the private modules of a message."""
    parts = [part for part in kind.__module__.split(".") if not part.startswith("_")]
    return ".".join([*(part for part in parts if part != "builtins"), kind.__qualname__])
