"""Limits, Retry, timeouts, and the checks of their values."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Literal, TypeAlias

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node

__all__ = [
    "Limits",
    "Retry",
    "SessionOptions",
    "Timeout",
    "check_count",
    "check_seconds",
    "check_timeout",
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


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """The arguments of a `Session`, checked."""

    node: str | Node
    context: Context | None
    executor: Executor | None
    bridge: Literal["auto", "direct", "executor"]
    limits: Limits
    timeout: float | None
    busy_poll: float
    introspection: Literal["off", "metadata", "contents"]

    def __post_init__(self) -> None:
        if self.introspection not in ("off", "metadata", "contents"):
            raise ValueError(
                f"introspection must be 'off', 'metadata' or 'contents', not {self.introspection!r}"
            )
        if self.bridge not in ("auto", "direct", "executor"):
            raise ValueError(f"bridge must be 'auto', 'direct' or 'executor', not {self.bridge!r}")
        if not isinstance(self.limits, Limits):
            raise TypeError(f"limits must be a rosasync.Limits, not {type(self.limits).__name__}")
        object.__setattr__(self, "timeout", check_timeout(self.timeout, None))
        object.__setattr__(self, "busy_poll", check_seconds("busy_poll", self.busy_poll))
