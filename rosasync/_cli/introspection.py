"""Switches service introspection on, on nodes that have the parameter for it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any

import rosasync
from rosasync._cli.graph import POLL, settle
from rosasync._cli.output import note

__all__ = ["switched_on"]

PARAMETERS = {
    "server": "service_configure_introspection",
    "client": "client_configure_introspection",
}
"""The parameters of the ROS demo nodes, which other nodes have copied."""

CONTENTS = "contents"
STRING = 4
"""PARAMETER_STRING of rcl_interfaces/msg/ParameterType."""

TIMEOUT = 3.0

HOW = """\
no server or client of {name} publishes introspection, so nothing can be seen. Switch it on with
  rclpy     service.configure_introspection(node.get_clock(), qos_profile_system_default,
                                            ServiceIntrospectionState.CONTENTS)
  rclcpp    service->configure_introspection(node->get_clock(), rclcpp::SystemDefaultsQoS(),
                                             RCL_SERVICE_INTROSPECTION_CONTENTS)
  rosasync  Session(introspection="contents")"""


@asynccontextmanager
async def switched_on(session: rosasync.Session, name: str) -> AsyncIterator[None]:
    """Switch introspection of a service on if no process publishes it, and back at the end.

    If it cannot be switched on, say how.
    """
    switched: list[tuple[str, str, str]] = []
    try:
        await _switch_all(session, name, switched)
        yield
    finally:
        for node, parameter, before in switched:
            # Also after a second Ctrl-C, as far as that lets it.
            with suppress(rosasync.RosasyncError, asyncio.CancelledError):
                await _set(session, node, parameter, before)
                note(f"{node}: {parameter} is '{before}' again")


async def _switch_all(
    session: rosasync.Session, name: str, switched: list[tuple[str, str, str]]
) -> None:
    """Switch introspection on unless it is published.

    Args:
        session: an open session.
        name: the service.
        switched: gets the node, the parameter and its value before, of what has to be set back.
    """
    from rosasync._ros.inspect import client_endpoints, count_publishers, server_endpoints

    await settle(session)
    if count_publishers(session.node, f"{name}/_service_event"):
        return
    endpoints = [("server", e) for e in server_endpoints(session.node, name)]
    endpoints += [("client", e) for e in client_endpoints(session.node, name)]
    done = False
    for role, node in dict.fromkeys((role, e.node) for role, e in endpoints if e.node):
        parameter = PARAMETERS[role]
        try:
            before = await _value_of(session, node, parameter)
            if before is None:
                continue
            # Noted first: a request that is interrupted, or not answered, may still be carried out.
            switched.append((node, parameter, before))
            await _set(session, node, parameter, CONTENTS)
        except rosasync.RosasyncError as error:
            note(f"{node}: {parameter} could not be set: {error}")
        else:
            done = True
            note(f"{node}: {parameter} set to '{CONTENTS}' until the end")
    if not (done and await _is_published(session, name)):
        note(HOW.format(name=name))


async def _is_published(session: rosasync.Session, name: str) -> bool:
    """Wait until introspection of the service is published, and return whether it is."""
    from rosasync._ros.inspect import count_publishers

    end = time.monotonic() + TIMEOUT
    while not count_publishers(session.node, f"{name}/_service_event"):
        if time.monotonic() > end:
            return False
        await asyncio.sleep(POLL)
    return True


async def _value_of(session: rosasync.Session, node: str, parameter: str) -> str | None:
    """Return the value of a node's parameter; None if it has no such text, or no parameters."""
    from rosasync._ros.inspect import served_types

    if not served_types(session.node, f"{node}/get_parameters"):
        return None
    answer: Any = await session.call(
        "rcl_interfaces/srv/GetParameters",
        f"{node}/get_parameters",
        {"names": [parameter]},
        timeout=TIMEOUT,
    )
    if not answer.values or answer.values[0].type != STRING:
        return None
    return str(answer.values[0].string_value)


async def _set(session: rosasync.Session, node: str, parameter: str, value: str) -> None:
    await session.call(
        "rcl_interfaces/srv/SetParameters",
        f"{node}/set_parameters",
        {"parameters": [{"name": parameter, "value": {"type": STRING, "string_value": value}}]},
        timeout=TIMEOUT,
    )
