"""The names of nodes: the argument, the nodes of a kind in the graph, and a question to each."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

import typer

import rosasync
from rosasync._cli.errors import CliError, Code, code_of, code_of_all
from rosasync._cli.graph import is_hidden, settle
from rosasync._cli.run import fail, open_session
from rosasync._core.text import duration

__all__ = ["Answers", "NodeName", "ask_each", "nodes_that_serve", "session_for"]

T = TypeVar("T")

NodeName = Annotated[str, typer.Argument(metavar="NODE", help="The node's name, /arm.")]


@asynccontextmanager
async def session_for(node: str | None, timeout: float) -> AsyncIterator[rosasync.Session]:
    """Open a session to ask one node; if it lacks a service, the error is about the node.

    Args:
        node: the node's name, as the user gave it; None if all nodes are asked.
        timeout: the session's.

    Raises:
        CliError: the node is not there, or does not have what it is asked for.
    """
    async with open_session(timeout) as session:
        try:
            yield session
        except rosasync.ServiceUnavailable as error:
            ros_node = session.node
            # Other errors, such as that of another type, say themselves what is wrong.
            alone = len(ros_node.get_node_names()) <= 1
            if node is None or alone or ros_node.count_services(error.srv_name):
                raise
            raise _explain_missing(session, node, error) from None


def _explain_missing(
    session: rosasync.Session, node: str, error: rosasync.ServiceUnavailable
) -> CliError:
    from rosasync._ros.inspect import node_names

    names = [name for name in node_names(session.node) if not is_hidden(name)]
    resolved = error.srv_name.rpartition("/")[0]
    if resolved not in names:
        similar = difflib.get_close_matches(resolved, names, n=3)
        instead = f"; there are {', '.join(similar)}" if similar else ""
        text = f"no node of this name after {duration(error.elapsed)}{instead}. Try: rosasync nodes"
    elif error.srv_type.startswith("lifecycle_msgs/"):
        text = "this node has no lifecycle. Try: rosasync lifecycle nodes"
    else:
        text = f"this node has no service {error.srv_name}: its parameters cannot be reached"
    return CliError(f"{node}: {text}", Code.NO_SERVER)


async def nodes_that_serve(
    session: rosasync.Session, service: str, srv_type: str, wait: float | None
) -> list[str]:
    """Return the full names of the nodes that serve ``<node>/<service>`` with this type.

    Args:
        session: an open session.
        service: the last part of the service's name.
        srv_type: the service's type.
        wait: seconds to look at the graph; None until it seems complete.
    """
    from rosasync._ros.inspect import services

    await settle(session, wait)
    return [
        name.removesuffix(f"/{service}")
        for name, types in sorted(services(session.node).items())
        if name.endswith(f"/{service}") and srv_type in types and not is_hidden(name)
    ]


@dataclass(frozen=True)
class Answers(Generic[T]):
    """What several nodes have answered.

    Attributes:
        found: the answers, by the names of the nodes; those that did not answer are missing.
        code: the exit code of the command.
    """

    found: dict[str, T]
    code: Code


async def ask_each(nodes: Iterable[str], ask: Callable[[str], Awaitable[T]]) -> Answers[T]:
    """Ask all the nodes at a time, and print an error for each that does not answer.

    Args:
        nodes: the names of the nodes.
        ask: asks the node of this name.
    """
    found: dict[str, T] = {}
    codes: list[Code] = []

    async def ask_one(node: str) -> T | rosasync.RosasyncError:
        try:
            return await ask(node)
        except rosasync.RosasyncError as error:
            return error

    names = [*nodes]
    for node, answer in zip(names, await asyncio.gather(*map(ask_one, names)), strict=True):
        if isinstance(answer, rosasync.RosasyncError):
            fail(answer)
            codes.append(code_of(answer))
        else:
            found[node] = answer
    return Answers(found, code_of_all(codes))
