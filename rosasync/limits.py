"""What a pool may use, when a call is sent again, and the numbers that tell how it went."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import EllipsisType
from typing import NamedTuple, TypeAlias

__all__ = [
    "KeyStatistics",
    "Limits",
    "PoolStatistics",
    "Retry",
    "ServerStatistics",
    "ServiceKey",
    "SessionStatistics",
]

Timeout: TypeAlias = float | EllipsisType | None
"""Seconds, None for no deadline, ``...`` for the default of whoever is asked."""


def check_seconds(name: str, value: float) -> float:
    """Return ``value`` as a float.

    Raises:
        TypeError: it is not a number.
        ValueError: it is negative or not a number (NaN).
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number of seconds, not {type(value).__name__}")
    if math.isnan(value) or value < 0:
        raise ValueError(f"{name} must not be negative, got {value!r} seconds")
    return float(value)


def check_timeout(value: Timeout, default: float | None) -> float | None:
    """Return a timeout in seconds, None for no deadline; ``...`` gives ``default``.

    Raises:
        TypeError: it is not a number.
        ValueError: it is negative or not a number (NaN).
    """
    if value is ...:
        return default
    if value is None:
        return None
    return check_seconds("timeout", value) if value != math.inf else None


def check_count(name: str, value: int, least: int) -> int:
    """Return ``value``, a whole number of at least ``least``.

    Raises:
        TypeError: it is not a whole number.
        ValueError: it is smaller than ``least``.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} must be a whole number, not {type(value).__name__}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")
    return value


@dataclass(frozen=True, slots=True)
class Limits:
    """What the pool may use for each service.

    The default is one client that carries ten requests at once: the depth of a stock server's
    queue, past which the middleware drops requests and says nothing. ``Limits(clients=8,
    in_flight=1)`` claims clients exclusively instead.

    Attributes:
        clients: most rclpy clients for each (url, type).
        in_flight: most unanswered requests for each client.
        waiting: most callers queued for each (url, type); ``PoolFull`` beyond it.
        idle: seconds after which an unused client is destroyed.
        grace: seconds for which an abandoned request (cancelled, timed out) keeps its place in the
            window, where no late response frees it sooner: it is still in the server's queue.

    Raises:
        TypeError: a value of the wrong kind.
        ValueError: a value out of range.
    """

    clients: int = 1
    in_flight: int = 10
    waiting: int = 10_000
    idle: float = 300.0
    grace: float = 5.0

    def __post_init__(self) -> None:
        check_count("clients", self.clients, 1)
        check_count("in_flight", self.in_flight, 1)
        check_count("waiting", self.waiting, 0)
        check_seconds("idle", self.idle)
        check_seconds("grace", self.grace)


@dataclass(frozen=True, slots=True)
class Retry:
    """When to send an unanswered request again: only for services that may run twice.

    The first answer to any attempt wins; the deadline stays the whole call's.

    Attributes:
        attempts: how often the request is sent at most, the first time included.
        after: seconds to wait for an answer before the second attempt.
        backoff: by how much that wait grows with every further attempt.

    Raises:
        TypeError: a value of the wrong kind.
        ValueError: a value out of range.
    """

    attempts: int = 3
    after: float = 0.5
    backoff: float = 2.0

    def __post_init__(self) -> None:
        check_count("attempts", self.attempts, 1)
        check_seconds("after", self.after)
        if check_seconds("backoff", self.backoff) < 1:
            raise ValueError(f"backoff must be at least 1, got {self.backoff!r}")


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
