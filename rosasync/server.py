"""ServiceServer and ServiceCall: handlers, limits, deferred responses."""

from __future__ import annotations

import asyncio
import functools
import inspect
import logging
import threading
import warnings
from collections import deque
from collections.abc import Awaitable, Callable
from copy import deepcopy
from dataclasses import dataclass
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeAlias

from rosasync.aio import until_done
from rosasync.errors import ContextShutdown, SessionClosed, UsageError
from rosasync.options import check_count, check_timeout
from rosasync.ports import Undeliverable, Unmatched
from rosasync.statistics import ServerStatistics

if TYPE_CHECKING:
    from rosasync.ports import NodePort, RequestHeader, ServicePort

__all__ = ["Handler", "RequestInfo", "ServiceCall", "ServiceServer"]

Handler: TypeAlias = Callable[..., Any]
"""``handler(request, response)`` or ``handler(call)``, plain or async."""

logger = logging.getLogger("rosasync")

ENDING = 5.0
"""Seconds for handlers to finish when a server is closed."""
LAST_STEPS = 1.0
"""Seconds for a cancelled handler to end, before it is left behind."""
RESEND = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 1.6, 1.6, 1.6, 1.6)
"""Seconds to wait before each further attempt to send a response to a client that was just made."""
LATE = 0.1
"""Seconds from which on a response may find its client gone, so that the graph is asked."""

_ENDED = (SessionClosed, ContextShutdown)


@dataclass(frozen=True, slots=True)
class RequestInfo:
    """What the middleware tells of a request.

    Attributes:
        sequence_number: counts the requests of one client; two clients may use the same.
        source_timestamp: when it was sent, in ns of the system clock; None where it is not given.
        received_timestamp: when it arrived, in ns; None where it is not given.
    """

    sequence_number: int
    source_timestamp: int | None
    received_timestamp: int | None


class ServiceCall:
    """One request, and the means to answer it, once.

    It may be kept, and answered later, in any order, by any task or thread. One that is dropped
    unanswered is a ``ResourceWarning``.

    Attributes:
        request: the request message.
        server: the server it came to.
    """

    __slots__ = ("__weakref__", "_header", "_outcome", "_response", "_since", "request", "server")

    def __init__(self, server: ServiceServer, request: Any, header: RequestHeader) -> None:
        self.server = server
        self.request = request
        self._header = header
        self._response: Any = None
        self._outcome: str | None = None
        self._since = monotonic()

    def __repr__(self) -> str:
        number = self._header.request_id.sequence_number
        return f"<ServiceCall {self.server.srv_name} #{number} {self._outcome or 'unanswered'}>"

    def __del__(self) -> None:
        if self._outcome is None and self.server._lose():
            warnings.warn(
                f"{self.server.srv_name}: a call was dropped unanswered",
                ResourceWarning,
                source=self,
                stacklevel=2,
            )

    @property
    def info(self) -> RequestInfo:
        """Sequence number and timestamps."""
        header = self._header
        return RequestInfo(
            header.request_id.sequence_number,
            _timestamp(header.source_timestamp),
            _timestamp(header.received_timestamp),
        )

    @property
    def response(self) -> Any:
        """A response to fill: made at the first use, the same one afterwards."""
        if self._response is None:
            self._response = self.server.response_type()
        return self._response

    @property
    def responded(self) -> bool:
        """Whether it has been answered."""
        return self._outcome == "answered"

    def respond(self, response: Any) -> None:
        """Convert the response and send it, at once and in the calling thread.

        From any thread. The message may be changed or used again afterwards. A client that has
        gone is no error: it is logged, and counted as undeliverable.

        Args:
            response: a message of the service's response type.

        Raises:
            TypeError: it is something else; the call can still be answered.
            UsageError: the call was answered before, or given up: its handler failed.
            SessionClosed, ContextShutdown: the server has ended.
        """
        self.server._respond(self, response)


class ServiceServer:
    """Serves a service in the loop; made by `Session.serve`, and ends with the session.

    It takes requests from the moment it is made. As an async context manager it is closed at the
    end of the block; where it has no handler, ``async for call in server:`` gives the calls.

    At most ``concurrency`` handlers run at a time. Up to ``backlog`` requests wait for one, in the
    order in which they came, and are taken out of the middleware meanwhile, so that its queue does
    not overflow. A plain handler is called in the loop and holds it up as long as it runs; an async
    one gets a task.

    Confined to the loop's thread, but for `ServiceCall.respond`: responses are sent from any
    thread, several at once, and the service is destroyed only when none is being sent. For this
    a server has a lock, held for a few assignments, never across a send. Taking requests and
    sending responses in different threads, which rcl forbids to overlap, cannot: rclpy holds the
    GIL in both.
    """

    def __init__(
        self,
        node: NodePort,
        srv_type: Any,
        srv_name: str,
        handler: Handler | None,
        *,
        concurrency: int,
        backlog: int,
        qos: Any,
        on_error: Handler | None,
        on_overload: Handler | None,
        on_end: Callable[[ServiceServer], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        self._invoke: Handler | None = None
        self._may_defer = True
        if handler is not None:
            self._invoke, self._may_defer = _settle_kind(handler)
        self._on_error = _check_callable("on_error", on_error)
        self._on_overload = _check_callable("on_overload", on_overload)
        self._concurrency = check_count("concurrency", concurrency, 1)
        self._most_waiting = check_count("backlog", backlog, 0)
        self._on_end = on_end
        self._backlog: deque[ServiceCall] = deque()
        self._getters: deque[asyncio.Future[ServiceCall | None]] = deque()
        self._tasks: set[asyncio.Task[None]] = set()
        self._closers: set[asyncio.Task[Any]] = set()
        self._running = 0
        self._starting = False
        self._overloaded = False
        self._taking = True
        self._counts = _Counts()
        self._ended: asyncio.Task[None] | None = None
        service = node.describe(srv_type, srv_name, qos)
        self._name, self._type_name, _ = service.key
        self.response_type: type = service.srv_type.Response
        self._port = node.open_service(service, self._on_request)
        self._outlet = _Outlet(self._port)
        self._qos = self._port.qos

    def __repr__(self) -> str:
        counts = f"{self._running} running, {len(self._backlog)} waiting"
        state = "closed" if self.closed else counts
        return f"<ServiceServer {self._name} [{self._type_name}] {state}>"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.aclose()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> ServiceCall:
        """Give the next call. Several tasks may iterate: each call goes to one of them.

        Raises:
            StopAsyncIteration: the server was closed.
            ContextShutdown: the rclpy context was shut down.
            UsageError: the server has a handler.
        """
        if self._invoke is not None:
            raise UsageError(f"{self._name}: the calls go to its handler")
        if self._backlog:
            return self._next_waiting()
        call = await self._get() if self._taking else None
        if call is not None:
            return call
        ending = self._outlet.ending
        if ending is not None and not isinstance(error := ending(), SessionClosed):
            raise error
        raise StopAsyncIteration

    @property
    def srv_name(self) -> str:
        """The resolved service name; a copy, also after the end."""
        return self._name

    @property
    def srv_type(self) -> str:
        """The service type's name."""
        return self._type_name

    @property
    def qos(self) -> Any:
        """The ``QoSProfile`` in use: a snapshot, also after the end."""
        return self._qos

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, or its closing has begun. Never raises."""
        return not self._taking

    @property
    def handle(self) -> Any:
        """The ``rclpy.service.Service``, for what rosasync does not offer.

        Raises:
            SessionClosed, ContextShutdown: it has been destroyed.
        """
        self._outlet.check()
        return self._port.handle

    def statistics(self) -> ServerStatistics:
        """Take a snapshot."""
        counts, outlet = self._counts, self._outlet
        return ServerStatistics(
            srv_name=self._name,
            running=self._running,
            waiting=len(self._backlog),
            unanswered=self._unanswered(),
            taken=counts.taken,
            responded=outlet.responded,
            deferred=counts.deferred,
            failed=counts.failed,
            rejected=counts.rejected,
            dropped=counts.dropped,
            undeliverable=outlet.undeliverable,
        )

    async def aclose(self, timeout: float | None = ENDING) -> None:
        """End the server; idempotent, and not cut short by cancellation.

        It stops taking requests, and lets the handlers finish, those of waiting requests too, for
        ``timeout`` seconds (None: as long as it takes). Then it cancels the rest and destroys the
        service. Calls that are still unanswered stay so.

        Raises:
            UsageError: called from another loop or thread.
        """
        seconds = check_timeout(timeout, None)
        if asyncio._get_running_loop() is not self._loop:
            raise UsageError(f"{self._name}: a server is closed in the loop that serves")
        if self._outlet.ending is not None:
            return
        if self._ended is None:
            self._ended = self._loop.create_task(self._end(seconds))
        task = asyncio.current_task()
        assert task is not None
        self._closers.add(task)
        try:
            await until_done(self._ended)
        finally:
            self._closers.discard(task)

    def end(self, ending: Callable[[], Exception]) -> None:
        """End at once: what is unanswered stays so, and later responses get what ``ending`` makes.

        For the session. On the loop's thread, or where the loop is closed on any; idempotent.
        """
        if self._outlet.ending is not None:
            return
        self._stop_taking()
        self._drop_waiting()
        self._outlet.close(ending)
        self._port.close()
        self._counts.dropped += self._unanswered()
        if not self._loop.is_closed():
            for task in self._tasks - self._closers:
                task.cancel()
        self._on_end(self)

    # Taking requests.

    def _on_request(self, request: Any, header: RequestHeader) -> None:
        if not self._taking:
            return
        self._counts.taken += 1
        call = ServiceCall(self, request, header)
        if self._invoke is None:
            if self._hand_out(call):
                return
        elif self._running < self._concurrency and not self._backlog:
            self._start(call)
            return
        if len(self._backlog) < self._most_waiting:
            self._backlog.append(call)
        else:
            self._overload(call)

    def _next_waiting(self) -> ServiceCall:
        self._overloaded = False
        return self._backlog.popleft()

    def _start_waiting(self) -> None:
        if self._starting:
            return
        self._starting = True
        try:
            while self._backlog and self._running < self._concurrency:
                self._start(self._next_waiting())
        finally:
            self._starting = False

    def _overload(self, call: ServiceCall) -> None:
        self._counts.rejected += 1
        if self._on_overload is None:
            self._drop_overload(call)
            return
        self._consult(call, self._on_overload, (call,), self._drop_overload)

    def _drop_overload(self, call: ServiceCall) -> None:
        if self._give_up(call, "dropped: too many requests were waiting"):
            self._counts.dropped += 1
            if not self._overloaded:
                self._overloaded = True
                logger.warning(
                    "%s: %d requests wait already, and more are dropped unanswered (%d so far)",
                    self._name,
                    len(self._backlog),
                    self._counts.dropped,
                )

    # Iteration.

    def _hand_out(self, call: ServiceCall) -> bool:
        while self._getters:
            getter = self._getters.popleft()
            if not getter.done():
                getter.set_result(call)
                return True
        return False

    async def _get(self) -> ServiceCall | None:
        getter: asyncio.Future[ServiceCall | None] = self._loop.create_future()
        self._getters.append(getter)
        try:
            return await getter
        except asyncio.CancelledError:
            if getter.cancelled():
                self._getters.remove(getter)
            elif (call := getter.result()) is not None and not self._hand_out(call):
                self._backlog.appendleft(call)
            raise

    # Running handlers.

    def _start(self, call: ServiceCall) -> None:
        assert self._invoke is not None
        self._running += 1
        pending: Awaitable[Any] | None = None
        try:
            result = self._invoke(call)
            if result is not None and inspect.isawaitable(result):
                pending = result
            else:
                self._finish(call, result)
        except asyncio.CancelledError:
            self._cancelled(call)
        except Exception as error:
            self._fail(call, error)
        finally:
            if pending is None:
                self._running -= 1
        if pending is not None:
            self._spawn(self._run(call, pending))

    async def _run(self, call: ServiceCall, pending: Awaitable[Any]) -> None:
        try:
            self._finish(call, await pending)
        except asyncio.CancelledError:
            self._cancelled(call)
        except Exception as error:
            self._fail(call, error)
        finally:
            self._running -= 1
            if self._backlog:
                self._start_waiting()

    def _finish(self, call: ServiceCall, result: Any) -> None:
        if result is not None:
            self._respond(call, result)
        elif not self._may_defer:
            raise TypeError("the handler returned None instead of the response")
        elif call._outcome is None:
            self._counts.deferred += 1

    def _spawn(self, coroutine: Any) -> None:
        task = self._loop.create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _fail(self, call: ServiceCall, error: Exception) -> None:
        if isinstance(error, _ENDED) and self._outlet.ending is not None:
            self._cancelled(call)
            return
        self._counts.failed += 1
        logger.error("%s: the handler of %r failed", self._name, call, exc_info=error)
        if self._on_error is None or call._outcome is not None:
            self._fail_unanswered(call)
        else:
            self._consult(call, self._on_error, (call, error), self._fail_unanswered)

    def _fail_unanswered(self, call: ServiceCall) -> None:
        if self._give_up(call, "given up: its handler failed"):
            self._counts.lost += 1

    def _cancelled(self, call: ServiceCall) -> None:
        if self._give_up(call, "given up: its handler was cancelled"):
            self._counts.dropped += 1
        if call._outcome != "answered":
            logger.warning("%s: the handler of %r was cancelled", self._name, call)

    def _consult(
        self,
        call: ServiceCall,
        hook: Handler,
        arguments: tuple[Any, ...],
        otherwise: Callable[[ServiceCall], None],
    ) -> None:
        """Send what a hook returns, now or when it has been awaited; ``otherwise`` without that."""
        try:
            answer = hook(*arguments)
            if answer is not None and inspect.isawaitable(answer):
                self._spawn(self._await_hook(call, answer, otherwise))
                return
            if answer is not None:
                self._respond(call, answer)
        except Exception as error:
            self._hook_failed(error)
        otherwise(call)

    async def _await_hook(
        self, call: ServiceCall, pending: Awaitable[Any], otherwise: Callable[[ServiceCall], None]
    ) -> None:
        try:
            answer = await pending
            if answer is not None:
                self._respond(call, answer)
        except asyncio.CancelledError:
            self._cancelled(call)
        except Exception as error:
            self._hook_failed(error)
        otherwise(call)

    def _hook_failed(self, error: Exception) -> None:
        logger.error("%s: on_error or on_overload failed", self._name, exc_info=error)

    # Answering: from any thread.

    def _respond(self, call: ServiceCall, response: Any) -> None:
        if not isinstance(response, self.response_type):
            raise TypeError(
                f"{self._name}: a response of {self._type_name} is a "
                f"{_name_of(self.response_type)}, not a {_name_of(type(response))}"
            )
        if not self._outlet.send(call, response):
            again = self._resend(call, deepcopy(response))
            self._loop.call_soon_threadsafe(self._spawn, again)

    async def _resend(self, call: ServiceCall, response: Any) -> None:
        """Send again what a client that was just made could not get yet.

        An attempt may block for 0.1 s, where the graph does not show that it would be in vain, and
        the middleware does not tell whose responses are concerned: so the waits are long, later on.
        """
        for delay in RESEND:
            await asyncio.sleep(delay)
            if self._outlet.ending is not None or self._outlet.send_again(call, response):
                return
        self._outlet.give_up(call, "its client was not discovered in time")

    def _give_up(self, call: ServiceCall, outcome: str) -> bool:
        return self._outlet.claim(call, outcome)

    def _lose(self) -> bool:
        """Count a call that was garbage-collected unanswered; False where no answer was possible.

        No lock is taken: the garbage collector may run while this thread holds it.
        """
        if self._outlet.ending is not None or self._loop.is_closed():
            return False
        if threading.get_ident() == self._thread:
            self._counts.dropped += 1
        else:
            self._loop.call_soon_threadsafe(self._counts.drop)
        return True

    def _unanswered(self) -> int:
        counts, outlet = self._counts, self._outlet
        ended = outlet.responded + outlet.undeliverable + counts.dropped + counts.lost
        return counts.taken - ended

    # Ending.

    def _stop_taking(self) -> None:
        self._taking = False
        self._port.stop()
        if not self._loop.is_closed():
            for getter in self._getters:
                if not getter.done():
                    getter.set_result(None)
        self._getters.clear()

    def _drop_waiting(self) -> None:
        if self._backlog:
            logger.warning(
                "%s: closed with %d requests waiting, which are dropped unanswered",
                self._name,
                len(self._backlog),
            )
            for call in self._backlog:
                if self._give_up(call, "dropped: the server was closed"):
                    self._counts.dropped += 1
            self._backlog.clear()

    async def _end(self, timeout: float | None) -> None:
        self._stop_taking()
        if self._invoke is None:
            self._drop_waiting()
        deadline = None if timeout is None else self._loop.time() + timeout
        while tasks := self._tasks - self._closers:
            left = None if deadline is None else deadline - self._loop.time()
            if left is not None and left <= 0:
                break
            await asyncio.wait(tasks, timeout=left, return_when=asyncio.FIRST_COMPLETED)
        self._drop_waiting()
        tasks = self._tasks - self._closers
        for task in tasks:
            task.cancel()
        if tasks:
            _, stubborn = await asyncio.wait(tasks, timeout=LAST_STEPS)
            if stubborn:
                logger.warning(
                    "%s: %d handlers ignore their cancellation and are left behind",
                    self._name,
                    len(stubborn),
                )
        await asyncio.sleep(self._port.destroy_delay)
        self.end(functools.partial(SessionClosed, f"{self._name}: the server is closed"))


class _Outlet:
    """Sends responses, from any thread, and ends between sends.

    The lock is reentrant because the garbage collector may run anybody's code under it.
    """

    def __init__(self, port: ServicePort) -> None:
        self._port = port
        self._lock = threading.RLock()
        self._idle = threading.Condition(self._lock)
        self._sending = 0
        self.ending: Callable[[], Exception] | None = None
        self.responded = 0
        self.undeliverable = 0

    def check(self) -> None:
        """Raise where the server has ended."""
        if self.ending is not None:
            raise self.ending()

    def claim(self, call: ServiceCall, outcome: str) -> bool:
        """Settle what becomes of a call, unless it is settled already."""
        with self._lock:
            if call._outcome is not None or self.ending is not None:
                return False
            call._outcome = outcome
            return True

    def send(self, call: ServiceCall, response: Any) -> bool:
        """Send the one response of a call; see `ServiceCall.respond`.

        Returns:
            False where the client cannot get it yet: to be sent again.
        """
        with self._lock:
            self.check()
            if call._outcome is not None:
                raise UsageError(f"{call.server.srv_name}: this call was {call._outcome}")
            call._outcome = "answered"
            self._sending += 1
        return self._send(call, response)

    def send_again(self, call: ServiceCall, response: Any) -> bool:
        """Send a response that was claimed before; returns as `send`."""
        with self._lock:
            self.check()
            self._sending += 1
        return self._send(call, response)

    def give_up(self, call: ServiceCall, reason: object) -> None:
        """Count a response that reaches nobody."""
        with self._lock:
            self.undeliverable += 1
        logger.warning("%s: the response of %r reaches nobody: %s", call.server, call, reason)

    def close(self, ending: Callable[[], Exception]) -> None:
        """Let no response pass any more, and wait for those being sent; blocks that long."""
        with self._lock:
            self.ending = ending
            self._idle.wait_for(lambda: not self._sending)

    def _send(self, call: ServiceCall, response: Any) -> bool:
        try:
            self._port.send(call._header, response)
            if monotonic() - call._since > LATE and not self._port.has_clients():
                raise Undeliverable("no client of this service is left")
        except Unmatched:
            self._sent(0)
            return False
        except Undeliverable as error:
            self._sent(0)
            self.give_up(call, error)
        except BaseException:
            call._outcome = None
            self._sent(0)
            raise
        else:
            self._sent(1)
        return True

    def _sent(self, responses: int) -> None:
        with self._lock:
            self.responded += responses
            self._sending -= 1
            if self.ending is not None:
                self._idle.notify_all()


@dataclass(slots=True)
class _Counts:
    """What happened, counted on the loop's thread."""

    taken: int = 0
    deferred: int = 0
    failed: int = 0
    rejected: int = 0
    dropped: int = 0
    lost: int = 0

    def drop(self) -> None:
        self.dropped += 1


def _settle_kind(handler: Handler) -> tuple[Handler, bool]:
    """Return what to call with a ``ServiceCall``, and whether it may return None to defer.

    Raises:
        TypeError: it takes neither a call nor request and response.
    """
    if inspect.isclass(handler):
        raise TypeError(f"a handler is a function or a coroutine function, not the class {handler}")
    if not callable(handler):
        raise TypeError(f"a handler must be callable, not {type(handler).__name__}")
    code = handler
    while isinstance(code, functools.partial):
        code = code.func
    for function in (code, type(code).__call__):
        if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
            raise TypeError(f"a handler returns its response, it does not yield: {handler!r}")
    match _required(handler):
        case 1:
            return handler, True
        case 2:
            return lambda call: handler(call.request, call.response), False
    raise TypeError(f"a handler takes (call) or (request, response): {handler!r} does not")


def _required(handler: Handler) -> int | None:
    """Return how many positional arguments it has to get; None where that is not all it needs."""
    try:
        parameters = inspect.signature(handler).parameters.values()
    except ValueError:
        return None
    required = [p for p in parameters if p.default is p.empty]
    if any(p.kind is p.KEYWORD_ONLY for p in required):
        return None
    return sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in required)


def _check_callable(name: str, hook: Handler | None) -> Handler | None:
    if hook is not None and not callable(hook):
        raise TypeError(f"{name} must be callable, not {type(hook).__name__}")
    return hook


def _timestamp(nanoseconds: int) -> int | None:
    return nanoseconds if nanoseconds > 0 else None


def _name_of(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
