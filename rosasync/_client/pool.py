"""ClientPool: one set of clients for each service, shared by all callers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Collection
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Generic, overload

from rosasync._client.latency import summarize
from rosasync._client.service import MATCH_TIMEOUT, ServicePool
from rosasync._client.service_watch import ServiceState, watch_servers
from rosasync._core.aio import Deadlines
from rosasync._core.text import count
from rosasync._status.listener import Listener
from rosasync.errors import UsageError
from rosasync.options import check_count, check_limits, check_timeout
from rosasync.statistics import KeyStatistics, PoolStatistics, ServiceKey
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rclpy.qos import QoSProfile

    from rosasync._client.client import Client
    from rosasync._client.graph_watch import GraphWatch
    from rosasync._core.arguments import ArgumentChecker
    from rosasync._core.ports import NodePort, Service
    from rosasync.options import Limits, Retry
    from rosasync.tracing import Tracing
    from rosasync.typing import ServiceType, Timeout

__all__ = ["ClientPool", "LeasedClient"]


class ClientPool:
    """Leases clients for each service, and takes them back after each call.

    The pool of a session is ``session.pool``. Use it on the loop's thread.
    """

    def __init__(
        self,
        node: NodePort,
        arguments: ArgumentChecker,
        limits: Limits,
        timeout: float | None,
        watch: GraphWatch,
        tracing: Tracing,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = node
        self._arguments = arguments
        self._limits = limits
        self._timeout = timeout
        self._tracing = tracing
        self._opened = self._loop.time()
        # None for the session's limits.
        self._services: dict[tuple[ServiceKey, Limits | None], ServicePool] = {}
        # Repeated calls find their service here by the type and name as given, unresolved.
        self._shortcuts: dict[tuple[Any, str], ServicePool] = {}
        self._deadlines = Deadlines()
        self.listener = Listener(node)
        self._watch = watch
        self._watchers: set[asyncio.Event] = set()
        self._ending: Callable[[], Exception] | None = None

    def __repr__(self) -> str:
        total = self.statistics()
        return (
            f"<ClientPool {count(len(self._services), 'service')}, "
            f"{count(total.clients, 'client')}, "
            f"{total.idle} idle, {total.in_flight} in flight, {total.waiting} waiting>"
        )

    @overload
    def lease(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
        timeout: Timeout = ...,
    ) -> AbstractAsyncContextManager[LeasedClient[RequestT, ResponseT]]: ...

    @overload
    def lease(
        self,
        srv_type: str,
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
        timeout: Timeout = ...,
    ) -> AbstractAsyncContextManager[LeasedClient[Any, Any]]: ...

    @asynccontextmanager
    async def lease(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos: QoSProfile | None = None,
        timeout: Timeout = ...,
    ) -> AsyncIterator[LeasedClient[Any, Any]]:
        """Lease a client, and always return it to the pool, also after an error or a cancellation.

        A lease takes one place in the client's window: it carries one call at a time.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            qos: a ``QoSProfile``; None for the service default.
            timeout: seconds to wait for a client, None for no deadline; if left out, the session's.

        Raises:
            ServiceUnavailable: there was no server in time.
            QueueTimeout: no client became free in time.
            PoolFull: more callers wait than `Limits.waiting` allows.
            SessionClosed, ContextShutdown: the session has ended.
        """
        service = self.service(srv_type, srv_name, qos)
        client = await service.lease(check_timeout(timeout, self._timeout))
        leased: LeasedClient[Any, Any] = LeasedClient(
            self._arguments, service, client, self._timeout
        )
        try:
            yield leased
        finally:
            leased.end()

    async def warm(
        self, srv_type: ServiceType[Any, Any] | str, srv_name: str, clients: int = 1
    ) -> None:
        """Create clients before the first call, and match them with the server if there is one.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            clients: the number of clients to have, at most `Limits.clients`.

        Raises:
            ValueError: more clients than `Limits.clients` allows.
            SessionClosed, ContextShutdown: the session has ended.
        """
        clients = check_count("clients", clients, 1)
        if clients > self._limits.clients:
            raise ValueError(
                f"clients={clients} is more than Limits.clients={self._limits.clients}: raise the "
                "limit of the session, Session(limits=Limits(clients=…))"
            )
        service = self.service(srv_type, srv_name, None)
        # A session that was just opened does not know the graph yet.
        since = self._loop.time() if service.is_provided() else self._opened
        await service.warm(clients, since + MATCH_TIMEOUT)

    def statistics(self) -> PoolStatistics:
        """Take a snapshot of the pool, in total and for each service."""
        # A copy, because `__repr__` may run in any thread, and a loop over the original would fail.
        services = tuple(self._services.copy().values())
        pools: dict[ServiceKey, list[ServicePool]] = {}
        for service in services:
            pools.setdefault(service.service.key, []).append(service)
        keys = {key: _statistics_of(its_pools) for key, its_pools in pools.items()}
        latency = summarize(service.latencies for service in services)
        return PoolStatistics(**_sums(keys.values()), latency=latency, keys=keys)

    # For the session.

    def service(self, srv_type: Any, srv_name: str, qos: QoSProfile | None) -> ServicePool:
        """Return the pool of one service, created at its first use.

        Raises:
            TypeError, ValueError: the service type does not exist, or the QoS is not a
                ``QoSProfile``.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed, ContextShutdown: the session has ended.
        """
        if qos is None:
            try:
                return self._shortcuts[srv_type, srv_name]
            except (KeyError, TypeError):
                pass
        pool = self.service_of(self._arguments.service(srv_type, srv_name, qos))
        if qos is None:
            self._shortcuts[srv_type, srv_name] = pool
        return pool

    def service_of(self, service: Service) -> ServicePool:
        """Return the pool of one service, created at its first use.

        Raises:
            SessionClosed, ContextShutdown: the session has ended.
        """
        return self._pool_of(service, None)

    def limited(self, service: Service, limits: Limits) -> ServicePool:
        """Return the pool of one service with other limits than the session's.

        Raises:
            TypeError: not `Limits`.
            SessionClosed, ContextShutdown: the session has ended.
        """
        check_limits(limits)
        # A deeper window needs a deeper history of the client, or the middleware drops responses.
        deep = replace(service, in_flight=limits.in_flight)
        return self._pool_of(deep, None if limits == self._limits else limits)

    def _pool_of(self, service: Service, limits: Limits | None) -> ServicePool:
        self.check_open()
        pool = self._services.get((service.key, limits))
        if pool is None:
            pool = ServicePool(
                service,
                self._node,
                limits or self._limits,
                self._watch,
                self._deadlines,
                self._tracing,
                self.listener,
            )
            self._services[service.key, limits] = pool
            self._watch.add(pool)
        return pool

    async def watch(self, service: Service) -> AsyncIterator[ServiceState]:
        """Yield the state of a service, now and after each change; see `Session.watch_service`."""
        changed = asyncio.Event()
        self._watchers.add(changed)
        try:
            async for state in watch_servers(service, self._node, changed, self.check_open):
                yield state
        finally:
            self._watchers.discard(changed)

    def graph_changed(self) -> None:
        """Make services and actions check the ROS graph again, because it has changed."""
        self._watch.changed()
        self._wake_watchers()

    def _wake_watchers(self) -> None:
        for changed in self._watchers:
            changed.set()

    def check_open(self) -> None:
        """Raise the error that calls get, once the session has ended."""
        if self._ending is not None:
            raise self._ending()

    def end(self, ending: Callable[[], Exception]) -> None:
        """End every call with the error that ``ending`` makes, and destroy the clients.

        If it is called again, calls made afterwards get the new error.
        """
        self._ending = ending
        self._watch.close()
        self._deadlines.close()
        for service in self._services.values():
            service.end(ending)
        self.listener.close()
        self._shortcuts.clear()
        self._wake_watchers()


def _statistics_of(pools: list[ServicePool]) -> KeyStatistics:
    """Return the statistics of one service, whose pools differ in their limits."""
    if len(pools) == 1:
        return pools[0].statistics()
    statistics = [pool.statistics() for pool in pools]
    sums = _sums(statistics)
    # All of them see the same servers.
    sums["servers"] = max(one.servers for one in statistics)
    return KeyStatistics(**sums, latency=summarize(pool.latencies for pool in pools))


def _sums(statistics: Collection[KeyStatistics]) -> dict[str, int]:
    names = [name for name in KeyStatistics.__dataclass_fields__ if name != "latency"]
    return {name: sum(getattr(one, name) for one in statistics) for name in names}


class LeasedClient(Generic[RequestT, ResponseT]):
    """A client on lease: one call at a time, until the lease ends."""

    __slots__ = ("_arguments", "_busy", "_client", "_service", "_timeout", "closed")

    def __init__(
        self,
        arguments: ArgumentChecker,
        service: ServicePool,
        client: Client,
        timeout: float | None,
    ) -> None:
        self._arguments = arguments
        self._service = service
        self._client = client
        self._timeout = timeout
        self._busy = False
        self.closed = False

    def __repr__(self) -> str:
        state = "closed" if self.closed else "busy" if self._busy else "idle"
        return f"<LeasedClient {self._service.service.key.srv_name} {state}>"

    async def call(
        self,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        retry: Retry | None = None,
    ) -> ResponseT:
        """Call the service with this client; for the arguments and errors, see `Session.call`.

        Raises:
            UsageError: the lease has ended, or another call of it is in progress.
        """
        if self.closed or self._busy:
            name = self._service.service.key.srv_name
            problem = "is over" if self.closed else "carries one call at a time"
            raise UsageError(f"{name}: the lease {problem}: take another one")
        self._busy = True
        try:
            service = self._service
            message, seconds = self._arguments.check_call(
                service.service, request, timeout, self._timeout, retry=retry
            )
            response: ResponseT = await service.call(
                message, seconds, retry=retry, lease=self._client
            )
            return response
        finally:
            self._busy = False
            if self.closed:
                self._client.release()

    def end(self) -> None:
        """End the lease. A call that is still in progress keeps the place until it ends."""
        self.closed = True
        if not self._busy:
            self._client.release()
