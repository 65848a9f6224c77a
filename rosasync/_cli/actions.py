"""What the commands of ``rosasync action`` share: their arguments, and actions in the graph."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

import rosasync
from rosasync._cli.completion import complete_action_names, complete_action_types
from rosasync._cli.errors import CliError, Code
from rosasync._cli.graph import POLL, explain_type, resolve
from rosasync._ros.types import action_type

if TYPE_CHECKING:
    from rosasync._ros.inspect import Endpoint

__all__ = [
    "ActionName",
    "ActionType",
    "OptionalActionType",
    "action_class",
    "actions_of",
    "endpoints_of",
    "find_type",
    "meant_instead",
    "no_server",
    "wait_for_types",
]

ActionName = Annotated[
    str,
    typer.Argument(
        metavar="NAME", help="The action's name, /drive.", autocompletion=complete_action_names
    ),
]

ActionType = Annotated[
    str,
    typer.Argument(
        metavar="TYPE",
        help="The action type, test_msgs/action/Fibonacci.",
        autocompletion=complete_action_types,
    ),
]

OptionalActionType = Annotated[
    str | None,
    typer.Argument(
        metavar="TYPE",
        help="The action type; may be left out if a server is in the graph.",
        autocompletion=complete_action_types,
        show_default=False,
    ),
]


def actions_of(session: rosasync.Session) -> dict[str, list[str]]:
    """Return the types of every action that has a server, by name."""
    from rosasync._ros.inspect import actions

    return actions(session.node)


async def wait_for_types(session: rosasync.Session, name: str, timeout: float) -> list[str]:
    """Wait until the graph shows a server of an action; return the types, none after a timeout."""
    from rosasync._ros.inspect import action_types

    resolved = resolve(session, name, "action")
    end = time.monotonic() + timeout
    while not (types := action_types(session.node, resolved)):
        if time.monotonic() >= end:
            break
        await asyncio.sleep(POLL)
    return types


async def find_type(session: rosasync.Session, name: str, timeout: float) -> str:
    """Return the type of an action, from the graph.

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


def endpoints_of(session: rosasync.Session, name: str) -> tuple[list[Endpoint], list[Endpoint]]:
    """Return the servers and the clients of a resolved action name."""
    from rosasync._ros.inspect import action_endpoints

    return action_endpoints(session.node, name)


def action_class(name: str) -> Any:
    """Return the class of an action type.

    Raises:
        CliError: there is no such type here; the message says where types come from.
    """
    try:
        return action_type(name)
    except ValueError as error:
        raise CliError(explain_type(name, error)) from None


def no_server(session: rosasync.Session, name: str, timeout: float) -> CliError:
    """Return the error for an action that has no server; it lists the similar names."""
    missing = f"{name}: no server of this name within {timeout:g} s"
    return CliError(f"{missing}{meant_instead(session, name)}", Code.NO_SERVER)


def meant_instead(session: rosasync.Session, name: str) -> str:
    """Return what may be meant by an action without a server, and what to try, as a text's end."""
    from rosasync._ros.graph import describe_similar
    from rosasync._ros.inspect import served_types

    resolved = resolve(session, name, "action")
    if served_types(session.node, resolved):
        return f"; it is a service. Try: rosasync info {name}"
    similar = describe_similar(actions_of(session), resolved)
    return f"{f'; there are {similar}' if similar else ''}. Try: rosasync action list"
