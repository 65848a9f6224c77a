"""Requests and responses for the tests. Each response identifies its request."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__all__ = ["ECHO", "answer_to", "fill", "request_of", "response_to", "service_class"]

ECHO = "diagnostic_msgs/srv/AddDiagnostics"
"""A service type that can echo: a string in the request, a string in the response."""


def service_class(name: str) -> Any:
    """Return the class of a service type, such as ``"std_srvs/srv/SetBool"``."""
    package, _, short = name.split("/")
    return getattr(importlib.import_module(f"{package}.srv"), short)


def request_of(text: str) -> Any:
    """Return a request of the type ``ECHO`` that carries ``text``."""
    return service_class(ECHO).Request(load_namespace=text)


def answer_to(response: Any) -> str:
    """Return the text that a response of the type ``ECHO`` carries."""
    return str(response.message)


def response_to(request: Any) -> str:
    """Return the part of a request that its response repeats, for the types used here."""
    for field in ("load_namespace", "names", "data", "map_url"):
        if hasattr(request, field):
            value = getattr(request, field)
            return ",".join(value) if field == "names" else str(value)
    return ""


def fill(request: Any, response: Any) -> Any:
    """Fill a new response so that it identifies its request."""
    text = response_to(request)
    filler = _FILLERS.get(type(response).__name__.removesuffix("_Response"))
    if filler is not None:
        filler(response, text)
    return response


def _message(response: Any, text: str) -> None:
    response.success = True
    response.message = text


def _values(response: Any, text: str) -> None:
    from rcl_interfaces.msg import ParameterType, ParameterValue

    response.values = [
        ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=name)
        for name in text.split(",")
    ]


_FILLERS: dict[str, Callable[[Any, str], None]] = {
    "AddDiagnostics": _message,
    "SetBool": _message,
    "Trigger": _message,
    "GetParameters": _values,
}
