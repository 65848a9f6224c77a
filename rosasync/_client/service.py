"""One service in the pool: its calls, its leases, the waits for its server, and their counts."""

from __future__ import annotations

import asyncio
import math
import weakref
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict
from time import monotonic, monotonic_ns
from typing import TYPE_CHECKING, Any

from rosasync._client.call import Call
from rosasync._client.call_errors import AllServersGone, CallErrors, NoServer, Refused
from rosasync._client.counts import Counts
from rosasync._client.dispatch import Dispatch, LeaseWaiter
from rosasync._client.latency import LatencyHistogram, summarize
from rosasync._client.mismatch import MismatchReporter
from rosasync._client.retry import Plan, RetryBudget
from rosasync._core.aio import Deadlines, Expired, start_task
from rosasync._core.ports import PortDestroyed
from rosasync._core.text import count
from rosasync.errors import ContextShutdown, RosasyncError
from rosasync.statistics import KeyStatistics
from rosasync.tracing import ClientTracing

if TYPE_CHECKING:
    from rosasync._client.client import Client
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.ports import NodePort, Service
    from rosasync._status.listener import Listener
    from rosasync.options import Limits, Retry
    from rosasync.tracing import Outcome, Tracing

__all__ = ["MATCH_TIMEOUT", "ServicePool"]

MATCH_TIMEOUT = 1.0
"""Seconds to wait until a new client is matched with a server that the graph already shows."""


class ServicePool:
    """The calls of one service, and everything that they share.

    Confined to the loop's thread. Its state changes only between awaits, so there is no lock.

    A caller sends at once if none waits and a matched client has a free place. All others wait, and
    `Dispatch.assign` decides which goes next. So a caller that comes later finds the queue and
    cannot overtake it.
    """

    def __init__(
        self,
        service: Service,
        node: NodePort,
        limits: Limits,
        watch: GraphWatch,
        deadlines: Deadlines,
        tracing: Tracing,
        listener: Listener,
    ) -> None:
        self.service = service
        self.latencies = LatencyHistogram()
        self._node = node
        self._watch = watch
        self._deadlines = deadlines
        self._tracing = tracing
        self._traces = ClientTracing(tracing, service.key)
        self._loop = asyncio.get_running_loop()
        self._errors = CallErrors(service, node.queries, monotonic)
        self._counts = Counts()
        self._budget = RetryBudget(self._counts, self._loop.time)
        self._dispatch = Dispatch(
            service,
            node,
            limits,
            watch,
            self._errors,
            self._counts,
            self._traces,
            deadlines,
            listener,
        )
        self._clients = self._dispatch.clients
        self._mismatch = MismatchReporter(service, node.queries)
        self._ending: Callable[[], Exception] | None = None

    def __repr__(self) -> str:
        return (
            f"<ServicePool {self.service.key.srv_name} {count(len(self._clients), 'client')}, "
            f"{self._counts.in_flight} in flight, {self._dispatch.waiting} waiting>"
        )

    @property
    def clients(self) -> tuple[Client, ...]:
        """The clients that exist now."""
        return tuple(self._clients)

    @property
    def is_busy(self) -> bool:
        """Whether there are callers, or requests without a caller."""
        return bool(
            self._counts.in_flight or self._dispatch.callers_wait() or self._clients.abandoned
        )

    @property
    def awaits_match(self) -> bool:
        """Whether callers wait for a client to be matched, and not only for a place."""
        return self._dispatch.awaits_match

    def statistics(self) -> KeyStatistics:
        """Take a snapshot."""
        counts = asdict(self._counts)
        del counts["sent"]
        return KeyStatistics(
            clients=len(self._clients),
            idle=sum(client.is_idle for client in self._clients),
            waiting=self._dispatch.waiting,
            abandoned=self._clients.abandoned,
            window=sum(client.window.size for client in self._clients),
            share=self._clients.share,
            servers=self._clients.matching.count,
            latency=summarize([self.latencies]),
            **counts,
        )

    # Calls, leases and waits.

    async def call(
        self,
        request: Any,
        timeout: float | None,
        wait: bool | float = True,
        retry: Retry | None = None,
        *,
        lease: Client | None = None,
        copy: bool = False,
        is_cancelled: Callable[[], bool] | None = None,
    ) -> Any:
        """Send a request with the first client that has a free place, and return the response.

        Args:
            request: the message.
            timeout: seconds for the whole call, None for no deadline.
            wait: whether to wait for a server if there is none, or for how many seconds.
            retry: when to send again.
            lease: the leased client to send with. The call uses the place of the lease.
            copy: copy the request, unless it is sent in this turn of the loop and never again.
            is_cancelled: see `Call`.

        Raises:
            Exception: as `Session.call`.
        """
        loop = self._loop
        dispatch = self._dispatch
        now = monotonic_ns()
        trace = None
        if now >= self._tracing.quiet_until:
            trace = self._traces.start(now)
        started = loop.time()
        deadline = None if timeout is None else started + timeout
        plan = None if retry is None else Plan(retry, self._budget)
        call = Call(
            dispatch, loop.create_future(), request, plan, lease, trace, is_cancelled, deadline
        )
        entry = server_timer = queued = None
        try:
            if timeout is not None and timeout <= 0:
                self.check_open()
                raise self._errors.no_time_left()
            if lease is not None:
                self.check_open()
                dispatch.start_leased(call, started)
            else:
                # `Dispatch.idle`, inlined.
                client = None
                if not (
                    dispatch.queue
                    or dispatch.passed
                    or dispatch.resends
                    or started < dispatch.order.overloaded_until
                ):
                    client = self._clients.choose()
                if copy and (client is None or retry is not None):
                    call.request = deepcopy(request)
                if client is not None:
                    call.start(client, started)
                else:
                    if trace is not None:
                        self._traces.wait(trace, self._clients.lacks_server)
                    if wait is not True:
                        if wait <= 0:
                            await self._find_server(started, deadline)
                        else:
                            server_timer = loop.call_at(started + wait, self._give_up_server, call)
                    self.check_open()
                    queued = started if wait is True else loop.time()
                    dispatch.enqueue(call, queued)
            if deadline is not None:
                entry = self._deadlines.set(call.future, deadline)
            response = await call.future
        except BaseException as error:
            if queued is not None and isinstance(error, asyncio.CancelledError):
                dispatch.on_left(call, queued)
            raise self._count_failure(call, error, started) from None
        finally:
            # Not a method of `Deadlines`, because every call comes here.
            if entry is not None:
                entry[-1] = None
            if server_timer is not None:
                server_timer.cancel()
            # First, because the end of the call may schedule an assignment of what still waits.
            if plan is not None or not call.started:
                dispatch.remove(call)
            if call.in_flight:
                call.end(loop.time())
        self._counts.completed += 1
        self.latencies.add(monotonic_ns() - now)
        if trace is not None:
            self._traces.end(trace, "answered")
        return response

    def start(
        self,
        request: Any,
        timeout: float | None,
        wait: bool | float = True,
        retry: Retry | None = None,
        *,
        copy: bool = False,
    ) -> asyncio.Task[Any]:
        """Start a call as a task, and send at once if that is possible; as `call` otherwise."""
        # Weak, so that a task without other references is collected although its call is queued.
        started: weakref.ref[asyncio.Task[Any]] | None = None

        def is_cancelled() -> bool:
            # A cancellation reaches the call's future only with the first step of the task.
            task = None if started is None else started()
            return task is not None and task.cancelling() > 0

        call = self.call(request, timeout, wait, retry, copy=copy, is_cancelled=is_cancelled)
        task = start_task(self._loop, call)
        started = weakref.ref(task)
        return task

    async def lease(self, timeout: float | None) -> Client:
        """Wait for a client with a free place, and take it; `Client.release` ends the lease.

        Raises:
            ServiceUnavailable, QueueTimeout: there was none within ``timeout`` seconds.
            PoolFull: too many callers wait.
        """
        started = self._loop.time()
        self.check_open()
        if timeout is not None and timeout <= 0:
            raise self._errors.no_time_left()
        dispatch = self._dispatch
        client = self._clients.choose() if dispatch.idle else None
        if client is not None:
            client.window.lease()
            return client
        waiter = LeaseWaiter(self._loop.create_future())
        granted = False
        try:
            dispatch.enqueue(waiter, math.inf)
            await self._deadlines.wait(
                waiter.future, None if timeout is None else started + timeout
            )
            self.check_open()
            granted = True
            return waiter.future.result()
        except Expired:
            raise self._unreached(started) from None
        finally:
            dispatch.queue.pop(waiter, None)
            # Granted in the turn in which the caller was cancelled, or the session ended.
            future = waiter.future
            if not granted and future.done() and not future.cancelled() and not future.exception():
                future.result().release()

    async def wait_for_server(self, timeout: float | None) -> None:
        """Wait until a server is matched.

        Raises:
            ServiceUnavailable: none was, within ``timeout`` seconds.
        """
        started = self._loop.time()
        if self.match():
            return
        deadline = None if timeout is None else started + timeout
        try:
            await self._wait_for_match(None, deadline)
        except Expired:
            raise self._errors.unavailable(self._loop.time() - started) from None

    async def warm(self, clients: int, match_by: float) -> None:
        """Create clients and match them.

        Args:
            clients: the number of clients to have.
            match_by: the loop time at which to stop waiting for the matches.
        """
        # Not `while`: it would never end if each client is evicted before the next is created.
        for _ in range(clients):
            self.check_open()
            if len(self._clients) < clients:
                self._clients.open()
                await asyncio.sleep(0)
        for client in self._clients:
            try:
                await self._wait_for_match(client, match_by)
            except Expired:
                self._mismatch.warn()
                return

    def match(self) -> bool:
        """Return whether a client is matched with a server, after creating one if there is none.

        This is a use of the clients: they are not evicted for some time.
        """
        self.check_open()
        if not self._clients:
            self._clients.open()
        self._clients.touch()
        self._watch.keep_polling()
        return self._clients.match_any()

    def is_provided(self) -> bool:
        """Return whether the graph shows a server that fits."""
        return self._clients.matching.provided()

    def check_open(self) -> None:
        """Raise the error that calls get, once the session has ended."""
        if self._ending is not None:
            raise self._ending()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End every call with the error that ``ending`` makes, and destroy the clients."""
        self._ending = ending
        self._dispatch.end(ending)
        self._clients.fail(ending)
        self._clients.close()

    def on_graph(self) -> None:
        """Check the graph again: shares, matches, and requests whose servers are gone."""
        self._clients.on_graph()
        if self._clients.is_outstanding:
            # Before the assignment: new servers free places, and get what is sent from now on.
            self._clients.matching.check_outstanding()
        if self._dispatch.callers_wait():
            self._dispatch.assign()
        # Every poll runs this, and the watch polls while callers wait for a match.
        self._mismatch.check(self.awaits_match, self._loop.time())

    async def _wait_for_match(self, client: Client | None, deadline: float | None) -> None:
        """Wait until a client is matched, or any client if it is None.

        Raises:
            Expired: the deadline passed.
        """
        self.check_open()
        # The session may end between the wake-up and this task's turn.
        while not (self._clients.match_any() if client is None else self._clients.match(client)):
            await self._dispatch.wait_for_match(client, deadline)
            self.check_open()

    def _give_up_server(self, call: Call) -> None:
        """End a call that has waited for a server as long as it may, unless one is matched."""
        if not call.started and not call.future.done() and not self._clients.any_ready():
            call.future.set_exception(NoServer())

    async def _find_server(self, started: float, deadline: float | None) -> None:
        """Raise `ServiceUnavailable` if the graph shows no server; otherwise wait for the match."""
        if self.match():
            return
        now = self._loop.time()
        if not self.is_provided():
            raise self._errors.unavailable(now - started)
        left = math.inf if deadline is None else max(0.0, deadline - now)
        await self.wait_for_server(min(MATCH_TIMEOUT, left))

    # Failures.

    def _unreached(self, started: float, passed: tuple[float, float] | None = None) -> Exception:
        """Make the error for a deadline that passed before the request was sent."""
        if self._ending is not None:
            return self._ending()
        elapsed = self._loop.time() - started
        if not self._clients.any_ready():
            return self._errors.unavailable(elapsed)
        if passed is not None:
            return self._errors.too_late(elapsed, *passed)
        return self._errors.queue_timeout(elapsed, self._counts.in_flight, self._clients.abandoned)

    def _count_failure(self, call: Call, error: BaseException, started: float) -> BaseException:
        """Count a failed call, and return the error to raise to the caller."""
        counts = self._counts
        try:
            error = self._translate(call, error, started)
        except Exception as failure:
            # The node went down before the graph could be asked.
            error = failure
        outcome: Outcome
        if isinstance(error, asyncio.CancelledError):
            outcome = "cancelled"
            counts.cancelled += 1
            if call.started and not call.future.cancelled() and call.future.exception() is None:
                counts.late += 1  # The response came before the cancelled task resumed.
        elif isinstance(error, TimeoutError):
            outcome = "timed out"
            counts.timed_out += 1
        else:
            outcome = "failed"
            counts.failed += 1
        if call.trace is not None:
            self._traces.end(call.trace, outcome, error)
        return error

    def _translate(self, call: Call, error: BaseException, started: float) -> BaseException:
        elapsed = self._loop.time() - started
        match error:
            case asyncio.CancelledError() | RosasyncError():
                return error
            case NoServer():
                return self._errors.unavailable(elapsed)
            case Expired() if not call.started:
                return self._unreached(started, call.passed)
            case Expired():
                return self._errors.response_timeout(elapsed, call.plan)
            case AllServersGone():
                return self._errors.server_gone(elapsed)
            case Refused(report=report):
                return self._errors.refused(elapsed, report)
            case PortDestroyed():
                return self._errors.client_destroyed()
            case Exception() if not self._node.ok():
                return ContextShutdown() if self._ending is None else self._ending()
        return error
