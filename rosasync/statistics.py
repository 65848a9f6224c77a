"""Snapshots of what the pool, the servers and the session are doing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

__all__ = [
    "ActionServerStatistics",
    "KeyStatistics",
    "LatencyStatistics",
    "PoolStatistics",
    "ServerStatistics",
    "ServiceKey",
    "SessionStatistics",
]


class ServiceKey(NamedTuple):
    """The key that identifies a service in the pool.

    Attributes:
        srv_name: the resolved name.
        srv_type: the name of the type, ``"std_srvs/srv/SetBool"``.
        qos: the QoS that was given, in a form that can be compared; None for the default.
    """

    srv_name: str
    srv_type: str
    qos: object = None


@dataclass(frozen=True, slots=True)
class LatencyStatistics:
    """How long the answered calls of a service took, since the session was opened.

    A call takes from its start to its response, with the wait for a server and for a place in the
    window. All times are in seconds of the monotonic clock, and 0 if no call was answered. The
    percentiles are accurate to 1.6 %, and the maximum is exact.

    Attributes:
        count: the number of calls.
        p50: the median.
        p90: the 90th percentile: nine calls in ten took no longer.
        p99: the 99th percentile.
        max: the longest.
    """

    count: int = 0
    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0


@dataclass(frozen=True, slots=True)
class KeyStatistics:
    """A snapshot of the pool's statistics, for one service or in total.

    Attributes:
        clients: rclpy clients that exist now.
        idle: those of them without leases and outstanding requests.
        in_flight: outstanding requests whose callers still wait.
        waiting: callers that wait for a client.
        peak: the maximum of ``in_flight`` so far (in total: the sum over the services).
        created: clients created so far.
        completed: calls answered.
        timed_out: calls whose deadline passed, in any phase.
        cancelled: calls cancelled, in any phase.
        failed: calls that ended with another error, such as `ServerGone` or `SessionClosed`.
        abandoned: requests that still count as outstanding, although their callers have left, or
            although they were sent again.
        window: the maximum number of outstanding requests of all clients together, now.
        share: the places in the server's queue for each client, by the number of clients that the
            graph shows (in total: the sum over the services).
        servers: the servers that have the service's name, as the graph showed when it last changed.
        late: responses that arrived after their caller had left.
        retried: requests sent again.
        fast_retries: those of them that were sent again because later requests were answered.
        latency: how long the answered calls took (in total: the calls of all services together).
    """

    clients: int = 0
    idle: int = 0
    in_flight: int = 0
    waiting: int = 0
    peak: int = 0
    created: int = 0
    completed: int = 0
    timed_out: int = 0
    cancelled: int = 0
    failed: int = 0
    abandoned: int = 0
    window: int = 0
    share: int = 0
    servers: int = 0
    late: int = 0
    retried: int = 0
    fast_retries: int = 0
    latency: LatencyStatistics = LatencyStatistics()


@dataclass(frozen=True, slots=True)
class PoolStatistics(KeyStatistics):
    """A snapshot of the pool's statistics, in total, and for each service in ``keys``."""

    keys: Mapping[ServiceKey, KeyStatistics] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ServerStatistics:
    """A snapshot of a server's statistics.

    What stands before ``overloads`` is current. That and the counts after it are totals.

    Attributes:
        srv_name: the resolved name.
        running: handlers that run now.
        waiting: requests that wait for a handler.
        unanswered: requests taken and neither answered nor given up: running, waiting or deferred.
        oldest_age: for how many seconds the oldest of the waiting requests has waited.
        last_age: for how many seconds the request that was served last had waited.
        overloaded: whether the server is overloaded: requests wait for too long, or are dropped.
        overloads: how often that has begun.
        taken: requests taken out of the middleware.
        responded: responses sent.
        deferred: handlers that returned without having responded.
        failed: handlers that raised an exception, or returned something other than a response.
        rejected: requests dropped from a full backlog, whether ``on_overload`` answered them or
            not.
        dropped: calls left unanswered although no handler failed: beyond the backlog,
            garbage-collected, or unanswered when the server ended.
        abandoned: requests whose caller had left: dropped while they waited, or whose handler was
            cancelled. Always 0 without ``status=True``.
        undeliverable: responses whose client could not be reached, as far as the middleware shows.
    """

    srv_name: str
    running: int = 0
    waiting: int = 0
    unanswered: int = 0
    oldest_age: float = 0.0
    last_age: float = 0.0
    overloaded: bool = False
    overloads: int = 0
    taken: int = 0
    responded: int = 0
    deferred: int = 0
    failed: int = 0
    rejected: int = 0
    dropped: int = 0
    abandoned: int = 0
    undeliverable: int = 0


@dataclass(frozen=True, slots=True)
class ActionServerStatistics:
    """A snapshot of an action server's statistics.

    ``running``, ``waiting``, ``results`` and ``asking`` are current. The counts after them are
    totals.

    Attributes:
        action_name: the resolved name.
        running: goals whose handlers run now.
        waiting: accepted goals that wait for their turn.
        results: results that are kept, until ``result_timeout`` after the end of their goals.
        asking: requests for results that wait for the end of their goals.
        accepted: goals accepted.
        rejected: goals rejected: by ``on_goal``, because the server was busy, or because their id
            was in use.
        succeeded: goals whose handlers have returned their results.
        canceled: goals that have ended because they were cancelled, or replaced.
        aborted: goals whose handlers have failed, or were running when the server ended.
        feedback: feedback messages published.
    """

    action_name: str
    running: int = 0
    waiting: int = 0
    results: int = 0
    asking: int = 0
    accepted: int = 0
    rejected: int = 0
    succeeded: int = 0
    canceled: int = 0
    aborted: int = 0
    feedback: int = 0


@dataclass(frozen=True, slots=True)
class SessionStatistics:
    """A snapshot of a session's statistics.

    Attributes:
        bridge: ``"direct"`` or ``"executor"``.
        pool: the statistics of the client pool.
        servers: the statistics of each server that is not closed. The three services of an action
            are servers, too.
        action_servers: the statistics of each action server that is not closed.
    """

    bridge: str
    pool: PoolStatistics
    servers: tuple[ServerStatistics, ...] = ()
    action_servers: tuple[ActionServerStatistics, ...] = ()
