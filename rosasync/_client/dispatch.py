"""Who goes next: one function decides it for all callers of a service."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from rosasync._client.clients import Clients
from rosasync._client.order import Order
from rosasync._client.probes import Probes
from rosasync._core.ports import PortDestroyed
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._client.call import Call
    from rosasync._client.call_errors import CallErrors
    from rosasync._client.client import Client
    from rosasync._client.counts import Counts
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._client.order import Waiter
    from rosasync._client.sent import Sent
    from rosasync._core.aio import Deadlines
    from rosasync._core.ports import NodePort, Service
    from rosasync._status.listener import Listener
    from rosasync.options import Limits
    from rosasync.tracing import ClientTracing

__all__ = ["Dispatch", "LeaseWaiter"]


class LeaseWaiter:
    """A caller that waits for a lease. Its future receives the client.

    Its calls have deadlines of their own. So it is never passed over.
    """

    __slots__ = ("deadline", "future", "passed")

    def __init__(self, future: asyncio.Future[Client]) -> None:
        self.future = future
        self.deadline: float | None = None
        self.passed: tuple[float, float] | None = None

    @property
    def gone(self) -> bool:
        """Whether the caller has left."""
        return self.future.done()

    def start(self, client: Client, now: float) -> None:
        """Take a place of this client."""
        client.window.lease()
        self.future.set_result(client)


class Dispatch:
    """The callers of one service that wait, and the one function that lets them go: `assign`.

    It runs when something was added or came free, and from nowhere else: in the next turn of the
    loop after a caller or a request to be sent again was added, or a place came free (`schedule`);
    and when the graph may have changed, because a client may be matched now. While callers wait,
    that is looked at every half second, so those passed over need no timer of their own.

    In the next turn, and not at once: by then the callers that were cancelled in this turn are
    done, and no caller is resumed in the middle of another one's work.

    Attributes:
        clients: the clients of the service.
        order: the callers that wait for a place, and who of them goes next.
        queue: see `Order`, as for ``passed``.
        resends: the calls that wait to be sent again, in the order in which that became due.
        leased: the calls that wait for their leased client: for its match, or for the place of the
            lease while an abandoned request takes it.
    """

    def __init__(
        self,
        service: Service,
        node: NodePort,
        limits: Limits,
        watch: GraphWatch,
        errors: CallErrors,
        counts: Counts,
        traces: ClientTracing,
        deadlines: Deadlines,
        listener: Listener,
    ) -> None:
        self.clients = Clients(service, node, limits, watch, errors, counts, self, listener)
        self._probes = Probes(self.clients, self.schedule)
        self.order = Order(self.clients, self._probes)
        # Those of the order, because every call looks at them.
        self.queue = self.order.queue
        self.passed = self.order.passed
        self.resends: dict[Call, None] = {}
        self.leased: dict[Call, None] = {}
        # Each caller that waits for a match, with the client to be matched: None for any client.
        self._match_waiters: dict[asyncio.Future[None], Client | None] = {}
        self._make_response = partial(node.make_message, service.srv_type.Response)
        self._limits = limits
        self._watch = watch
        self._errors = errors
        self._traces = traces
        self._deadlines = deadlines
        self._loop = asyncio.get_running_loop()
        self._scheduled = False
        self._ended = False

    @property
    def awaits_match(self) -> bool:
        """Whether callers wait for a client to be matched, and not only for a place."""
        generation = self._watch.generation
        for client in self._match_waiters.values():
            if client is None or client.matched_generation != generation:
                return True
        for call in (*self.resends, *self.leased):
            if (call.lease or call.client).matched_generation != generation:
                return True
        return bool(self.queue or self.passed) and self.clients.awaits_match

    @property
    def idle(self) -> bool:
        """Whether no caller waits for a place, so that the next one may be sent at once."""
        busy = self.queue or self.passed or self.resends
        return not busy and self._loop.time() >= self.order.overloaded_until

    @property
    def waiting(self) -> int:
        """The number of callers that wait for a place."""
        return len(self.queue) + len(self.passed)

    def callers_wait(self) -> bool:
        """Return whether callers wait for a place or a match, or calls to be sent again."""
        return bool(self.queue or self.passed or self.resends or self.leased or self._match_waiters)

    def next_resend(self, client: Client) -> Sent | None:
        """Return the newest attempt of the first call that waits to be sent again by a client."""
        if not self.resends:
            return None
        return next((call.newest for call in self.resends if call.client is client), None)

    # What is added, and what comes free.

    def enqueue(self, waiter: Waiter, since: float) -> None:
        """Add a caller to the end of the queue.

        Args:
            waiter: the caller.
            since: see `Order.queue`.

        Raises:
            PoolFull: the queue is full.
            Exception: there is no client, and none can be created.
        """
        waiting = self.waiting
        self.clients.grow(waiting + 1)
        # Callers for whom there is a free place wait for a match or a turn, so they do not count.
        free = self.clients.free
        if waiting >= self._limits.waiting + free:
            raise self._errors.pool_full(waiting, self._limits.waiting)
        self.queue[waiter] = since
        if free:
            self.schedule()
        elif not waiting:
            # The first caller that waits sets them for all.
            self.clients.set_timers()

    def start_leased(self, call: Call, now: float) -> None:
        """Start a call on a lease now, or when its client is matched and has its place.

        Raises:
            ContextShutdown: the client was destroyed, or the node is down.
        """
        assert call.lease is not None
        if self._is_lease_ready(call.lease):
            call.start(call.lease, now)
            return
        self.leased[call] = None
        if call.trace is not None:
            matched = call.lease.matched_generation == self._watch.generation
            self._traces.wait(call.trace, not matched)
        self._watch.poll_soon()
        self.clients.set_timers()

    def send_again(self, call: Call) -> None:
        """Send a call again as soon as there are a server and a place."""
        self.resends[call] = None
        self.schedule()

    def make_response(self, value: object) -> Any:
        """Return the response in a value that `Retry.verify` has returned.

        Raises:
            TypeError, ValueError: it is neither a response nor a mapping of its fields.
        """
        return self._make_response(value)

    def remove(self, call: Call) -> None:
        """Remove a call wherever it waits, because its caller leaves."""
        self.queue.pop(call, None)
        self.passed.pop(call, None)
        self.resends.pop(call, None)
        self.leased.pop(call, None)

    def on_left(self, call: Call, since: float) -> None:
        """Record that the caller of a call that had to wait was cancelled.

        Args:
            call: the call.
            since: the loop time since which the caller has waited.
        """
        now = self._loop.time()
        known = call.deadline is not None and now >= call.deadline
        if not known and (call.started or not self.clients.lacks_server):
            self.order.patience.add(now - since, now)

    async def wait_for_match(self, client: Client | None, deadline: float | None) -> None:
        """Wait until a client is matched: any client if it is None.

        Raises:
            Expired: the deadline passed.
        """
        waiter: asyncio.Future[None] = self._loop.create_future()
        self._match_waiters[waiter] = client
        self._watch.poll_soon()
        try:
            await self._deadlines.wait(waiter, deadline)
        finally:
            del self._match_waiters[waiter]

    def on_places(self) -> None:
        """Schedule an assignment if callers wait: places may have come free."""
        if self.queue or self.passed or self.resends or self.leased:
            self.schedule()

    def check_servers(self) -> None:
        """Look for requests that have lost all their servers."""
        self.clients.matching.check_outstanding()

    def on_matched(self) -> None:
        """Report to the traced calls that a client is matched: from now on they are queued."""
        self._traces.on_matched()

    def drop(self, client: Client) -> None:
        """Remove a client that other code has destroyed."""
        self.clients.drop(client)

    def schedule(self) -> None:
        """Assign in the next turn of the loop."""
        if not self._scheduled and not self._loop.is_closed():
            self._scheduled = True
            self._loop.call_soon(self._run)

    def end(self, ending: Callable[[], Exception]) -> None:
        """Fail every waiting caller, and assign nothing any more."""
        self._ended = True
        self._probes.close()
        self._fail_waiting(ending)

    # The decision.

    def assign(self) -> None:
        """Decide who goes next, and let them go.

        1. Calls that are sent again, because their callers came before those in the queue.
        2. Calls on a lease: they have their place, or are the next to have it.
        3. The queue, while there are matched clients with free places: first come, first served,
           among those that can still be answered in time.
        """
        if self._ended:
            return
        now = self._loop.time()
        self._probes.update(now, overloaded=now < self.order.overloaded_until)
        self._wake_match_waiters()
        for call in tuple(self.resends):
            overloaded = call.repeats and self._is_short(call, now)
            if call.gone or overloaded or self._may_send_again(call):
                del self.resends[call]
                if not call.gone:
                    call.send_again(now, overloaded)
        for call in tuple(self.leased):
            self._assign_lease(call, now)
        while self.queue or self.passed:
            client = self.clients.choose()
            waiter = None if client is None else self.order.next(client.window, now)
            if client is None or waiter is None:
                break
            waiter.start(client, now)
        self._grow_clients()
        if self.callers_wait():
            self.clients.set_timers()

    def _is_short(self, call: Call, now: float) -> bool:
        """Return whether sending a call again would cost others their answers, or come too late."""
        if now < self.order.overloaded_until:
            return True
        return call.deadline is not None and (
            not call.client.window.answers_in(call.deadline - now, now)
        )

    def _run(self) -> None:
        self._scheduled = False
        with self._watch.reports_shutdown():
            self.assign()
            if self.awaits_match:
                self._watch.poll_soon()

    def _may_send_again(self, call: Call) -> bool:
        client = call.client
        if not client.window.may_send_again(call.newest, call.lease is not None):
            return False
        try:
            # `ready` as well: a server may vanish before the graph changes.
            return client.ready() and self.clients.match(client)
        except PortDestroyed:
            self.clients.drop(client)
        except Exception as error:
            call.fail_send(error)
        return False

    def _assign_lease(self, call: Call, now: float) -> None:
        assert call.lease is not None
        try:
            if call.gone or self._is_lease_ready(call.lease):
                del self.leased[call]
                if not call.gone:
                    call.start(call.lease, now)
        except ContextShutdown as error:
            call.future.set_exception(error)

    def _is_lease_ready(self, lease: Client) -> bool:
        if lease.closed:
            raise self._errors.client_destroyed()
        return lease.window.free >= 0 and self.clients.match(lease)

    def _wake_match_waiters(self) -> None:
        for waiter, client in self._match_waiters.items():
            if not waiter.done() and (
                self.clients.match_any() if client is None else self.clients.match(client)
            ):
                waiter.set_result(None)

    def _grow_clients(self) -> None:
        """Create clients for the waiting callers, if something else has destroyed some.

        If that fails, all waiting callers get the error.
        """
        try:
            self.clients.grow(self.waiting or bool(self._match_waiters))
        except Exception as error:
            failure = error
            self._fail_waiting(lambda: failure)

    def _fail_waiting(self, error: Callable[[], Exception]) -> None:
        waiting = [waiter.future for waiter in (*self.queue, *self.passed)]
        waiting += [call.future for call in self.leased]
        for future in (*waiting, *self._match_waiters):
            if not future.done():
                future.set_exception(error())
