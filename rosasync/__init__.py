"""rosasync: ROS 2 service calls, native to asyncio."""

from __future__ import annotations

from rosasync.errors import (
    CallError,
    ContextShutdown,
    InvalidServiceName,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    RosasyncError,
    ServerGone,
    ServiceUnavailable,
    SessionClosed,
    UsageError,
)
from rosasync.futures import wrap_future
from rosasync.limits import (
    KeyStatistics,
    Limits,
    PoolStatistics,
    Retry,
    ServiceKey,
    SessionStatistics,
)
from rosasync.pool import ClientPool, LeasedClient
from rosasync.session import ServiceClient, Session

__all__ = [
    "CallError",
    "ClientPool",
    "ContextShutdown",
    "InvalidServiceName",
    "KeyStatistics",
    "LeasedClient",
    "Limits",
    "PoolFull",
    "PoolStatistics",
    "QueueTimeout",
    "ResponseTimeout",
    "Retry",
    "RosasyncError",
    "ServerGone",
    "ServiceClient",
    "ServiceKey",
    "ServiceUnavailable",
    "Session",
    "SessionClosed",
    "SessionStatistics",
    "UsageError",
    "wrap_future",
]
