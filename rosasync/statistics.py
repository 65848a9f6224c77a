"""Snapshots of what the pool, the servers and the session are doing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

__all__ = [
    "KeyStatistics",
    "PoolStatistics",
    "ServerStatistics",
    "ServiceKey",
    "SessionStatistics",
]


class ServiceKey(NamedTuple):
    """What the pool tells services apart by.

    Attributes:
        srv_name: the resolved name.
        srv_type: the type's name, ``"std_srvs/srv/SetBool"``.
        qos: what was given as QoS; None for the default.
    """

    srv_name: str
    srv_type: str
    qos: object = None


@dataclass(frozen=True, slots=True)
class KeyStatistics:
    """How a pool stands, for one service or in all.

    Attributes:
        clients: rclpy clients there are.
        idle: those of them with nothing to do.
        in_flight: requests somebody waits for an answer to.
        waiting: callers queued for a place.
        peak: most requests in flight at once (in all: the sum over the services).
        created: clients made so far.
        completed: calls answered.
        timed_out: calls whose deadline passed, in any phase.
        cancelled: calls cancelled, in any phase.
        failed: calls that ended in another error: the server gone, the session closed.
        abandoned: requests nobody waits for that still hold a place.
        late: responses nobody waited for any more.
        retried: requests sent again.
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
    late: int = 0
    retried: int = 0


@dataclass(frozen=True, slots=True)
class PoolStatistics(KeyStatistics):
    """How a pool stands in all, and for each service in ``keys``."""

    keys: Mapping[ServiceKey, KeyStatistics] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ServerStatistics:
    """How a server stands: three figures of now, then what happened so far.

    Attributes:
        srv_name: the resolved name.
        running: handlers under way.
        waiting: requests that wait for one.
        unanswered: requests taken and neither answered nor given up: running, waiting, deferred.
        taken: requests taken out of the middleware.
        responded: responses sent.
        deferred: handlers that returned without having responded.
        failed: handlers that raised, or returned something that is no response.
        rejected: requests that came when ``backlog`` others waited, answered or not.
        dropped: calls that never get an answer, for other reasons than a failed handler: past the
            backlog, unanswered when nobody held them any more, or when the server ended.
        undeliverable: responses that reached nobody, as far as can be seen.
    """

    srv_name: str
    running: int = 0
    waiting: int = 0
    unanswered: int = 0
    taken: int = 0
    responded: int = 0
    deferred: int = 0
    failed: int = 0
    rejected: int = 0
    dropped: int = 0
    undeliverable: int = 0


@dataclass(frozen=True, slots=True)
class SessionStatistics:
    """How a session stands.

    Attributes:
        bridge: ``"direct"`` or ``"executor"``.
        pool: what the pool's clients are doing.
        servers: what the session's servers are doing, those that are not closed.
    """

    bridge: str
    pool: PoolStatistics
    servers: tuple[ServerStatistics, ...] = ()
