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
from dataclasses import dataclass
from typing import Any

__all__ = ["Unquoted", "action_type", "hint", "service_type", "shown", "type_name"]


class Unquoted(str):
    """A scalar of YAML without quotes, whose type is that of its field."""

    __slots__ = ()


@dataclass(frozen=True)
class _Kind:
    """Services or actions: how their classes are named, and what tells that a class is one."""

    noun: str
    a: str
    folder: str
    parts: tuple[str, ...]
    shape: str
    example: str
    uses: str

    def fits(self, candidate: object) -> bool:
        """Return whether this is a class of the kind."""
        return isinstance(candidate, type) and all(
            isinstance(getattr(candidate, part, None), type) for part in self.parts
        )

    def check(self, wanted: object) -> None:
        """Raise `TypeError` unless this is a class of the kind."""
        if not isinstance(wanted, type):
            raise TypeError(
                f"expected {self.a} class, or its name such as {self.example!r}, "
                f"got {shown(wanted)}"
            )
        if not self.fits(wanted):
            raise TypeError(
                f"{type_name(wanted)} is not {self.a}: it has no {self.shape}{_instead(wanted)}"
            )


_SERVICE = _Kind(
    "service",
    "a service",
    "srv",
    ("Request", "Response"),
    "Request and Response",
    "std_srvs/srv/SetBool",
    "session.call and session.serve",
)
_ACTION = _Kind(
    "action",
    "an action",
    "action",
    ("Goal", "Result", "Feedback", "Impl"),
    "Goal, Result and Feedback",
    "nav2_msgs/action/NavigateToPose",
    "session.act and session.serve_action",
)


def service_type(srv_type: type[Any] | str) -> type[Any]:
    """Resolve a service class from a class or a name.

    Args:
        srv_type: a service class, or its name, ``"std_srvs/srv/SetBool"``.

    Raises:
        TypeError: neither a service class nor a string.
        ValueError: the name is malformed, or no such service is installed.
    """
    if isinstance(srv_type, str):
        return _named(_SERVICE, srv_type)
    _SERVICE.check(srv_type)
    return srv_type


def action_type(wanted: type[Any] | str) -> type[Any]:
    """Resolve an action class from a class or a name.

    Args:
        wanted: an action class, or its name, ``"test_msgs/action/Fibonacci"``.

    Raises:
        TypeError: neither an action class nor a string.
        ValueError: the name is malformed, or no such action is installed.
    """
    if isinstance(wanted, str):
        return _named(_ACTION, wanted)
    _ACTION.check(wanted)
    return wanted


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


@functools.cache
def _named(kind: _Kind, name: str) -> type[Any]:
    match = re.fullmatch(rf"([a-z]\w*)/{kind.folder}/([a-z]\w*)", name, re.ASCII | re.IGNORECASE)
    if match is None:
        raise ValueError(
            f"{name!r} does not name {kind.a} type: expected 'package/{kind.folder}/Type', "
            f"such as {kind.example!r}{_meant(kind, name)}"
        )
    package, wanted = match.groups()
    known: dict[str, type[Any]] = {
        key: found for key, found in _load(kind, package, name).items() if kind.fits(found)
    }
    if wanted not in known:
        similar = difflib.get_close_matches(wanted, known, n=1)
        names = hint([f"{package}/{kind.folder}/{found}" for found in similar], known)
        raise ValueError(f"{name!r}: no such {kind.noun} in {package}{names}")
    return known[wanted]


def _instead(wanted: type[Any]) -> str:
    """Return the end of an error about a class of another kind: what it is."""
    for kind in (_SERVICE, _ACTION):
        if kind.fits(wanted):
            return f"; it is {kind.a}, for {kind.uses}"
        whole, _, part = type_name(wanted).rpartition("_")
        if f"/{kind.folder}/" in whole and part in kind.parts:
            return f"; it is the {part} of {whole}: pass {whole.rpartition('/')[2]} itself"
    return ""


def _meant(kind: _Kind, name: str) -> str:
    """Return the end of an error about a malformed name of a type: what was probably meant."""
    if name.startswith(("/", "~")):
        return "; the type comes before the name"
    for other in (_SERVICE, _ACTION):
        if other is not kind and re.fullmatch(rf"\w+/{other.folder}/\w+", name):
            return f"; it is {other.a}, for {other.uses}"
    match = re.fullmatch(rf"([a-z]\w*)[/.](?:{kind.folder}[/.])?([A-Z]\w*)", name, re.ASCII)
    return f"; did you mean '{match[1]}/{kind.folder}/{match[2]}'?" if match else ""


def _load(kind: _Kind, package: str, name: str) -> dict[str, Any]:
    """Import what a package defines of one kind."""
    try:
        return vars(importlib.import_module(f"{package}.{kind.folder}"))
    except ModuleNotFoundError as error:
        if error.name == package:
            raise ValueError(
                f"{name!r}: the package {package!r} is not installed for this Python, "
                "or its workspace is not sourced"
            ) from None
        if error.name == f"{package}.{kind.folder}":
            raise ValueError(f"{name!r}: the package {package!r} has no {kind.noun}s") from None
        raise


def hint(similar: Sequence[str], all_names: Iterable[str]) -> str:
    """Return the end of an error about a name that does not exist: what was meant, or what is."""
    if similar:
        return f"; did you mean {similar[0]!r}?"
    return f"; it has {', '.join(all_names) or 'none'}"
