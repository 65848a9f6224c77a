"""One service in the pool: the queue for its clients, and the calls they carry."""

from __future__ import annotations

import asyncio
import math
from collections import OrderedDict
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict
from time import monotonic_ns
from typing import TYPE_CHECKING, Any

from rosasync._client.call import Call
from rosasync._client.call_errors import CallErrors
from rosasync._client.client import Client
from rosasync._client.client_set import ClientSet
from rosasync._client.latency import LatencyHistogram, summarize
from rosasync._client.mismatch import MismatchReporter
from rosasync._client.retry import Attempts, RetryBudget
from rosasync._core.aio import Deadlines, Expired
from rosasync._core.ports import PortDestroyed
from rosasync.errors import ContextShutdown, RosasyncError
from rosasync.statistics import KeyStatistics
from rosasync.tracing import ClientTracing

if TYPE_CHECKING:
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.ports import NodePort, Service
    from rosasync.options import Limits, Retry
    from rosasync.tracing import CallTrace, Outcome, Tracing

__all__ = ["MATCH_TIMEOUT", "ServicePool"]

OnClient = Callable[[Client], None]
"""Called with the client when one is granted."""

GONE_DELAY = 0.05
"""Seconds to wait for the next response that the last server sent just before it vanished."""
MATCH_TIMEOUT = 1.0
"""Seconds to wait until a new client is matched with a server that the graph already shows."""


class ServicePool:
    """The clients of one service, and the callers who wait for them.

    Confined to the loop's thread. Its state changes only between awaits, so there is no lock.

    A caller sends at once if the queue is empty and a matched client has capacity. All others join
    the queue. Capacity that becomes free only schedules a dispatch for the next turn of the loop,
    and the dispatch decides and sends. So a caller who is cancelled in the same turn is done by
    then, and a caller who comes later finds the queue and cannot overtake it.
    """

    def __init__(
        self,
        service: Service,
        node: NodePort,
        limits: Limits,
        watch: GraphWatch,
        deadlines: Deadlines,
        tracing: Tracing,
    ) -> None:
        self.service = service
        self.latencies = LatencyHistogram()
        self._node = node
        self._limits = limits
        self._watch = watch
        self._deadlines = deadlines
        self._tracing = tracing
        self._traces = ClientTracing(tracing, service.key)
        self._loop = asyncio.get_running_loop()
        self._errors = CallErrors(service, node)
        self._clients = ClientSet(service, node, limits, watch, self._errors, self)
        self._counts = self._clients.counts
        self._budget = RetryBudget(self._counts, self._loop.time)
        self._queue: OrderedDict[asyncio.Future[Any], OnClient] = OrderedDict()
        # Each caller who waits for a match, with the client to be matched: None for any client.
        self._ready_waiters: dict[asyncio.Future[None], Client | None] = {}
        self._dispatch_scheduled = False
        # Started when the last server has vanished; ends the requests after GONE_DELAY.
        self._gone_timer: asyncio.TimerHandle | None = None
        self._mismatch = MismatchReporter(service, node)
        self._ending: Callable[[], Exception] | None = None

    def __repr__(self) -> str:
        return (
            f"<ServicePool {self.service.key.srv_name} {len(self._clients)} clients, "
            f"{self._counts.in_flight} in flight, {len(self._queue)} waiting>"
        )

    @property
    def clients(self) -> tuple[Client, ...]:
        """The clients that exist now."""
        return tuple(self._clients)

    @property
    def is_busy(self) -> bool:
        """Whether there are callers, or requests without a caller."""
        return bool(
            self._queue or self._ready_waiters or self._counts.in_flight or self._clients.abandoned
        )

    @property
    def awaits_match(self) -> bool:
        """Whether callers wait for a client to be matched, and not only for capacity."""
        generation = self._watch.generation
        for leased in self._ready_waiters.values():
            if leased is None or leased.matched_generation != generation:
                return True
        if self._clients.awaits_match_to_resend:
            return True
        return bool(self._queue) and self._clients.awaits_match

    def statistics(self) -> KeyStatistics:
        """Take a snapshot."""
        counts = asdict(self._counts)
        del counts["sent"]
        return KeyStatistics(
            clients=len(self._clients),
            idle=self._clients.idle,
            waiting=len(self._queue),
            abandoned=self._clients.abandoned,
            window=self._clients.window,
            share=self._clients.share,
            servers=self._clients.servers,
            latency=summarize([self.latencies]),
            **counts,
        )

    # Calls, leases and waits.

    async def call(
        self,
        request: Any,
        timeout: float | None,
        wait: bool = True,
        retry: Retry | None = None,
        *,
        leased: Client | None = None,
        copy: bool = False,
    ) -> Any:
        """Send a request with the first client that has capacity, and return the response.

        Args:
            request: the message.
            timeout: seconds for the whole call, None for no deadline.
            wait: whether to wait for a server if there is none.
            retry: when to send again.
            leased: the leased client to send with. The call uses the place of the lease.
            copy: copy the request, unless it is sent in this turn of the loop and never again.

        Raises:
            Exception: as `Session.call`.
        """
        loop = self._loop
        now = monotonic_ns()
        trace = None
        if now >= self._tracing.quiet_until:
            trace = self._traces.start(now)
        started = loop.time()
        deadline = None if timeout is None else started + timeout
        attempts = None if retry is None else Attempts(retry, self._budget)
        call = Call(loop.create_future(), request, attempts, leased is not None, trace)
        entry = None
        try:
            if leased is not None:
                await self._wait_until_ready(leased, deadline, trace)
                call.start(leased)
            else:
                client = None if self._queue else self._clients.lease()
                if copy and (client is None or retry is not None):
                    call.request = deepcopy(request)
                if client is not None:
                    call.start(client)
                else:
                    if trace is not None:
                        self._traces.wait(trace, self._clients.lacks_server)
                    if not wait:
                        await self._check_server(started, deadline)
                    self._enqueue(call.future, call.start)
            if deadline is not None:
                entry = self._deadlines.set(call.future, deadline)
            response = await call.future
        except BaseException as error:
            raise self._count_failure(call, error, started) from None
        finally:
            # Not a method of `Deadlines`, because every call comes here.
            if entry is not None:
                entry[-1] = None
            if call.in_flight:
                call.end()
            elif not call.started:
                self._queue.pop(call.future, None)
        self._counts.completed += 1
        self.latencies.add(monotonic_ns() - now)
        if trace is not None:
            self._traces.end(trace, "answered")
        return response

    async def lease(self, timeout: float | None) -> Client:
        """Wait for a client with capacity; `Client.release` ends the lease.

        Raises:
            ServiceUnavailable, QueueTimeout: there was none within ``timeout`` seconds.
            PoolFull: too many callers wait.
        """
        started = self._loop.time()
        client = None if self._queue else self._clients.lease()
        if client is not None:
            return client
        waiter: asyncio.Future[Client] = self._loop.create_future()
        try:
            self._enqueue(waiter, waiter.set_result)
            await self._wait(waiter, None if timeout is None else started + timeout)
            self.check_open()
            return waiter.result()
        except Expired:
            raise self._unreached(started) from None
        except BaseException:
            # A client was granted in the turn in which the caller was cancelled.
            if waiter.done() and not waiter.cancelled() and waiter.exception() is None:
                waiter.result().release()
            raise
        finally:
            self._queue.pop(waiter, None)

    async def wait_for_server(self, timeout: float | None) -> None:
        """Wait until a server is matched.

        Raises:
            ServiceUnavailable: none was, within ``timeout`` seconds.
        """
        started = self._loop.time()
        if self.is_ready():
            return
        try:
            await self._wait_until_ready(None, None if timeout is None else started + timeout)
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
                await self._wait_until_ready(client, match_by)
            except Expired:
                self._mismatch.warn()
                return

    def is_ready(self) -> bool:
        """Return whether a client is matched with a server. To ask is a use of the clients."""
        self.check_open()
        if not self._clients:
            self._clients.open()
        self._clients.touch()
        self._watch.keep_polling()
        return self._clients.any_matched()

    def is_provided(self) -> bool:
        """Return whether the graph shows a server that fits."""
        return bool(self._node.find_servers(self.service))

    def check_open(self) -> None:
        """Raise the error that calls get, once the session has ended."""
        if self._ending is not None:
            raise self._ending()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End every call with the error that ``ending`` makes, and destroy the clients."""
        self._ending = ending
        for future in (*self._queue, *self._ready_waiters):
            if not future.done():
                future.set_exception(ending())
        if self._gone_timer is not None:
            self._gone_timer.cancel()
        self._clients.fail(ending)
        self._clients.close()

    def on_graph(self) -> None:
        """Check the graph again: the shares of the queue, the matches and the lost servers."""
        self._clients.share_queue()
        if self.has_callers() or self._clients.awaits_resend:
            self._dispatch()
        # Every poll runs this, and the watch polls while callers wait for a match.
        self._mismatch.check(self.awaits_match, self._loop.time())
        outstanding = self._clients.is_outstanding
        if outstanding and self._gone_timer is None and self._clients.find_lost_requests():
            self._end_requests_later()

    # For the clients.

    def is_matched(self, client: Client) -> bool:
        """Return whether a client is matched, and reset its servers if the graph has changed."""
        return self._clients.is_matched(client)

    def on_matched(self) -> None:
        """Report to the traced calls that a client is matched: from now on they are queued."""
        self._traces.on_matched()

    def on_capacity(self) -> None:
        """Schedule a dispatch if callers wait."""
        if self._queue or self._ready_waiters:
            self._schedule_dispatch()

    def on_resend_waiting(self) -> None:
        """Poll for a match if a request that is to be sent again waits for it."""
        if self._clients.awaits_match_to_resend:
            self._watch.poll_soon()

    def has_callers(self) -> bool:
        """Return whether callers wait for a place or for a match."""
        return bool(self._queue or self._ready_waiters)

    # The queue.

    def _enqueue(self, waiter: asyncio.Future[Any], on_client: OnClient) -> None:
        """Join the queue. ``on_client`` is called when a client is granted and the waiter not done.

        Raises:
            PoolFull: the queue is full.
            Exception: there is no client, and none can be created.
        """
        self.check_open()
        waiting = len(self._queue)
        self._clients.grow(waiting + 1)
        # Callers for whom there is capacity wait for a match or a dispatch, so they do not count.
        capacity = self._clients.capacity
        if waiting >= self._limits.waiting + capacity:
            raise self._errors.pool_full(waiting, self._limits.waiting)
        self._queue[waiter] = on_client
        if capacity and not waiting:
            self._schedule_dispatch()
        elif not capacity:
            self._clients.request_place()

    def _schedule_dispatch(self) -> None:
        if not self._dispatch_scheduled and not self._loop.is_closed():
            self._dispatch_scheduled = True
            self._loop.call_soon(self._run_dispatch)

    def _run_dispatch(self) -> None:
        self._dispatch_scheduled = False
        with self._watch.reports_shutdown():
            self._dispatch()
            if self.awaits_match:
                self._watch.poll_soon()

    def _dispatch(self) -> None:
        """Grant clients to the waiting callers, in their order, while there is capacity."""
        if self._ending is not None:
            return
        self._wake_ready_waiters()
        self._clients.send_resends()
        while self._queue:
            waiter, on_client = next(iter(self._queue.items()))
            client = None if waiter.done() else self._clients.lease()
            if client is None and not waiter.done():
                break
            del self._queue[waiter]
            if client is not None:
                self._grant(client, waiter, on_client)
        self._replace_clients()

    def _grant(self, client: Client, waiter: asyncio.Future[Any], on_client: OnClient) -> None:
        try:
            on_client(client)
        except Exception as error:
            # The error is this caller's alone: the dispatch goes on with the others.
            client.release()
            if not waiter.done():
                waiter.set_exception(error)

    def _wake_ready_waiters(self) -> None:
        for waiter, leased in self._ready_waiters.items():
            if waiter.done():
                continue
            try:
                if self._is_ready_for(leased):
                    waiter.set_result(None)
            except ContextShutdown as error:
                waiter.set_exception(error)

    def _replace_clients(self) -> None:
        """Create clients for the waiting callers, if something else has destroyed some.

        If that fails, all waiting callers get the error.
        """
        callers = len(self._queue) or bool(self._ready_waiters)
        try:
            self._clients.grow(callers)
        except Exception as error:
            for waiter in (*self._queue, *self._ready_waiters):
                if not waiter.done():
                    waiter.set_exception(error)

    def _is_ready_for(self, leased: Client | None) -> bool:
        if leased is None:
            return self._clients.any_matched()
        if leased.closed:
            raise self._errors.client_destroyed()
        return leased.capacity >= 0 and self._clients.is_matched(leased)

    async def _wait_until_ready(
        self, leased: Client | None, deadline: float | None, trace: CallTrace | None = None
    ) -> None:
        """Wait until any client is matched, or until the leased one is matched and has its place.

        Raises:
            Expired: the deadline passed.
        """
        self.check_open()
        # The session may end, or the place be taken, between the wake-up and this task's turn.
        while not self._is_ready_for(leased):
            waiter: asyncio.Future[None] = self._loop.create_future()
            self._ready_waiters[waiter] = leased
            if trace is not None and leased is not None:
                matched = leased.matched_generation == self._watch.generation
                self._traces.wait(trace, not matched)
            self._watch.poll_soon()
            self._clients.request_place()
            try:
                await self._wait(waiter, deadline)
            finally:
                del self._ready_waiters[waiter]
            self.check_open()

    async def _wait(self, future: asyncio.Future[Any], deadline: float | None) -> None:
        """Wait for a future that a dispatch completes.

        Raises:
            Expired: the deadline passed.
        """
        entry = None if deadline is None else self._deadlines.set(future, deadline)
        try:
            await future
        finally:
            if entry is not None:
                entry[-1] = None

    async def _check_server(self, started: float, deadline: float | None) -> None:
        """Raise `ServiceUnavailable` if the graph shows no server; otherwise wait for the match."""
        if self.is_ready():
            return
        now = self._loop.time()
        if not self.is_provided():
            raise self._errors.unavailable(now - started)
        left = math.inf if deadline is None else max(0.0, deadline - now)
        await self.wait_for_server(min(MATCH_TIMEOUT, left))

    # Failures.

    def _end_requests_later(self) -> None:
        completed = self._counts.completed
        self._gone_timer = self._loop.call_later(GONE_DELAY, self._end_requests, completed)

    def _end_requests(self, completed: int) -> None:
        self._gone_timer = None
        with self._watch.reports_shutdown():
            if self._counts.completed > completed and self._clients.servers_gone():
                # The executor's thread takes responses one by one: more may be on their way.
                self._end_requests_later()
            else:
                self._clients.fail_lost(_Gone)

    def _unreached(self, started: float) -> Exception:
        """Make the error for a deadline that passed before the request was sent."""
        if self._ending is not None:
            return self._ending()
        elapsed = self._loop.time() - started
        if not self.is_ready():
            return self._errors.unavailable(elapsed)
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
            case Expired() if not call.started:
                return self._unreached(started)
            case Expired():
                return self._errors.response_timeout(elapsed, call.attempts)
            case _Gone():
                return self._errors.server_gone(elapsed)
            case PortDestroyed():
                self._clients.drop(call.client)
                return self._errors.client_destroyed()
            case Exception() if not self._node.ok():
                return ContextShutdown() if self._ending is None else self._ending()
        return error


class _Gone(Exception):
    """Every server that fits has vanished."""
