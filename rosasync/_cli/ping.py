"""``rosasync ping``: how far a call gets, and how long each phase takes."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

import typer

import rosasync
from rosasync._cli.errors import CliError, Code
from rosasync._cli.graph import POLL, find_type, resolve, srv_class, wait_for_types
from rosasync._cli.options import AsJson, Name, OptionalType, Timeout
from rosasync._cli.output import print_json
from rosasync._cli.requests import message_from
from rosasync._cli.run import open_session, run

__all__ = ["ping"]

PARAMETERS = "rcl_interfaces/srv/DescribeParameters"

DISCOVERY = 3.0
"""Seconds to wait for the server's node and its parameter services, which may show up later."""


def ping(
    name: Name,
    srv_type: OptionalType = None,
    request: Annotated[
        str | None,
        typer.Option(help="Send this request to the service itself; '{}' for an empty one."),
    ] = None,
    timeout: Timeout = 5.0,
    as_json: AsJson = False,
) -> None:
    """Say how far a call gets, and how long it takes.

    \b
    graph     a server is visible
    matched   a client is connected with it
    answered  the server's node answers

    A request could move something. So by default ping asks the node about its parameters, and not
    the service. --request sends a request to the service.

    \b
    Examples:
      $ rosasync ping /lamp/switch
      $ rosasync ping /lamp/switch --request '{data: true}' --json
    """
    run(_ping(name, srv_type, request, timeout, as_json))


class _Phases:
    """Prints each phase when it ends."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json

    @asynccontextmanager
    async def phase(self, name: str, what: str) -> AsyncIterator[None]:
        begin = time.perf_counter()
        try:
            yield
        except (CliError, rosasync.RosasyncError):
            self._print(name, begin, what, ok=False)
            raise
        self._print(name, begin, what, ok=True)

    def skip(self, name: str, why: str) -> None:
        """Print a phase that is left out."""
        self._print(name, time.perf_counter(), why, ok=None)

    def _print(self, name: str, begin: float, what: str, *, ok: bool | None) -> None:
        ms = round(1e3 * (time.perf_counter() - begin), 3)
        if self._as_json:
            print_json({"phase": name, "ok": ok, "ms": ms, "what": what})
        else:
            mark = {True: "ok", False: "no", None: "-"}[ok]
            print(f"{name:<10}{mark:<4}{ms:9.1f} ms  {what}", flush=True)


async def _ping(
    name: str, srv_type: str | None, request: str | None, timeout: float, as_json: bool
) -> int:
    known = None if srv_type is None else srv_class(srv_type)
    message = None if known is None else message_from(known.Request, request)
    phases = _Phases(as_json)
    async with open_session(timeout) as session:
        async with phases.phase("graph", f"a server of {name}"):
            graph_type = await find_type(session, name, timeout)
        found = known or srv_class(graph_type)
        async with phases.phase("matched", f"a client of {srv_type or graph_type}"):
            await session.wait_for_service(found, name, timeout=timeout)
        if request is not None:
            message = message if known else message_from(found.Request, request)
            async with phases.phase("answered", "the request, by the service"):
                await session.call(found, name, message)
            return Code.ANSWERED
        await _ask_node(session, phases, name)
    return Code.ANSWERED


async def _ask_node(session: rosasync.Session, phases: _Phases, name: str) -> None:
    """Ask the server's node something harmless: to describe no parameters."""
    from rosasync._ros.inspect import silence

    node = await _server_node(session, resolve(session, name))
    if node is None:
        async with phases.phase("answered", "by the server's node"):
            raise CliError(
                silence(session.node, resolve(session, name)) or f"{name}: the server is gone",
                Code.FAILED,
            )
    service = f"{node}/describe_parameters"
    if not await wait_for_types(session, service, DISCOVERY):
        phases.skip("answered", "not asked: the node has no parameter services; use --request")
        return
    async with phases.phase("answered", f"by the node {node}; --request asks the service itself"):
        await session.call(PARAMETERS, service)


async def _server_node(session: rosasync.Session, name: str) -> str | None:
    """Wait until the node of a server is known, and return its name; None if it stays unknown."""
    from rosasync._ros.inspect import server_endpoints

    end = time.monotonic() + DISCOVERY
    while True:
        for server in server_endpoints(session.node, name):
            if server.node:
                return server.node
        if time.monotonic() > end:
            return None
        await asyncio.sleep(POLL)
