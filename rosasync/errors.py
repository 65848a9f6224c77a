"""The errors rosasync raises.

::

    RosasyncError
    ├── SessionClosed         you closed it; also what callers still waiting get
    ├── ContextShutdown       the rclpy context went down under the session
    ├── UsageError            (RuntimeError) wrong loop or thread, responding twice
    ├── InvalidServiceName    (ValueError)
    ├── PoolFull              more callers waiting than Limits.waiting
    └── CallError             .srv_name .srv_type .elapsed
        ├── ServiceUnavailable   (TimeoutError) no server
        ├── QueueTimeout         (TimeoutError) the deadline passed while waiting for a client
        ├── ResponseTimeout      (TimeoutError) sent, and not answered in time
        └── ServerGone           (ConnectionError) the last server vanished, the request being out

Besides these, a message of the wrong type is a ``TypeError`` and a value out of range a
``ValueError``, both before anything is sent.
"""

from __future__ import annotations

__all__ = [
    "CallError",
    "ContextShutdown",
    "InvalidServiceName",
    "PoolFull",
    "QueueTimeout",
    "ResponseTimeout",
    "RosasyncError",
    "ServerGone",
    "ServiceUnavailable",
    "SessionClosed",
    "UsageError",
]


class RosasyncError(Exception):
    """The root of every error rosasync defines."""


class SessionClosed(RosasyncError):
    """The session, or the server asked, was closed by its owner."""


class ContextShutdown(RosasyncError):
    """The rclpy context, or a borrowed node, went down under the session."""


class UsageError(RosasyncError, RuntimeError):
    """A call from the wrong loop or thread, or one that the object's state forbids."""


class InvalidServiceName(RosasyncError, ValueError):
    """A service name that ROS does not allow."""


class PoolFull(RosasyncError):
    """As many callers as ``Limits.waiting`` allows are already queued for the service."""


class CallError(RosasyncError):
    """A call that was not answered.

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


class ServiceUnavailable(CallError, TimeoutError):
    """No server is there; the message says what was seen instead."""


class QueueTimeout(CallError, TimeoutError):
    """The deadline passed while the caller waited for a client; nothing was sent."""


class ResponseTimeout(CallError, TimeoutError):
    """The request was sent and not answered in time; the server may still run it."""


class ServerGone(CallError, ConnectionError):
    """The last server of the service vanished while the request was out."""
