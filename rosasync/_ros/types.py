"""ROS types by their names.

ROS packages are imported when one of their types is asked for. Every function may be called from
any thread.
"""

from __future__ import annotations

import difflib
import functools
import importlib
import re
import reprlib
from collections.abc import Iterable, Sequence
from typing import Any

__all__ = ["Unquoted", "hint", "load_definitions", "service_type", "shown", "type_name"]


class Unquoted(str):
    """A scalar of YAML without quotes, whose type is that of its field."""

    __slots__ = ()


def service_type(srv_type: type[Any] | str) -> type[Any]:
    """Resolve a service class from a class or a name.

    Args:
        srv_type: a service class, or its name, ``"std_srvs/srv/SetBool"``.

    Raises:
        TypeError: neither a service class nor a string.
        ValueError: the name is malformed, or no such service is installed.
    """
    if isinstance(srv_type, str):
        return _service_named(srv_type)
    if not isinstance(srv_type, type):
        raise TypeError(
            "expected a service class, or its name such as 'std_srvs/srv/SetBool', "
            f"got {shown(srv_type)}"
        )
    if not _is_service(srv_type):
        raise TypeError(f"{type_name(srv_type)} is not a service: it has no Request and Response")
    return srv_type


def type_name(srv_type: type[Any]) -> str:
    """Return the name of a service, request, response or message class as ROS writes it.

    ``"std_srvs/srv/SetBool"``, ``"std_srvs/srv/SetBool_Request"``, ``"geometry_msgs/msg/Pose"``.
    For a class that is not from ROS, it is the Python name.
    """
    package, *inner = srv_type.__module__.split(".")
    if inner and inner[0] in ("msg", "srv", "action"):
        return f"{package}/{inner[0]}/{srv_type.__name__}"
    if package == "builtins":
        return srv_type.__qualname__
    return f"{srv_type.__module__}.{srv_type.__qualname__}"


def shown(value: object) -> str:
    """Describe a value for an error: by its type, and by the value itself if it is a scalar."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {type_name(value)}"
    if isinstance(value, Unquoted):
        return reprlib.repr(value)[1:-1] or "nothing"
    name = type_name(type(value))
    return f"{name} {reprlib.repr(value)}" if isinstance(value, str | bytes | float | int) else name


_SERVICE_NAME = re.compile(r"([a-z]\w*)/srv/([a-z]\w*)", re.ASCII | re.IGNORECASE)


@functools.cache
def _service_named(name: str) -> type[Any]:
    match = _SERVICE_NAME.fullmatch(name)
    if match is None:
        raise ValueError(
            f"{name!r} does not name a service type: expected 'package/srv/Type', "
            "such as 'std_srvs/srv/SetBool'"
        )
    package, wanted = match.groups()
    services: dict[str, type[Any]] = {
        key: found
        for key, found in load_definitions(package, "srv", "services", name).items()
        if _is_service(found)
    }
    if wanted not in services:
        similar = difflib.get_close_matches(wanted, services, n=1)
        names = hint([f"{package}/srv/{found}" for found in similar], services)
        raise ValueError(f"{name!r}: no such service in {package}{names}")
    return services[wanted]


def load_definitions(package: str, kind: str, noun: str, name: str) -> dict[str, Any]:
    """Import what a package defines of one kind.

    Args:
        package: the package.
        kind: its module, ``srv`` or ``action``.
        noun: what the module has, for the errors.
        name: the name of the type that is looked for, for the errors.

    Raises:
        ValueError: the package is not installed, or has none.
    """
    try:
        return vars(importlib.import_module(f"{package}.{kind}"))
    except ModuleNotFoundError as error:
        if error.name == package:
            raise ValueError(
                f"{name!r}: the package {package!r} is not installed for this Python, "
                "or its workspace is not sourced"
            ) from None
        if error.name == f"{package}.{kind}":
            raise ValueError(f"{name!r}: the package {package!r} has no {noun}") from None
        raise


def _is_service(candidate: object) -> bool:
    return (
        isinstance(candidate, type)
        and isinstance(getattr(candidate, "Request", None), type)
        and isinstance(getattr(candidate, "Response", None), type)
    )


def hint(similar: Sequence[str], all_names: Iterable[str]) -> str:
    """Return the end of an error about a name that does not exist: what was meant, or what is."""
    if similar:
        return f"; did you mean {similar[0]!r}?"
    return f"; it has {', '.join(all_names) or 'none'}"
