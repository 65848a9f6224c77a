"""Types for annotations: what a service class looks like to a type checker."""

from __future__ import annotations

from typing import Protocol, TypeVar

__all__ = ["RequestT", "RequestT_co", "ResponseT", "ResponseT_co", "ServiceType"]

RequestT = TypeVar("RequestT")
ResponseT = TypeVar("ResponseT")
RequestT_co = TypeVar("RequestT_co", covariant=True)
ResponseT_co = TypeVar("ResponseT_co", covariant=True)


class ServiceType(Protocol[RequestT_co, ResponseT_co]):
    """A generated service class, such as ``std_srvs.srv.SetBool``.

    Its members have the shape of methods, which the classes inside a generated service class fit
    both for pyright and for mypy.
    """

    def Request(self) -> RequestT_co:
        """Create a request."""

    def Response(self) -> ResponseT_co:
        """Create a response."""
