"""Waiting for the graph: until it seems complete, or until it shows a service."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import rosasync
from rosasync._cli.errors import CliError, Code
from rosasync._ros.types import service_type

__all__ = [
    "POLL",
    "explain_type",
    "find_type",
    "is_hidden",
    "meant_instead",
    "no_server",
    "resolve",
    "settle",
    "srv_class",
    "wait_for_types",
]

ANNOUNCEMENT = 3.5
"""Seconds after which every process has announced itself; they do so every 3 s (Fast DDS)."""

QUIET = 0.3
"""Seconds without a change after which the graph seems complete."""

POLL = 0.02
"""Seconds between two looks at the graph."""


async def settle(session: rosasync.Session, wait: float | None = None) -> None:
    """Wait until the graph seems complete.

    That is so when every process of this machine has been discovered and nothing has changed for
    a moment, or after 3.5 s.

    Args:
        session: an open session.
        wait: seconds to wait instead.
    """
    from rosasync._ros.inspect import all_discovered, graph_state

    if wait is not None:
        await asyncio.sleep(wait)
        return
    end = time.monotonic() + ANNOUNCEMENT
    state, since = graph_state(session.node), time.monotonic()
    while (now := time.monotonic()) < end:
        await asyncio.sleep(POLL)
        latest = graph_state(session.node)
        if latest != state:
            state, since = latest, now
        elif now - since > QUIET and all_discovered(session.node):
            return


async def wait_for_types(session: rosasync.Session, name: str, timeout: float | None) -> list[str]:
    """Wait until the graph shows a server of this name; return the types, none after a timeout."""
    from rosasync._ros.inspect import served_types

    resolved = resolve(session, name)
    end = None if timeout is None else time.monotonic() + timeout
    while not (types := served_types(session.node, resolved)):
        if end is not None and time.monotonic() >= end:
            break
        await asyncio.sleep(POLL)
    return types


async def find_type(session: rosasync.Session, name: str, timeout: float | None) -> str:
    """Return the type of a service, from the graph.

    Raises:
        CliError: there is no server in time, or the servers have several types.
        rosasync.InvalidServiceName: ROS does not allow the name.
    """
    types = await wait_for_types(session, name, timeout)
    if not types:
        raise no_server(session, name, timeout)
    if len(types) > 1:
        raise CliError(f"{name} is served with several types: give one of {', '.join(types)}")
    return types[0]


def no_server(session: rosasync.Session, name: str, timeout: float | None) -> CliError:
    """Return the error for a service that has no server; it says what may be meant instead."""
    within = "" if timeout is None else f" within {timeout:g} s"
    missing = f"{name}: no server of this name{within}"
    return CliError(f"{missing}{meant_instead(session, name)}", Code.NO_SERVER)


def meant_instead(session: rosasync.Session, name: str) -> str:
    """Return what may be meant by a service without a server, and what to try, as a text's end."""
    from rosasync._ros.graph import describe_similar
    from rosasync._ros.inspect import actions, services

    resolved = resolve(session, name)
    if resolved in actions(session.node):
        return f"; it is an action. Try: rosasync action info {name}"
    own = f"{session.node.get_fully_qualified_name()}/"
    others = {n: types for n, types in services(session.node).items() if not n.startswith(own)}
    similar = describe_similar(others, resolved)
    return f"{f'; there are {similar}' if similar else ''}. Try: rosasync why {name}"


def srv_class(name: str) -> Any:
    """Return the class of a service type.

    Raises:
        CliError: there is no such type here; the message says where types come from.
    """
    try:
        return service_type(name)
    except ValueError as error:
        raise CliError(explain_type(name, error)) from None


def explain_type(name: str, error: ValueError) -> str:
    """Return the message for a type that cannot be loaded."""
    if "is not installed" not in str(error):
        return str(error)
    package = name.partition("/")[0]
    debian = f"ros-<distribution>-{package.replace('_', '-')}"
    return (
        f"the package {package} of {name} is not installed for this Python. Types come from apt "
        f"(apt install {debian}), a wheel (pip install {debian}) or a colcon workspace "
        "(source install/setup.bash)"
    )


def resolve(session: rosasync.Session, name: str, kind: str = "service") -> str:
    """Return the full name of a service, or of an action.

    Raises:
        rosasync.InvalidServiceName: ROS does not allow the name.
    """
    from rosasync._ros.names import resolve_name

    return resolve_name(session.node, name, kind)


def is_hidden(name: str) -> bool:
    """Return whether a name is hidden: one of its parts starts with ``_``."""
    return "/_" in name
