"""Limits, Retry and the options of a session, and the checks of their values."""

from __future__ import annotations

import inspect
import math
import numbers
import operator
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, SupportsFloat, SupportsIndex, TypeVar

from rosasync.tracing import Trace, check_trace
from rosasync.typing import Timeout

if TYPE_CHECKING:
    from rclpy.context import Context
    from rclpy.executors import Executor
    from rclpy.node import Node

__all__ = [
    "Limits",
    "Retry",
    "SessionOptions",
    "check_count",
    "check_flag",
    "check_hook",
    "check_limits",
    "check_retry",
    "check_seconds",
    "check_timeout",
    "check_wait",
]

HookT = TypeVar("HookT")


def check_seconds(name: str, value: SupportsFloat) -> float:
    """Return ``value`` as a float. It may be any real number except a bool.

    Raises:
        TypeError: it is not a number.
        ValueError: it is negative, not a number (NaN), or too large for a float.
    """
    number = _as_float(name, value, "a number of seconds")
    if number < 0:
        raise ValueError(f"{name} must not be negative, got {value!r} seconds")
    return number


def check_timeout(value: Timeout, default: float | None, name: str = "timeout") -> float | None:
    """Return a timeout in seconds, or None for no deadline; ``...`` gives ``default``.

    A negative timeout gives 0: it is the time that is left until a deadline, and it has run out.

    Raises:
        TypeError: it is not a number.
        ValueError: it is not a number (NaN), or too large for a float.
    """
    if value is ...:
        return default
    if value is None:
        return None
    seconds = _as_float(name, value, "a number of seconds or None")
    return None if seconds == math.inf else max(0.0, seconds)


def check_wait(value: bool | SupportsFloat) -> bool | float:
    """Return whether, or for how many seconds, to wait for a server.

    Zero and a negative number give False, as with `check_timeout`: no time is left.

    Raises:
        TypeError: it is neither a bool nor a number.
        ValueError: it is not a number (NaN), or too large for a float.
    """
    if isinstance(value, bool):
        return value
    seconds = _as_float("wait", value, "True, False or a number of seconds")
    return seconds if seconds > 0 else False


def check_count(name: str, value: SupportsIndex, least: int) -> int:
    """Return ``value`` as an int. It may be any whole number from ``least`` on, except a bool.

    Raises:
        TypeError: it is not a whole number.
        ValueError: it is smaller than ``least``.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise TypeError(f"{name} must be a whole number, not {type(value).__name__}")
    number = operator.index(value)
    if number < least:
        raise ValueError(f"{name} must be at least {least}, got {number}")
    return number


def check_flag(name: str, value: object) -> None:
    """Raise `TypeError` unless ``value`` is a bool."""
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, not {type(value).__name__}")


def check_hook(name: str, hook: HookT, *arguments: str) -> HookT:
    """Return a hook, or None.

    Args:
        name: its name.
        hook: the hook.
        arguments: the names of what it is called with; none if it may take different ones.

    Raises:
        TypeError: it is not callable, or not with these arguments.
    """
    if hook is None:
        return hook
    if not callable(hook):
        raise TypeError(f"{name} must be callable, not {type(hook).__name__}")
    if arguments:
        try:
            inspect.signature(hook).bind(*arguments)
        except ValueError:
            pass  # Some functions of C have no signature.
        except TypeError:
            shape = f"{name}({', '.join(arguments)})"
            raise TypeError(f"{name} is called as {shape}, and {hook!r} cannot be") from None
    return hook


def check_limits(limits: Limits) -> None:
    """Raise ``TypeError`` unless this is a `Limits`."""
    if not isinstance(limits, Limits):
        raise TypeError(f"limits must be a rosasync.Limits, not {type(limits).__name__}")


def check_retry(value: object) -> None:
    """Raise `TypeError` unless ``value`` is a `Retry` or None."""
    if value is not None and not isinstance(value, Retry):
        raise TypeError(
            f"retry must be a rosasync.Retry, such as Retry(attempts=3), not {type(value).__name__}"
        )


def _as_float(name: str, value: SupportsFloat, expected: str) -> float:
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} must be {expected}, not {type(value).__name__}")
    try:
        number = float(value)
    except OverflowError:
        raise ValueError(f"{name} is too large: use math.inf or None for no limit") from None
    if math.isnan(number):
        raise ValueError(f"{name} must be {expected}, not NaN")
    return number


@dataclass(frozen=True, slots=True)
class Limits:
    """What the pool may use for each service.

    By default one client carries at most ten requests at once, because a stock server queues ten
    and silently drops the rest. All clients of the server share that queue, including those of
    other processes. So each client gets its share: ``server_depth`` divided by the number of
    clients that the graph shows, and at least one.

    ``Limits(clients=8, in_flight=1)`` gives each call a client of its own.

    Attributes:
        clients: the maximum number of rclpy clients for each service.
        in_flight: the maximum number of outstanding requests for each client. A request that was
            cancelled or timed out counts until the server has dealt with it, see ``grace``.
        waiting: the maximum number of callers that wait for each service; further callers get
            `PoolFull`.
        idle: seconds after which an unused client is destroyed.
        grace: the maximum number of seconds for which a cancelled or timed-out request counts as
            outstanding, because it may still be in the server's queue. It ends sooner if its late
            response or the response to a later request arrives, if its server is gone, or if
            callers wait and no response arrives for some time.
        server_depth: the depth of the server's queue, which all clients of the name share; a larger
            ``in_flight`` says that it is deeper. None if it is deep enough for all of them, so that
            each may use its whole ``in_flight``.

    Raises:
        TypeError: a value is not a number.
        ValueError: a value is out of range.
    """

    clients: int = 1
    in_flight: int = 10
    waiting: int = 10_000
    idle: float = 300.0
    grace: float = 5.0
    server_depth: int | None = 10

    def __post_init__(self) -> None:
        _set(self, "clients", check_count("clients", self.clients, 1))
        _set(self, "in_flight", check_count("in_flight", self.in_flight, 1))
        _set(self, "waiting", check_count("waiting", self.waiting, 0))
        _set(self, "idle", check_seconds("idle", self.idle))
        _set(self, "grace", check_seconds("grace", self.grace))
        if self.server_depth is not None:
            _set(self, "server_depth", check_count("server_depth", self.server_depth, 1))

    def share(self, clients: int) -> int:
        """Return each client's share of the server's queue, for so many clients in the graph."""
        if self.server_depth is None:
            return self.in_flight
        return max(1, max(self.server_depth, self.in_flight) // max(1, clients))

    def window(self, clients: int) -> int:
        """Return the window of each client, given the number of clients in the graph."""
        return min(self.in_flight, self.share(clients))


@dataclass(frozen=True, slots=True)
class Retry:
    """When to send an unanswered request again; only for services that may run twice.

    It is sent again after a delay, at once if three later requests of the same client were
    answered, or at once to the next server if its servers have vanished. The first response to any
    attempt wins. The deadline still covers the whole call.

    Attributes:
        attempts: the maximum number of times the request is sent, including the first. They start
            anew with the next server, unless this is 1.
        after: seconds to wait for a response before the second attempt. Each delay is longer at
            random, by up to a quarter.
        backoff: the factor by which this wait grows with each further attempt.
        budget: how many requests of the service may be sent again for each call, 0.2 for one in
            five. Ten a second may be sent again besides. ``math.inf`` is no limit.
        verify: ``async def verify()``, for services that may not run twice: called before the
            request is sent again, to find out whether it has run. A response, or a mapping of its
            fields, is the call's answer; None sends it again; an exception is the call's error. It
            runs within the call's time.

    Raises:
        TypeError: a value is not a number, or ``verify`` is not callable.
        ValueError: a value is out of range.
    """

    attempts: int = 3
    after: float = 0.5
    backoff: float = 2.0
    budget: float = 0.2
    verify: Callable[[], Awaitable[Any]] | None = None

    def __post_init__(self) -> None:
        _set(self, "attempts", check_count("attempts", self.attempts, 1))
        _set(self, "after", check_seconds("after", self.after))
        _set(self, "backoff", _as_float("backoff", self.backoff, "a number"))
        if self.backoff < 1:
            raise ValueError(f"backoff must be at least 1, got {self.backoff!r}")
        _set(self, "budget", _as_float("budget", self.budget, "a number"))
        if self.budget < 0:
            raise ValueError(f"budget must not be negative, got {self.budget!r}")
        if self.verify is not None and not callable(self.verify):
            raise TypeError(
                "verify must be a coroutine function without arguments, not "
                f"{type(self.verify).__name__}"
            )


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
    trace: Trace | None = None

    def __post_init__(self) -> None:
        if self.bridge not in ("auto", "direct", "executor"):
            raise ValueError(f"bridge must be 'auto', 'direct' or 'executor', not {self.bridge!r}")
        if self.introspection not in ("off", "metadata", "contents"):
            raise ValueError(
                f"introspection must be 'off', 'metadata' or 'contents', not {self.introspection!r}"
            )
        check_limits(self.limits)
        if self.timeout is not None:
            check_seconds("timeout", self.timeout)
        _set(self, "timeout", check_timeout(self.timeout, None))
        _set(self, "busy_poll", check_seconds("busy_poll", self.busy_poll))
        check_trace(self.trace)


def _set(frozen: object, name: str, value: object) -> None:
    object.__setattr__(frozen, name, value)
