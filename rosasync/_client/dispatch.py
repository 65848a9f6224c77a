"""Who goes next: one function decides it for all callers of a service."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._client.clients import Clients
from rosasync._client.probes import Probes
from rosasync._core.ports import PortDestroyed
from rosasync.errors import ContextShutdown

if TYPE_CHECKING:
    from rosasync._client.call import Call
    from rosasync._client.call_errors import CallErrors
    from rosasync._client.client import Client
    from rosasync._client.counts import Counts
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._client.sent import Sent
    from rosasync._core.aio import Deadlines
    from rosasync._core.ports import NodePort, Service
    from rosasync._status.listener import Listener
    from rosasync.options import Limits
    from rosasync.tracing import ClientTracing

__all__ = ["Dispatch", "LeaseWaiter", "Waiter"]


OVERLOAD = 1.0
"""Minimum number of seconds for which a service counts as overloaded, after a caller was passed
over. Callers whose deadlines pass together come back together, and would fill the window again."""
PERSISTENCE = 4
"""The same as a number of response times, for a slow server."""


class Waiter(Protocol):
    """A caller in the queue: a `Call` or a `LeaseWaiter`.

    Attributes:
        future: done when the caller has left.
        deadline: the loop time by which the caller needs its answer; None if that is not known.
        passed: the seconds until the server answers, and the seconds that were left, when the
            caller was passed over.
    """

    future: asyncio.Future[Any]
    deadline: float | None
    passed: tuple[float, float] | None

    @property
    def gone(self) -> bool:
        """Whether nothing may be sent for the caller any more."""

    def start(self, client: Client, now: float) -> None:
        """Go on with this client, which has a free place."""


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
    and when the graph may have changed, because a client may be matched now.

    In the next turn, and not at once: by then the callers that were cancelled in this turn are
    done, and no caller is resumed in the middle of another one's work.

    Attributes:
        clients: the clients of the service.
        queue: the callers that wait for a place, in their order.
        passed: the callers that were passed over, in their order: they would be answered too late,
            unless the server becomes quicker.
        overloaded_until: the loop time until which the service counts as overloaded, because a
            caller was passed over. Until then no call is sent without a look at its deadline.
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
        self.queue: dict[Waiter, None] = {}
        self.passed: dict[Waiter, None] = {}
        self.overloaded_until = 0.0
        # The latest deadline of those passed over since there were none.
        self._latest = 0.0
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
        self._probes = Probes(self.clients, self.schedule)

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
        return not busy and self._loop.time() >= self.overloaded_until

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

    def enqueue(self, waiter: Waiter) -> None:
        """Add a caller to the end of the queue.

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
        self.queue[waiter] = None
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
        self._probes.update(now, overloaded=now < self.overloaded_until)
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
            waiter = None if client is None else self._next_waiter(client, now)
            if client is None or waiter is None:
                break
            waiter.start(client, now)
        self._grow_clients()
        if self.callers_wait():
            self.clients.set_timers()

    def _next_waiter(self, client: Client, now: float) -> Waiter | None:
        """Take the first caller who can be answered in time, and pass over those before.

        A call that is passed over is not ended: it costs nothing, and the server may become quick
        again before its deadline.
        """
        window = client.window
        if self.passed and window.answers_in(self._latest - now, now):
            needed = window.expected(now)
            for waiter in tuple(self.passed):
                if waiter.gone or waiter.deadline is None or waiter.deadline - now >= needed:
                    del self.passed[waiter]
                    if not waiter.gone:
                        return waiter
        while self.queue:
            waiter = next(iter(self.queue))
            del self.queue[waiter]
            if waiter.gone:
                continue
            if waiter.deadline is None or window.answers_in(waiter.deadline - now, now):
                return waiter
            needed = window.expected(now)
            waiter.passed = (needed, waiter.deadline - now)
            self.overloaded_until = now + max(OVERLOAD, PERSISTENCE * needed)
            self._latest = max(self._latest, waiter.deadline) if self.passed else waiter.deadline
            self.passed[waiter] = None
        if not self.passed or not self.clients.nothing_out or not self._probes.may_send(now):
            return None
        # Nothing else is out, so one that has hardly time enough finds out how quick the server is.
        # Nothing of any client, or with many clients of one place each, all of them would find out.
        waiter = max(self.passed, key=_deadline_of)
        del self.passed[waiter]
        if waiter.gone:
            return None
        self._probes.send(now, _deadline_of(waiter) - now)
        return waiter

    def _is_short(self, call: Call, now: float) -> bool:
        """Return whether sending a call again would cost others their answers, or come too late."""
        if now < self.overloaded_until:
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


def _deadline_of(waiter: Waiter) -> float:
    """Return the deadline of a caller that was passed over."""
    return -math.inf if waiter.gone or waiter.deadline is None else waiter.deadline
