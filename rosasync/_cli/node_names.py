"""The names of nodes: the argument, and the nodes of a kind in the graph."""

from __future__ import annotations

from typing import Annotated

import typer

import rosasync
from rosasync._cli.graph import is_hidden, settle

__all__ = ["NodeName", "nodes_that_serve"]

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
