"""ServiceType: the shape of a service class, from which calls take their types."""

from __future__ import annotations

from types import EllipsisType
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

__all__ = [
    "RequestT",
    "RequestT_co",
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
RequestT_co = TypeVar("RequestT_co", covariant=True)
ResponseT_co = TypeVar("ResponseT_co", covariant=True)

Timeout: TypeAlias = float | EllipsisType | None
"""Seconds; None for no deadline; ``...``, or left out, for the callee's default."""


class ServiceType(Protocol[RequestT_co, ResponseT_co]):
    """A service class, such as ``std_srvs.srv.SetBool``; every generated one fits.

    Its members are methods, because type checkers accept a nested class for a method, but not all
    of them for a property or an attribute.
    """

    def Request(self) -> RequestT_co:
        """Make a request."""
        ...

    def Response(self) -> ResponseT_co:
        """Make a response."""
        ...
