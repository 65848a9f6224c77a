"""The names of nodes: the argument, the nodes of a kind in the graph, and a question to each."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

import typer

import rosasync
from rosasync._cli.errors import Code, code_of, code_of_all
from rosasync._cli.graph import is_hidden, settle
from rosasync._cli.run import fail

__all__ = ["Answers", "NodeName", "ask_each", "nodes_that_serve"]

T = TypeVar("T")

NodeName = Annotated[str, typer.Argument(metavar="NODE", help="The node's name, /arm.")]


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
