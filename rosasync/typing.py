"""ServiceType: the shape of a service class, from which calls take their types."""

from __future__ import annotations

from types import EllipsisType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

__all__ = [
    "RequestT",
    "ResponseT",
    "ResponseT_co",
    "ServiceType",
    "Timeout",
]

if TYPE_CHECKING:
    # With a type by its name, a generic class of rosasync is one of Any (PEP 696).
    from typing_extensions import TypeVar as DefaultTypeVar

    RequestT = DefaultTypeVar("RequestT", default=Any)
    ResponseT = DefaultTypeVar("ResponseT", default=Any)
else:
    RequestT = TypeVar("RequestT")
    ResponseT = TypeVar("ResponseT")
ResponseT_co = TypeVar("ResponseT_co", covariant=True)

Timeout: TypeAlias = float | EllipsisType | None
"""Seconds; None for no deadline; ``...``, or left out, for the callee's default."""


# Invariant in the request: otherwise a checker finds a common base of the service's request and of
# the one that is passed, and accepts any message.
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
