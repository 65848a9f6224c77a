"""rosasync: ROS 2 service calls, native to asyncio."""

from __future__ import annotations

from rosasync._actions.goal import Goal
from rosasync._actions.proxy import ActionState, AsyncActionProxy
from rosasync._actions.server import ActionServer
from rosasync._actions.server_goal import ServerGoal
from rosasync._actions.status import GoalStatus
from rosasync._client.pool import ClientPool, LeasedClient
from rosasync._client.service_watch import ServiceState
from rosasync._core.futures import wrap_future
from rosasync._core.portal import Portal
from rosasync._core.proxy import AsyncServiceProxy, ProxyState
from rosasync._ros.json_schema import json_schema
from rosasync._ros.messages import to_dict, to_message
from rosasync._server.server import RequestInfo, ServiceCall, ServiceServer
from rosasync.errors import (
    CallError,
    CancelRejected,
    ContextShutdown,
    GoalAborted,
    GoalCanceled,
    GoalError,
    GoalRejected,
    GoalTimeout,
    HandlerFailed,
    InvalidServiceName,
    PoolFull,
    QueueTimeout,
    ResponseTimeout,
    RosasyncError,
    ServerGone,
    ServerOverloaded,
    ServiceUnavailable,
    SessionClosed,
    UsageError,
)
from rosasync.options import Limits, Retry
from rosasync.session import ServiceClient, Session
from rosasync.statistics import (
    ActionServerStatistics,
    KeyStatistics,
    LatencyStatistics,
    PoolStatistics,
    ServerStatistics,
    ServiceKey,
    SessionStatistics,
)
from rosasync.tracing import CallEnd, CallPhase, Trace, TracedCall
from rosasync.typing import ActionType, ServiceType

__all__ = [
    "ActionServer",
    "ActionServerStatistics",
    "ActionState",
    "ActionType",
    "AsyncActionProxy",
    "AsyncServiceProxy",
    "CallEnd",
    "CallError",
    "CallPhase",
    "CancelRejected",
    "ClientPool",
    "ContextShutdown",
    "Goal",
    "GoalAborted",
    "GoalCanceled",
    "GoalError",
    "GoalRejected",
    "GoalStatus",
    "GoalTimeout",
    "HandlerFailed",
    "InvalidServiceName",
    "KeyStatistics",
    "LatencyStatistics",
    "LeasedClient",
    "Limits",
    "PoolFull",
    "PoolStatistics",
    "Portal",
    "ProxyState",
    "QueueTimeout",
    "RequestInfo",
    "ResponseTimeout",
    "Retry",
    "RosasyncError",
    "ServerGoal",
    "ServerGone",
    "ServerOverloaded",
    "ServerStatistics",
    "ServiceCall",
    "ServiceClient",
    "ServiceKey",
    "ServiceServer",
    "ServiceState",
    "ServiceType",
    "ServiceUnavailable",
    "Session",
    "SessionClosed",
    "SessionStatistics",
    "Trace",
    "TracedCall",
    "UsageError",
    "json_schema",
    "to_dict",
    "to_message",
    "wrap_future",
]
