"""What the shell proposes for an argument."""

from __future__ import annotations

import asyncio
from contextlib import suppress

__all__ = [
    "complete_action_names",
    "complete_action_types",
    "complete_names",
    "complete_types",
]

WAIT = 1.0
"""Seconds to look for services: a shell should not hang."""


def complete_names(incomplete: str) -> list[str]:
    """Return the names of the services in the graph that start like this."""
    names: list[str] = []
    with suppress(Exception):
        names = asyncio.run(_names())
    return [name for name in names if name.startswith(incomplete)]


def complete_types(incomplete: str) -> list[str]:
    """Return the installed service types that start like this."""
    from rosasync._ros.interfaces import installed_types

    return [name for name in installed_types() if name.startswith(incomplete)]


def complete_action_names(incomplete: str) -> list[str]:
    """Return the names of the actions in the graph that start like this."""
    names: list[str] = []
    with suppress(Exception):
        names = asyncio.run(_names(of_actions=True))
    return [name for name in names if name.startswith(incomplete)]


def complete_action_types(incomplete: str) -> list[str]:
    """Return the installed action types that start like this."""
    from rosasync._ros.interfaces import installed_types

    return [name for name in installed_types("action") if name.startswith(incomplete)]


async def _names(of_actions: bool = False) -> list[str]:
    from rosasync._cli.graph import is_hidden, settle
    from rosasync._cli.run import open_session

    async with open_session() as session:
        from rosasync._ros.inspect import actions, services

        with suppress(TimeoutError):
            async with asyncio.timeout(WAIT):
                await settle(session)
        found = (actions if of_actions else services)(session.node)
        return [name for name in sorted(found) if not is_hidden(name)]
