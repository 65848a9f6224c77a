"""The shapes of service and action classes, from which calls and goals take their types."""

from __future__ import annotations

from types import EllipsisType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

__all__ = [
    "ActionType",
    "FeedbackT",
    "FeedbackT_co",
    "GoalT",
    "RequestT",
    "ResponseT",
    "ResponseT_co",
    "ResultT",
    "ResultT_co",
    "ServiceType",
    "Timeout",
]

if TYPE_CHECKING:
    # If a service type is given by its name, these are inferred as Any (PEP 696).
    from typing_extensions import TypeVar as DefaultTypeVar

    RequestT = DefaultTypeVar("RequestT", default=Any)
    ResponseT = DefaultTypeVar("ResponseT", default=Any)
    GoalT = DefaultTypeVar("GoalT", default=Any)
    ResultT = DefaultTypeVar("ResultT", default=Any)
    FeedbackT = DefaultTypeVar("FeedbackT", default=Any)
else:
    RequestT = TypeVar("RequestT")
    ResponseT = TypeVar("ResponseT")
    GoalT = TypeVar("GoalT")
    ResultT = TypeVar("ResultT")
    FeedbackT = TypeVar("FeedbackT")
ResultT_co = TypeVar("ResultT_co", covariant=True)
FeedbackT_co = TypeVar("FeedbackT_co", covariant=True)
ResponseT_co = TypeVar("ResponseT_co", covariant=True)

Timeout: TypeAlias = float | EllipsisType | None
"""Seconds; None for no deadline; ``...``, or left out, for the callee's default."""


# Invariant in the request: otherwise a checker infers a common base of the service's request and
# the request that is passed, and accepts any message.
class ServiceType(Protocol[RequestT, ResponseT_co]):  # type: ignore[misc]
    """A service class, such as ``std_srvs.srv.SetBool``; every generated one fits.

    Its members are methods, because type checkers accept a nested class for a method, but not all
    of them for a property or an attribute.
    """

    def Request(self) -> RequestT:
        """Make a request."""
        ...

    def Response(self) -> ResponseT_co:
        """Make a response."""
        ...


class ActionType(Protocol[GoalT, ResultT_co, FeedbackT_co]):  # type: ignore[misc]
    """An action class, such as ``nav2_msgs.action.NavigateToPose``; every generated one fits."""

    def Goal(self) -> GoalT:
        """Make a goal."""
        ...

    def Result(self) -> ResultT_co:
        """Make a result."""
        ...

    def Feedback(self) -> FeedbackT_co:
        """Make a feedback message."""
        ...
