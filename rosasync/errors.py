"""The errors rosasync raises.

::

    RosasyncError
    ├── SessionClosed         the session was closed, before or during the call
    ├── ContextShutdown       the rclpy context was shut down, or the node destroyed
    ├── UsageError            (RuntimeError) wrong loop or thread, responding twice
    ├── InvalidServiceName    (ValueError)
    ├── PoolFull              more callers wait than Limits.waiting allows
    └── CallError             .srv_name .srv_type .elapsed
        ├── ServiceUnavailable   (TimeoutError) no server
        ├── QueueTimeout         (TimeoutError) the deadline passed while waiting for a client
        ├── ResponseTimeout      (TimeoutError) sent, and not answered in time
        ├── ServerGone           (ConnectionError) every server vanished before it answered
        ├── HandlerFailed        .error_type .error_message: the server's handler raised
        ├── ServerOverloaded     the server dropped the request, because too many waited
        └── GoalError            .goal_id: a goal of an action that did not succeed
            ├── GoalRejected     the server did not accept it, or does not know it
            ├── GoalAborted      .result: the server gave up
            ├── GoalCanceled     .result: it was cancelled
            ├── GoalTimeout      (TimeoutError) not accepted, or not ended, in time
            └── CancelRejected   the server does not cancel it

Besides these, a message of the wrong type is a ``TypeError`` and a value out of range a
``ValueError``, both before anything is sent.
"""

from __future__ import annotations

from functools import partial
from typing import Any
from uuid import UUID

__all__ = [
    "CallError",
    "CancelRejected",
    "ContextShutdown",
    "GoalAborted",
    "GoalCanceled",
    "GoalError",
    "GoalRejected",
    "GoalTimeout",
    "HandlerFailed",
    "InvalidServiceName",
    "PoolFull",
    "QueueTimeout",
    "ResponseTimeout",
    "RosasyncError",
    "ServerGone",
    "ServerOverloaded",
    "ServiceUnavailable",
    "SessionClosed",
    "UsageError",
]


NO_GOAL = UUID(int=0)
"""The goal of an error that a handler raises: the client's error has its own."""


class RosasyncError(Exception):
    """The base of all errors that rosasync defines."""


class SessionClosed(RosasyncError):
    """The session, or the server, has been closed."""


class ContextShutdown(RosasyncError):
    """The rclpy context was shut down, or the session's node destroyed."""

    def __init__(
        self,
        message: str = "the rclpy context was shut down, or the node destroyed: open a new session",
    ) -> None:
        super().__init__(message)


class UsageError(RosasyncError, RuntimeError):
    """A call from the wrong loop or thread, or in a state that does not allow it."""


class InvalidServiceName(RosasyncError, ValueError):
    """ROS does not allow this service name."""


class PoolFull(RosasyncError):
    """More callers wait for the service than ``Limits.waiting`` allows."""


class CallError(RosasyncError):
    """A call that was not answered. It can be copied and pickled.

    Attributes:
        srv_name: the resolved service name.
        srv_type: the service type's name, ``"std_srvs/srv/SetBool"``.
        elapsed: seconds from the start of the call to the error.
    """

    def __init__(self, message: str, *, srv_name: str, srv_type: str, elapsed: float) -> None:
        super().__init__(message)
        self.srv_name = srv_name
        self.srv_type = srv_type
        self.elapsed = elapsed

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are copied from their positional arguments, and these are keywords.
        make = partial(
            type(self), srv_name=self.srv_name, srv_type=self.srv_type, elapsed=self.elapsed
        )
        return make, self.args, self.__dict__


class ServiceUnavailable(CallError, TimeoutError):
    """There is no server; the message describes what the graph shows instead."""


class QueueTimeout(CallError, TimeoutError):
    """The deadline passed while the caller waited for a client. Nothing was sent."""


class ResponseTimeout(CallError, TimeoutError):
    """The request was sent and not answered in time. The server may still run it."""


class ServerGone(CallError, ConnectionError):
    """Every server that could answer vanished, or closed, while the request was outstanding."""


class HandlerFailed(CallError):
    """The handler raised, says a server that was created with ``status=True``.

    Attributes:
        error_type: the type of the exception, ``"ValueError"`` or ``"module.Name"``; empty if the
            handler dropped the call unanswered.
        error_message: its message; empty if the server keeps it to itself.
    """

    def __init__(
        self,
        message: str,
        *,
        srv_name: str,
        srv_type: str,
        elapsed: float,
        error_type: str = "",
        error_message: str = "",
    ) -> None:
        super().__init__(message, srv_name=srv_name, srv_type=srv_type, elapsed=elapsed)
        self.error_type = error_type
        self.error_message = error_message


class ServerOverloaded(CallError):
    """The server dropped the request unrun, says a server that was created with ``status=True``."""


class GoalError(CallError):
    """A goal of an action that did not succeed.

    The handler of an action server raises it with its message and, if it has one, its result.

    Attributes:
        srv_name: the action's name.
        srv_type: the action type's name, ``"test_msgs/action/Fibonacci"``.
        elapsed: seconds from the start of the goal to the error.
        goal_id: the goal's UUID.
        result: what the server sent as the result; None if there is none.
    """

    def __init__(
        self,
        message: str = "",
        *,
        srv_name: str = "",
        srv_type: str = "",
        elapsed: float = 0.0,
        goal_id: UUID = NO_GOAL,
        result: Any = None,
    ) -> None:
        super().__init__(message, srv_name=srv_name, srv_type=srv_type, elapsed=elapsed)
        self.goal_id = goal_id
        self.result = result

    def __reduce__(self) -> tuple[Any, ...]:
        make = partial(
            type(self),
            srv_name=self.srv_name,
            srv_type=self.srv_type,
            elapsed=self.elapsed,
            goal_id=self.goal_id,
        )
        return make, self.args, self.__dict__


class GoalRejected(GoalError):
    """The server did not accept the goal, or does not know it."""


class GoalAborted(GoalError):
    """The server gave up; `result` is what it sent."""


class GoalCanceled(GoalError):
    """The goal was cancelled, by this client or another; `result` is what the server sent."""


class GoalTimeout(GoalError, TimeoutError):
    """The deadline passed before the goal was accepted, or before it ended."""


class CancelRejected(GoalError):
    """The server does not cancel the goal."""
