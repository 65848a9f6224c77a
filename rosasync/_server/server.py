"""ServiceServer: takes requests, runs handlers for as many as it may, and ends."""

from __future__ import annotations

import asyncio
import functools
import logging
import math
from collections.abc import Callable
from time import monotonic_ns, time_ns
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Literal, Self

from rosasync._core.aio import until_done
from rosasync._core.text import count
from rosasync._server.backlog import Backlog
from rosasync._server.counts import CallCounts
from rosasync._server.handler_tasks import HandlerTasks
from rosasync._server.handlers import (
    ErrorHook,
    Handler,
    HandlerRunner,
    OverloadHook,
    settle_kind,
)
from rosasync._server.intake import Intake
from rosasync._server.overload import OverloadLog
from rosasync._server.sending import ResponseSender, service_destroyed
from rosasync._server.service_call import RequestInfo, ServiceCall
from rosasync._server.starting import HandlerStarter
from rosasync._server.status import ServerStatus, Status, check_status
from rosasync._status.wire import Outcome
from rosasync.errors import SessionClosed, UsageError
from rosasync.options import check_count, check_flag, check_hook, check_timeout
from rosasync.statistics import ServerStatistics
from rosasync.tracing import ServerTracing
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort, RequestHeader
    from rosasync._status.reporter import Reporter
    from rosasync.tracing import Tracing

__all__ = ["Handler", "Order", "RequestInfo", "ServiceCall", "ServiceServer"]

logger = logging.getLogger("rosasync")

Order = Literal["fair", "arrival"]
"""The order of the requests that wait while a server is overloaded."""

CLOSE_TIMEOUT = 5.0
"""Seconds to wait for handlers to finish when a server is closed."""
CANCEL_TIMEOUT = 1.0
"""Seconds to wait for cancelled handlers to end, before they are left behind."""
MOST_WAITED = 60.0
"""Seconds that a request is taken to have waited in the middleware at most."""


class ServiceServer(Generic[RequestT, ResponseT]):
    """Serves a service in the loop; created by `Session.serve`, and ends with the session.

    It takes requests as soon as it is created. As an async context manager it is closed at the end
    of the block. If it has no handler, ``async for call in server:`` gives the calls.

    At most ``concurrency`` handlers run at a time. Up to ``backlog`` requests, of ``backlog_bytes``
    in total, wait their turn. They wait in Python, because the queue of the middleware would
    overflow. `Backlog` decides whose turn it is, and what is dropped if more come. A plain handler
    runs in the loop, and blocks it until it returns. An async one runs in a task.

    Confined to the loop's thread, except `ServiceCall.respond`: responses are sent from any thread,
    several at once, and the service is destroyed only when none is being sent. rcl does not allow
    one thread to take requests of a service while another sends responses. This cannot happen,
    because rclpy holds the GIL during both.
    """

    def __init__(
        self,
        node: NodePort,
        srv_type: Any,
        srv_name: str,
        handler: Handler[RequestT, ResponseT] | None,
        *,
        concurrency: int,
        backlog: int,
        backlog_bytes: int,
        order: Order,
        qos: Any,
        on_error: ErrorHook[RequestT, ResponseT] | None,
        on_overload: OverloadHook[RequestT, ResponseT] | None,
        status: Status,
        cancel_abandoned: bool,
        on_end: Callable[[ServiceServer[RequestT, ResponseT]], object],
        tracing: Tracing,
        reporter: Reporter,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        kind = settle_kind(handler)
        check_hook("on_error", on_error)
        self._on_overload = check_hook("on_overload", on_overload)
        self._on_end = on_end
        most = check_count("concurrency", concurrency, 1)
        self._has_handler = kind is not None
        limits = (
            check_count("backlog", backlog, 0),
            check_count("backlog_bytes", backlog_bytes, 0),
        )
        by_arrival = _check_order(order) == "arrival"
        check_status(status)
        check_flag("cancel_abandoned", cancel_abandoned)
        self._cancel_abandoned = cancel_abandoned
        self._counts = CallCounts()
        self._tasks = HandlerTasks()
        self._taking = True
        self._ended = False
        self._end_task: asyncio.Task[None] | None = None
        service = node.describe(srv_type, srv_name, qos)
        self._name, self._type_name, _ = service.key
        self._tracing = tracing
        self._traces = ServerTracing(tracing, service.key)
        self._port = node.open_service(service, self._on_request)
        self._qos = self._port.qos
        waiting = Backlog[ServiceCall[RequestT, ResponseT]](*limits, by_arrival=by_arrival)
        self._overload = OverloadLog(self._name, by_arrival)
        self._intake = Intake(waiting, self._overload, self._drop)
        self._sender = ResponseSender[ResponseT](
            self._name,
            self._type_name,
            service.srv_type.Response,
            functools.partial(node.make_message, service.srv_type.Response),
            self._port,
            self._counts,
            self._tasks.spawn,
            self._on_destroyed,
        )
        self._runner = HandlerRunner(kind, on_error, self._sender, self._counts, self._tasks)
        self._starter = HandlerStarter(self._runner, self._intake, most if self._has_handler else 0)
        self._status: ServerStatus | None = None
        if status:
            self._status = ServerStatus(
                self._name,
                self._port,
                reporter,
                quiet=status == "quiet",
                on_abandoned=self._on_abandoned,
            )

    def __repr__(self) -> str:
        counts = f"{self._runner.running} running, {len(self._intake)} waiting"
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

    async def __anext__(self) -> ServiceCall[RequestT, ResponseT]:
        """Return the next call. Several tasks may iterate: each call goes to one of them.

        Raises:
            StopAsyncIteration: the server was closed.
            ContextShutdown: the rclpy context was shut down, or the rclpy service destroyed.
            UsageError: the server has a handler, or runs in another loop.
        """
        if self._has_handler:
            raise UsageError(f"{self._name}: a server with a handler cannot be iterated over")
        self._check_loop("iterated over")
        call = await self._intake.get()
        if call is not None:
            if call.trace is not None:
                call.trace.enter("handling")
            return call
        ending = self._sender.ending
        if ending is not None and not isinstance(error := ending(), SessionClosed):
            raise error
        raise StopAsyncIteration

    @property
    def srv_name(self) -> str:
        """The resolved service name. Also available after the end."""
        return self._name

    @property
    def srv_type(self) -> str:
        """The service type's name."""
        return self._type_name

    @property
    def response_type(self) -> type[ResponseT]:
        """The class of the responses."""
        return self._sender.response_type

    @property
    def qos(self) -> Any:
        """A snapshot of the ``QoSProfile`` in use. Also available after the end."""
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
        self._sender.check_open()
        return self._port.handle

    def statistics(self) -> ServerStatistics:
        """Return a snapshot."""
        counts = self._counts
        return ServerStatistics(
            srv_name=self._name,
            running=self._runner.running,
            waiting=len(self._intake),
            oldest_age=self._intake.oldest_age,
            last_age=self._intake.last_age,
            overloaded=self._overload.active,
            overloads=self._overload.times,
            unanswered=counts.unanswered,
            taken=counts.taken,
            responded=counts.responded,
            deferred=counts.deferred,
            failed=counts.failed,
            rejected=counts.rejected,
            dropped=counts.dropped,
            undeliverable=counts.undeliverable,
            abandoned=counts.abandoned,
        )

    async def aclose(self, timeout: float | None = CLOSE_TIMEOUT) -> None:
        """End the server; idempotent, and not cut short by cancellation.

        It stops taking requests, and lets the handlers finish, also those of waiting requests, for
        ``timeout`` seconds (None: without a limit). Then it cancels the rest and destroys the
        service. Calls that are still unanswered stay unanswered. If it has responded within the
        last half second (3.5 s without the profile of rosasync), it first waits that long at most,
        within the timeout, until the clients have received the responses. Otherwise the middleware
        would drop them with the service.

        A handler may close its server, or its session, itself or in a task that it starts. It is
        then neither waited for nor cancelled, and should have responded before.

        Raises:
            UsageError: called from another loop or thread.
        """
        seconds = check_timeout(timeout, None)
        self._check_loop("closed")
        if self._ended:
            return
        # First, because an eager task collects the handlers to wait for as it is created.
        self.exclude_caller()
        if self._end_task is None:
            self._end_task = self._loop.create_task(self._end(seconds))
        await until_done(self._end_task)

    async def until_sent(self, timeout: float) -> float:
        """Wait until each response is sent that is due: of a handler, or to be sent again.

        For the end of an action server, which then goes on to take requests.

        Args:
            timeout: maximum number of seconds to wait.

        Returns:
            The seconds since the last response; infinite if there was none.
        """
        self.exclude_caller()
        await self._tasks.wait(self._loop.time() + timeout)
        return self._sender.age

    def exclude_caller(self) -> None:
        """Exclude the calling handler from those that the end of the server waits for.

        For the session: a handler that closes its session would otherwise wait for itself.
        """
        self._tasks.exclude_caller()

    def on_graph(self) -> None:
        """End the server if something other than rosasync has destroyed its rclpy service.

        Otherwise look for clients that have left. For the session, whenever the graph changes. On
        the loop's thread.
        """
        if self._port.destroyed:
            self._on_destroyed()
        elif self._status is not None:
            self._status.on_graph()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End at once; idempotent.

        Unanswered calls stay unanswered, and later responses get the error that ``ending`` creates.
        For the session. On the loop's thread, or on any if the loop is closed.
        """
        if self._ended:
            return
        self._ended = True
        try:
            self._stop_taking()
            self._drop_waiting()
            self._overload.close()
            self._sender.close(ending)
            if self._status is not None:
                # After the last response, because no answered call may be reported.
                self._status.close()
            self._traces.close()
            self._port.close()
            if not self._loop.is_closed():
                self._tasks.cancel()
        finally:
            try:
                self._on_end(self)
            except Exception:
                logger.exception("%s: the session could not forget this server", self._name)

    # Taking requests.

    def _on_request(self, request: RequestT, header: RequestHeader) -> None:
        if not self._taking:
            return
        self._counts.taken += 1
        now = monotonic_ns()
        trace = self._traces.start(now) if now >= self._tracing.quiet_until else None
        call = ServiceCall(self, request, header, self._sender, now, trace)
        if self._status is not None:
            number = header.request_id.sequence_number
            call.status = self._status.take(call, self._port.client_of(header), number)
            if call.abandoned:
                self._drop_abandoned(call)
                return
        if not self._starter.start_now(call):
            self._intake.put(call, self._port.client_of(header), _waited(header))
            self._starter.start_waiting()

    def _drop(self, call: ServiceCall[RequestT, ResponseT]) -> None:
        """Settle a call for which the backlog has no room."""
        self._counts.rejected += 1
        if self._on_overload is None:
            _give_up_dropped(call)
        else:
            self._runner.call_hook(call, self._on_overload, (call,), _give_up_dropped)

    def _on_abandoned(self, call: ServiceCall[RequestT, ResponseT]) -> None:
        """Drop a call whose caller has left, or cancel its handler if that is wished.

        A handler that has not begun is not run either.
        """
        if self._intake.remove(call):
            self._drop_abandoned(call)
            return
        status = call.status
        if status is None or status.task is None:
            return
        if self._cancel_abandoned or not status.has_begun:
            self._counts.abandoned += 1
            status.task.cancel()

    def _drop_abandoned(self, call: ServiceCall[RequestT, ResponseT]) -> None:
        self._counts.abandoned += 1
        call.give_up("dropped: its caller has left", Outcome.DROPPED)

    # Ending.

    def _check_loop(self, verb: str) -> None:
        if asyncio._get_running_loop() is not self._loop:
            raise UsageError(
                f"{self._name}: a server can only be {verb} in the loop that serves it"
            )

    def _on_destroyed(self) -> None:
        self.end(functools.partial(service_destroyed, self._name))

    def _stop_taking(self) -> None:
        self._taking = False
        self._port.stop()
        if not self._has_handler:
            self._intake.close()

    def _drop_waiting(self) -> None:
        waiting = self._intake.clear()
        if waiting:
            logger.warning(
                "%s: closed with %s waiting, dropped unanswered",
                self._name,
                count(len(waiting), "request"),
            )
        for call in waiting:
            call.give_up("dropped: the server was closed", Outcome.CLOSED)

    async def _end(self, timeout: float | None) -> None:
        deadline = None if timeout is None else self._loop.time() + timeout
        self._stop_taking()
        if not self._has_handler:
            self._drop_waiting()
        await self._tasks.wait(deadline)
        while self._starter.paused and (deadline is None or self._loop.time() < deadline):
            # Plain handlers run in one turn of the loop each.
            await asyncio.sleep(0)
            await self._tasks.wait(deadline)
        self._drop_waiting()
        if self._tasks:
            self._tasks.cancel()
            await self._tasks.wait(self._loop.time() + CANCEL_TIMEOUT)
            if self._tasks:
                logger.warning(
                    "%s: %d handlers still run although they were cancelled, and are left behind: "
                    "a handler must not suppress CancelledError",
                    self._name,
                    len(self._tasks),
                )
        left = math.inf if deadline is None else deadline - self._loop.time()
        await self._sender.wait_until_delivered(left)
        await asyncio.sleep(self._port.destroy_delay)
        self.end(functools.partial(SessionClosed, f"{self._name}: the server is closed"))


def _give_up_dropped(call: ServiceCall[Any, Any]) -> None:
    call.give_up("dropped: too many requests were waiting", Outcome.DROPPED)


def _waited(header: RequestHeader) -> float:
    """Return how many seconds a request has waited in the middleware while the loop was busy.

    The middleware uses the system's clock, which may be set at any time.
    """
    received = header.received_timestamp
    return min(max(0.0, (time_ns() - received) / 1e9), MOST_WAITED) if received > 0 else 0.0


def _check_order(order: Order) -> Order:
    if order not in ("fair", "arrival"):
        raise ValueError(f"order must be 'fair' or 'arrival', not {order!r}")
    return order
