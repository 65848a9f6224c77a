"""ClientPool: hands out clients per (url, type) and takes them back after each await."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar

from rosasync.aio import Deadlines, Expired
from rosasync.client import Call, Client, Counts
from rosasync.errors import (
    CallError,
    ContextShutdown,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    RosasyncError,
    ServerGone,
    ServiceUnavailable,
    UsageError,
)
from rosasync.options import Limits, Retry, Timeout, check_count, check_timeout
from rosasync.statistics import KeyStatistics, PoolStatistics, ServiceKey

if TYPE_CHECKING:
    from rosasync.ports import NodePort, Service

__all__ = ["ClientPool", "LeasedClient"]

T = TypeVar("T")

logger = logging.getLogger("rosasync")

GoOn = Callable[[Client], None]
"""What somebody in line does with the client he is granted."""
Grant = tuple[asyncio.Future[Any], GoOn, Client]
"""Who was in line, and the client he is to go on with."""

FIRST_LOOK = 0.002
"""Seconds until a new client is first looked at; matching it with a server takes milliseconds."""
LAST_LOOK = 0.25
"""Seconds between looks at the most, while somebody waits for a server."""
CONTEXT_LOOK = 0.5
"""Seconds between looks at the context, while a request is out: a signal handler of rclpy shuts it
down without telling anybody."""
LAST_WORDS = 0.02
"""Seconds for a response that a server sent before it vanished to come through after the news."""
MATCHING = 1.0
"""Seconds for a new client to find a server that the graph already shows."""


class Endpoint:
    """All the pool knows of one service: its clients, who waits for one, what happened so far."""

    __slots__ = (
        "clients",
        "counts",
        "gone",
        "granted",
        "key",
        "request_type",
        "service",
        "srv_type",
        "turns",
        "waiters",
        "warned",
        "watchers",
    )

    def __init__(self, service: Service) -> None:
        self.service = service
        self.key = service.key
        self.srv_type = service.srv_type
        self.request_type: type = service.srv_type.Request
        self.clients: list[Client] = []
        self.waiters: OrderedDict[asyncio.Future[Any], GoOn] = OrderedDict()
        self.granted: list[Grant] = []
        self.watchers: dict[asyncio.Future[None], None] = {}
        self.turns: dict[asyncio.Future[None], Client] = {}
        self.counts = Counts()
        self.gone: asyncio.TimerHandle | None = None
        self.warned = False

    def __repr__(self) -> str:
        return (
            f"<Endpoint {self.key.srv_name} {len(self.clients)} clients, "
            f"{self.counts.in_flight} in flight, {len(self.waiters)} waiting>"
        )

    @property
    def has_callers(self) -> bool:
        """Whether somebody waits for a server or a place."""
        return bool(self.waiters or self.granted or self.watchers or self.turns)

    @property
    def has_requests(self) -> bool:
        """Whether a request is out, wanted or abandoned."""
        return bool(self.counts.in_flight) or any(c.abandoned for c in self.clients)

    @property
    def is_busy(self) -> bool:
        """Whether somebody waits for anything."""
        return self.has_callers or self.has_requests

    def error(self, kind: type[CallError], message: str, elapsed: float) -> CallError:
        """Make an error about a call of this service."""
        name, type_name, _ = self.key
        return kind(f"{name}: {message}", srv_name=name, srv_type=type_name, elapsed=elapsed)

    def statistics(self) -> KeyStatistics:
        """Take a snapshot."""
        return KeyStatistics(
            clients=len(self.clients),
            idle=sum(client.is_idle for client in self.clients),
            waiting=len(self.waiters),
            abandoned=sum(client.abandoned for client in self.clients),
            **asdict(self.counts),
        )


class ClientPool:
    """Hands out clients per (url, type) and takes them back after each await.

    A session's, as ``session.pool``. Confined to the loop's thread: its state changes only
    between awaits, so there is no lock.
    """

    def __init__(
        self,
        node: NodePort,
        limits: Limits,
        timeout: float | None,
        on_shutdown: Callable[[], object],
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._limits = limits
        self._timeout = timeout
        self._on_shutdown = on_shutdown
        self._opened = self._loop.time()
        self._endpoints: dict[ServiceKey, Endpoint] = {}
        self._shortcuts: dict[tuple[Any, str, Any], Endpoint] = {}
        self._graph = 0
        self._deadlines = Deadlines()
        self._look_timer: asyncio.TimerHandle | None = None
        self._look_delay = FIRST_LOOK
        self._evict_timer: asyncio.TimerHandle | None = None
        self._ending: Callable[[], Exception] | None = None

    def __repr__(self) -> str:
        total = self.statistics()
        return (
            f"<ClientPool {len(self._endpoints)} services, {total.clients} clients, "
            f"{total.idle} idle, {total.in_flight} in flight, {total.waiting} waiting>"
        )

    @asynccontextmanager
    async def lease(
        self, srv_type: Any, srv_name: str, *, qos: Any = None, timeout: Timeout = ...
    ) -> AsyncIterator[LeasedClient]:
        """Hand out a client and take it back on every way out.

        A lease holds one place in the client's window: it carries one call at a time.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            qos: a ``QoSProfile``; None for the service default with a history of 1,000.
            timeout: seconds to wait for a client, None for no deadline; the session's where it is
                left out.

        Raises:
            ServiceUnavailable: no server was there in time.
            QueueTimeout: every client stayed taken.
            PoolFull: as many callers as allowed are waiting already.
            SessionClosed: the session is closed.
        """
        endpoint = self.endpoint(srv_type, srv_name, qos)
        started = self._loop.time()
        seconds = check_timeout(timeout, self._timeout)
        deadline = None if seconds is None else started + seconds
        try:
            client = self._lease_any(endpoint) or await self._queue(endpoint, deadline)
        except Expired:
            raise self._unreached(endpoint, started) from None
        leased = LeasedClient(self, endpoint, client)
        try:
            yield leased
        finally:
            leased.closed = True
            self._release(client)

    async def warm(self, srv_type: Any, srv_name: str, clients: int = 1) -> None:
        """Make clients ahead of the first call, and match them with the server if there is one.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            clients: how many there shall be, at most ``Limits.clients``.

        Raises:
            ValueError: more clients than ``Limits.clients`` allows.
            SessionClosed: the session is closed.
        """
        most = self._limits.clients
        if check_count("clients", clients, 1) > most:
            raise ValueError(f"clients={clients} is more than Limits.clients={most}")
        endpoint = self.endpoint(srv_type, srv_name, None)
        while len(endpoint.clients) < clients:
            self._open(endpoint)
            await asyncio.sleep(0)
        # A session that has just been opened does not know the graph yet.
        since = self._loop.time() if self._provided(endpoint) else self._opened
        with suppress(Expired):
            for client in tuple(endpoint.clients):
                await self._take_turn(endpoint, client, since + MATCHING)

    def statistics(self) -> PoolStatistics:
        """Take a snapshot of the pool, in all and for each service."""
        keys = {key: endpoint.statistics() for key, endpoint in self._endpoints.items()}
        names = KeyStatistics.__dataclass_fields__
        total = {name: sum(getattr(s, name) for s in keys.values()) for name in names}
        return PoolStatistics(**total, keys=keys)

    # What follows serves the session.

    def endpoint(self, srv_type: Any, srv_name: str, qos: Any) -> Endpoint:
        """Return the endpoint for a service, made at its first use.

        Raises:
            TypeError, ValueError: there is no such service type.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed, ContextShutdown: the session has ended.
        """
        shortcut = (srv_type, srv_name, qos if qos is None else id(qos))
        try:
            return self._shortcuts[shortcut]
        except (KeyError, TypeError):
            self.check_open()
        service = self._node.describe(srv_type, srv_name, qos)
        endpoint = self._endpoints.get(service.key)
        if endpoint is None:
            endpoint = self._endpoints[service.key] = Endpoint(service)
        if qos is None:
            self._shortcuts[shortcut] = endpoint
        return endpoint

    def request(self, endpoint: Endpoint, request: Any) -> Any:
        """Return a message of the request type, made from a mapping or None where it has to be.

        Raises:
            TypeError, ValueError: it does not fit.
        """
        if isinstance(request, endpoint.request_type):
            return request
        return self._node.make_request(endpoint.srv_type, request)

    async def call(
        self,
        endpoint: Endpoint,
        request: Any,
        timeout: float | None,
        wait: bool = True,
        retry: Retry | None = None,
        leased: Client | None = None,
    ) -> Any:
        """Call with the first client that has room, or with the one that the caller leases."""
        loop = self._loop
        started = loop.time()
        deadline = None if timeout is None else started + timeout
        call = Call(loop.create_future(), request, retry, leased is not None)
        entry = None
        try:
            if leased is not None:
                self.check_open()
                await self._take_turn(endpoint, leased, deadline)
                call.start(leased)
            elif (client := self._lease_any(endpoint)) is not None:
                call.start(client)
            else:
                if not wait:
                    await self._check_server(endpoint, started, deadline)
                self._join_line(endpoint, call.future, call.start)
            if deadline is not None:
                entry = self._deadlines.set(call.future, deadline)
            response = await call.future
        except BaseException as error:
            raise self._account(endpoint, call, error, started) from None
        finally:
            if entry is not None:
                entry[-1] = None
            if call.out:
                call.end()
            elif not call.started:
                self._leave_line(endpoint, call.future)
        endpoint.counts.completed += 1
        return response

    async def wait_for_server(self, endpoint: Endpoint, timeout: float | None) -> None:
        """Wait until a server is matched.

        Raises:
            ServiceUnavailable: none was, in time.
        """
        started = self._loop.time()
        deadline = None if timeout is None else started + timeout
        if not self.is_ready(endpoint):
            watcher: asyncio.Future[None] = self._loop.create_future()
            endpoint.watchers[watcher] = None
            try:
                await self._wait(endpoint, watcher, deadline)
            except Expired:
                raise self._unavailable(endpoint, self._loop.time() - started) from None
            finally:
                del endpoint.watchers[watcher]

    def is_ready(self, endpoint: Endpoint) -> bool:
        """Tell whether a client of this service is matched with a server."""
        self.check_open()
        if not endpoint.clients:
            self._open(endpoint)
        if self._look_timer is None:
            self._keep_looking()
        return any(self._is_matched(endpoint, client) for client in endpoint.clients)

    def graph_changed(self) -> None:
        """Look who is affected by a change of the ROS graph."""
        if self._ending is not None:
            return
        self._graph += 1
        self._look()
        if any(self._awaits_match(endpoint) for endpoint in self._endpoints.values()):
            self._look_soon()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End every call with the error ``ending`` makes, and destroy the clients; idempotent."""
        ended, self._ending = self._ending is not None, ending
        if ended:
            return
        for timer in (self._look_timer, self._evict_timer):
            if timer is not None:
                timer.cancel()
        self._deadlines.close()
        for endpoint in self._endpoints.values():
            callers: tuple[asyncio.Future[Any], ...] = (
                *endpoint.waiters,
                *(waiter for waiter, _, _ in endpoint.granted),
                *endpoint.watchers,
                *endpoint.turns,
            )
            for future in callers:
                if not future.done():
                    future.set_exception(ending())
            if endpoint.gone is not None:
                endpoint.gone.cancel()
            for client in endpoint.clients:
                client.fail(ending)
                client.close()
            endpoint.clients.clear()
        self._shortcuts.clear()

    # Who gets a client.

    def _lease_any(self, endpoint: Endpoint) -> Client | None:
        """Lease a matched client that has room, unless others came first."""
        if endpoint.waiters or endpoint.granted:
            return None
        if self._look_timer is None:
            self._keep_looking()
        for client in endpoint.clients:
            if client.graph == self._graph and client.room > 0:
                client.leases += 1
                return client
        return None

    def _assign(self, endpoint: Endpoint) -> bool:
        """Decide who gets what; True where a client has to be made first.

        1. A matched client with room goes to the first in line.
        2. Where the rest of the line is longer than what clients being matched will hold, and the
           limit allows, one more client is needed.
        3. Else the line waits: for a release, a late response, or a match.
        """
        while endpoint.waiters:
            coming = 0
            for client in endpoint.clients:
                if client.room > 0:
                    if self._is_matched(endpoint, client):
                        break
                    coming += client.room
            else:
                return len(endpoint.clients) < self._limits.clients and coming < len(
                    endpoint.waiters
                )
            waiter, go_on = endpoint.waiters.popitem(last=False)
            if not waiter.done():
                client.leases += 1
                if not endpoint.granted:
                    self._loop.call_soon(self._hand_out, endpoint)
                endpoint.granted.append((waiter, go_on, client))
        return False

    def _hand_out(self, endpoint: Endpoint) -> None:
        """Let those go on who were granted a client in the turn before, and still wait for it.

        Those whose server vanished meanwhile go back to the head of the line.
        """
        going: list[Grant] = []
        back: list[Grant] = []
        for grant in endpoint.granted:
            waiter, _, client = grant
            goes = not waiter.done() and self._is_matched(endpoint, client)
            (going if goes else back).append(grant)
        # Not before: that look may fail where the context is gone, and `end` has to find them.
        endpoint.granted = []
        for _, go_on, client in going:
            go_on(client)
        for waiter, go_on, client in reversed(back):
            client.leases -= 1
            if not waiter.done():
                endpoint.waiters[waiter] = go_on
                endpoint.waiters.move_to_end(waiter, last=False)
                self._look_soon()
        for _, _, client in back:
            client.on_room()

    def _serve_line(self, endpoint: Endpoint) -> None:
        for turn, client in tuple(endpoint.turns.items()):
            if client.room >= 0 and not turn.done() and self._is_matched(endpoint, client):
                turn.set_result(None)
        while self._assign(endpoint):
            self._open(endpoint)

    def _join_line(self, endpoint: Endpoint, waiter: asyncio.Future[Any], go_on: GoOn) -> None:
        """Stand in line for a client; ``go_on`` is called with it, unless the waiter is done then.

        Raises:
            PoolFull: the line is as long as allowed.
        """
        self.check_open()
        first = not endpoint.waiters
        endpoint.waiters[waiter] = go_on
        if first or len(endpoint.clients) < self._limits.clients:
            self._serve_line(endpoint)
            if self._awaits_match(endpoint):
                self._look_soon()
        if len(endpoint.waiters) > self._limits.waiting and waiter in endpoint.waiters:
            self._check_line(endpoint)

    def _leave_line(self, endpoint: Endpoint, waiter: asyncio.Future[Any]) -> None:
        endpoint.waiters.pop(waiter, None)
        self._evict_later()

    async def _queue(self, endpoint: Endpoint, deadline: float | None) -> Client:
        """Wait in line for a client.

        Raises:
            Expired: the deadline passed.
            PoolFull: the line is as long as allowed.
        """
        waiter: asyncio.Future[Client] = self._loop.create_future()
        try:
            self._join_line(endpoint, waiter, waiter.set_result)
            return await self._wait(endpoint, waiter, deadline)
        except BaseException:
            if waiter.done() and not waiter.cancelled() and waiter.exception() is None:
                self._release(waiter.result())
            raise
        finally:
            self._leave_line(endpoint, waiter)

    def _check_line(self, endpoint: Endpoint) -> None:
        """Raise `PoolFull` where the line is too long, with the one who has just joined it.

        Who gets a place as soon as a client is matched is not in anybody's way.
        """
        coming = sum(c.room for c in endpoint.clients if c.graph != self._graph)
        if len(endpoint.waiters) > self._limits.waiting + max(coming, 0):
            raise PoolFull(
                f"{endpoint.key.srv_name}: {len(endpoint.waiters) - 1} callers are waiting for a "
                f"client, Limits.waiting={self._limits.waiting} allows no more"
            )

    async def _check_server(
        self, endpoint: Endpoint, started: float, deadline: float | None
    ) -> None:
        """Wait for a match with a server that the graph shows, for a moment at the most.

        Raises:
            ServiceUnavailable: the graph shows none, or none was matched.
        """
        if self.is_ready(endpoint):
            return
        if not self._provided(endpoint):
            raise self._unavailable(endpoint, self._loop.time() - started)
        left = math.inf if deadline is None else max(0.0, deadline - self._loop.time())
        await self.wait_for_server(endpoint, min(MATCHING, left))

    async def _take_turn(self, endpoint: Endpoint, client: Client, deadline: float | None) -> None:
        """Wait until a leased client is matched, and abandoned requests leave it a place.

        Raises:
            Expired: the deadline passed.
        """
        if client.room >= 0 and self._is_matched(endpoint, client):
            return
        turn: asyncio.Future[None] = self._loop.create_future()
        endpoint.turns[turn] = client
        try:
            await self._wait(endpoint, turn, deadline)
        finally:
            del endpoint.turns[turn]

    async def _wait(
        self, endpoint: Endpoint, future: asyncio.Future[T], deadline: float | None
    ) -> T:
        """Wait for a future that `_look` or a release completes; `Expired` at the deadline."""
        if future.done():
            return future.result()
        if self._awaits_match(endpoint):
            self._look_soon()
        entry = None if deadline is None else self._deadlines.set(future, deadline)
        try:
            return await future
        finally:
            if entry is not None:
                entry[-1] = None
            self._evict_later()

    def _release(self, client: Client) -> None:
        client.leases -= 1
        client.on_room()

    # Making and destroying clients.

    def _open(self, endpoint: Endpoint) -> None:
        self.check_open()

        def on_room() -> None:
            if self._ending is not None:
                return
            if not client.leases:
                client.idle_since = self._loop.time()
            if self._evict_timer is None:
                self._evict_later()
            if endpoint.waiters or endpoint.turns:
                self._serve_line(endpoint)

        client = Client(
            lambda deliver: self._node.open_client(endpoint.service, deliver),
            self._limits,
            endpoint.counts,
            on_room,
        )
        endpoint.clients.append(client)
        endpoint.counts.created += 1
        self._evict_later()

    def _evict_later(self) -> None:
        if self._evict_timer is None and self._ending is None:
            self._evict_timer = self._loop.call_later(self._limits.idle, self._evict)

    def _evict(self) -> None:
        now = self._loop.time()
        soonest = math.inf
        for endpoint in self._endpoints.values():
            for client in tuple(endpoint.clients):
                if not client.is_idle or endpoint.has_callers:
                    continue
                ends = client.idle_since + self._limits.idle
                if ends > now:
                    soonest = min(soonest, ends)
                else:
                    endpoint.clients.remove(client)
                    client.close()
        waits = soonest < math.inf
        self._evict_timer = self._loop.call_at(soonest, self._evict) if waits else None

    # What the graph shows.

    def _is_matched(self, endpoint: Endpoint, client: Client) -> bool:
        if client.graph == self._graph:
            return True
        if not client.ready():
            return False
        client.graph = self._graph
        if not endpoint.warned and (servers := len(self._node.find_servers(endpoint.service))) > 1:
            endpoint.warned = True
            logger.warning(
                "%s: %d servers answer this name; the first response wins and the others are "
                "dropped",
                endpoint.key.srv_name,
                servers,
            )
        return True

    def _provided(self, endpoint: Endpoint) -> bool:
        return bool(self._node.find_servers(endpoint.service))

    def _awaits_match(self, endpoint: Endpoint) -> bool:
        """Tell whether somebody waits for a client to be matched, not just for a place."""
        return bool(endpoint.watchers) or (
            bool(endpoint.waiters or endpoint.turns)
            and any(client.graph != self._graph for client in endpoint.clients)
        )

    def _look_soon(self) -> None:
        """Look every few milliseconds at first: the match itself is not an event of the graph."""
        self._look_delay = FIRST_LOOK
        self._look_in(FIRST_LOOK)

    def _keep_looking(self) -> None:
        """Look at the context now and then, until a look finds that nothing is out."""
        if not self._node.graph_events:
            self._graph += 1
        self._look_in(CONTEXT_LOOK)

    def _look_in(self, delay: float) -> None:
        if self._look_timer is not None:
            self._look_timer.cancel()
        self._look_timer = self._loop.call_later(delay, self._on_look_timer)

    def _on_look_timer(self) -> None:
        if not self._node.ok():
            self._on_shutdown()
            return
        if not self._node.graph_events:
            self._graph += 1
        self._look()
        self._look_timer = None
        endpoints = self._endpoints.values()
        if any(self._awaits_match(endpoint) for endpoint in endpoints):
            self._look_delay = min(self._look_delay * 2, LAST_LOOK)
            self._look_in(self._look_delay)
        elif any(endpoint.is_busy for endpoint in endpoints):
            self._look_in(CONTEXT_LOOK)

    def _look(self) -> None:
        for endpoint in self._endpoints.values():
            if endpoint.has_callers:
                self._serve_line(endpoint)
                if endpoint.watchers and self.is_ready(endpoint):
                    for watcher in endpoint.watchers:
                        if not watcher.done():
                            watcher.set_result(None)
            if (
                endpoint.gone is None
                and endpoint.has_requests
                and not self._node.find_servers(endpoint.service)
            ):
                endpoint.gone = self._loop.call_later(LAST_WORDS, self._server_gone, endpoint)

    def _server_gone(self, endpoint: Endpoint) -> None:
        endpoint.gone = None
        if not self._node.find_servers(endpoint.service):
            self._graph += 1
            for client in endpoint.clients:
                client.fail(_Gone)

    # Errors.

    def check_open(self) -> None:
        """Raise what calls get, once the session has ended."""
        if self._ending is not None:
            raise self._ending()

    def _unavailable(self, endpoint: Endpoint, elapsed: float) -> CallError:
        type_name = endpoint.key.srv_type
        seen = self._node.explain_missing(endpoint.service)
        message = f"no server for {type_name} after {elapsed:.3g} s; {seen}"
        return endpoint.error(ServiceUnavailable, message, elapsed)

    def _unreached(self, endpoint: Endpoint, started: float) -> CallError:
        """Tell what a caller waited for in vain: a server, or a client where there is one."""
        elapsed = self._loop.time() - started
        if not self.is_ready(endpoint):
            return self._unavailable(endpoint, elapsed)
        message = (
            f"no client became free within {elapsed:.3g} s: {endpoint.counts.in_flight} requests "
            f"are in flight, {sum(c.abandoned for c in endpoint.clients)} abandoned ones still "
            f"hold a place"
        )
        return endpoint.error(QueueTimeout, message, elapsed)

    def _account(
        self, endpoint: Endpoint, call: Call, error: BaseException, started: float
    ) -> BaseException:
        """Count how a call failed, and say it in the caller's terms."""
        counts = endpoint.counts
        elapsed = self._loop.time() - started
        if isinstance(error, Expired) and not call.started:
            error = self._unreached(endpoint, started) if self._ending is None else self._ending()
        elif isinstance(error, Expired):
            message = f"sent, and not answered within {elapsed:.3g} s"
            error = endpoint.error(ResponseTimeout, message, elapsed)
        elif isinstance(error, _Gone):
            message = "the last server vanished while the request was out"
            error = endpoint.error(ServerGone, message, elapsed)
        elif not isinstance(error, asyncio.CancelledError | RosasyncError) and not self._node.ok():
            error = self._ending() if self._ending is not None else context_shut_down()
        if isinstance(error, asyncio.CancelledError):
            counts.cancelled += 1
            if call.started and not call.future.cancelled() and call.future.exception() is None:
                counts.late += 1  # Answered, but its task was cancelled before it woke up.
        elif isinstance(error, TimeoutError):
            counts.timed_out += 1
            logger.debug("%s", error)
        else:
            counts.failed += 1
            logger.debug("%s: %r", endpoint.key.srv_name, error)
        return error


class LeasedClient:
    """A client on loan: one call at a time, until the lease ends."""

    __slots__ = ("_busy", "_client", "_endpoint", "_pool", "closed")

    def __init__(self, pool: ClientPool, endpoint: Endpoint, client: Client) -> None:
        self._pool = pool
        self._endpoint = endpoint
        self._client = client
        self._busy = False
        self.closed = False

    def __repr__(self) -> str:
        state = "closed" if self.closed else "busy" if self._busy else "idle"
        return f"<LeasedClient {self._endpoint.key.srv_name} {state}>"

    async def call(
        self, request: Any = None, *, timeout: Timeout = ..., retry: Retry | None = None
    ) -> Any:
        """Call the service with this client; for the arguments and errors, see `Session.call`.

        Raises:
            UsageError: the lease is over, or another of its calls is under way.
        """
        if self.closed or self._busy:
            state = "is over" if self.closed else "carries one call at a time"
            raise UsageError(f"{self._endpoint.key.srv_name}: the lease {state}")
        self._busy = True
        try:
            pool, endpoint = self._pool, self._endpoint
            message = pool.request(endpoint, request)
            seconds = check_timeout(timeout, pool._timeout)
            return await pool.call(endpoint, message, seconds, retry=retry, leased=self._client)
        finally:
            self._busy = False


class _Gone(Exception):
    """The last server vanished."""


def context_shut_down() -> Exception:
    """Make the error that everybody gets when the context goes down."""
    return ContextShutdown("the rclpy context was shut down, or the node destroyed")
