"""Interface types by their names: classes, fields, constants, comments. Needs no rclpy."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosasync._ros.fields import FieldType
from rosasync._ros.message_fields import field_types
from rosasync._ros.middleware import prefixes
from rosasync._ros.types import type_name

__all__ = ["Field", "Part", "constants", "fields", "installed_types", "parts"]

_NAME = re.compile(r"(?P<package>\w+)/(?P<kind>msg|srv|action)/(?P<name>\w+)", re.ASCII)
_PARTS = {
    "msg": (("", ""),),
    "srv": (("request", "Request"), ("response", "Response")),
    "action": (("goal", "Goal"), ("result", "Result"), ("feedback", "Feedback")),
}
_DEFINED = re.compile(r"^\s*[\w/]+(?:<=\d+)?(?:\[[^\]]*\])?\s+(?P<name>[a-z]\w*)(?P<rest>.*)$")


@dataclass(frozen=True, slots=True)
class Part:
    """One of the messages of an interface: ``"request"`` of a service, ``""`` of a message."""

    name: str
    message_type: type[Any]


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message: its name, its type, and its comment in the definition."""

    name: str
    type: FieldType
    comment: str


def parts(interface: str) -> list[Part]:
    """Return the messages of an interface, ``"std_srvs/srv/SetBool"``.

    Raises:
        ValueError: the name is malformed, or there is no such type here.
    """
    match = _NAME.fullmatch(interface)
    if match is None:
        raise ValueError(
            f"{interface!r} does not name a type: expected 'package/srv/Type' (or msg, action), "
            "such as 'std_srvs/srv/SetBool'"
        )
    package, kind, name = match.groups()
    found = getattr(_module(package, kind, interface), name, None)
    if found is None:
        raise ValueError(f"{interface!r}: the package {package!r} has no such type")
    return [
        Part(label, getattr(found, attribute) if attribute else found)
        for label, attribute in _PARTS[kind]
    ]


def fields(message_type: type[Any]) -> list[Field]:
    """Return the fields of a message class, in order.

    Raises:
        TypeError: not a message class.
    """
    comments = _comments(type_name(message_type))
    return [
        Field(name, kind, comments.get(name, ""))
        for name, kind in field_types(message_type).items()
    ]


def constants(message_type: type[Any]) -> dict[str, Any]:
    """Return the constants of a message class."""
    # The generated metaclass puts the constants into the namespace of the class, and the defaults.
    namespace = type(message_type).__prepare__(message_type.__name__, ())
    return {name: value for name, value in namespace.items() if not name.endswith("__DEFAULT")}


def installed_types(kind: str = "srv") -> list[str]:
    """Return the names of the installed interfaces of a kind: ``srv``, ``msg`` or ``action``."""
    found = set()
    for prefix in prefixes():
        for package in (prefix / "share/ament_index/resource_index/rosidl_interfaces").glob("*"):
            for line in package.read_text().splitlines():
                if line.startswith(f"{kind}/"):
                    found.add(f"{package.name}/{line.rpartition('.')[0]}")
    return sorted(found)


def _module(package: str, kind: str, interface: str) -> Any:
    try:
        return importlib.import_module(f"{package}.{kind}")
    except ModuleNotFoundError as error:
        if error.name == package:
            raise ValueError(
                f"{interface!r}: the package {package!r} is not installed for this Python"
            ) from None
        if error.name == f"{package}.{kind}":
            raise ValueError(
                f"{interface!r}: the package {package!r} has no {kind} types"
            ) from None
        raise


@functools.cache
def _comments(message: str) -> dict[str, str]:
    """Return the comments of the fields, as far as the definition of the type is installed."""
    if message.count("/") != 2:  # not from ROS
        return {}
    package, kind, name = message.split("/")
    base, _, part = name.partition("_")
    for prefix in prefixes():
        file = prefix / "share" / package / kind / f"{base}.{kind}"
        if file.is_file():
            return dict(_read_comments(_section(file, kind, part)))
    return {}


def _section(file: Path, kind: str, part: str) -> str:
    sections = re.split(r"^---.*$", file.read_text(), flags=re.MULTILINE)
    names = [attribute for _, attribute in _PARTS[kind]]
    index = names.index(part) if part in names else 0
    return sections[index] if index < len(sections) else ""


def _read_comments(definition: str) -> Iterator[tuple[str, str]]:
    """Yield each field with the comment above it and the one behind it."""
    above: list[str] = []
    for line in definition.splitlines():
        code, hash_sign, comment = line.partition("#")
        match = _DEFINED.match(code)
        if match and not match["rest"].lstrip().startswith("="):
            behind = [comment.strip()] if hash_sign else []
            yield match["name"], " ".join([*above, *behind])
        if hash_sign and not code.strip():
            above.append(comment.strip())
        else:
            above.clear()
