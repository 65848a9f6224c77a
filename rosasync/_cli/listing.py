"""``rosasync list``, ``type``, ``find``, ``info`` and ``nodes``: what the graph shows."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rosasync._cli.errors import Code
from rosasync._cli.graph import (
    is_hidden,
    meant_instead,
    no_server,
    resolve,
    settle,
    srv_class,
    wait_for_types,
)
from rosasync._cli.options import AsJson, Hidden, Name, Type, Wait
from rosasync._cli.output import note, print_json
from rosasync._cli.run import open_session, run

if TYPE_CHECKING:
    from rosasync._ros.inspect import Endpoint

__all__ = ["clashes", "find", "info", "list_services", "nodes", "type_of"]


def list_services(
    types: Annotated[bool, typer.Option("--types", "-t", help="Print the types too.")] = False,
    hidden: Hidden = False,
    as_json: AsJson = False,
    wait: Wait = None,
) -> None:
    """List the services that have a server.

    \b
    Examples:
      $ rosasync list -t
      $ rosasync list --hidden --json
    """
    run(_list(types, hidden, as_json, wait))


async def _list(types: bool, hidden: bool, as_json: bool, wait: float | None) -> None:
    found = await _services(wait)
    for name in sorted(found):
        if is_hidden(name) and not hidden:
            continue
        if as_json:
            print_json({"name": name, "types": found[name]})
        else:
            print(f"{name} [{', '.join(found[name])}]" if types else name)


def type_of(
    name: Name,
    as_json: AsJson = False,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a server.")] = 5.0,
) -> None:
    """Print the type of a service.

    \b
    Examples:
      $ rosasync type /lamp/switch
      $ rosasync type /lamp/switch --json
    """
    run(_type_of(name, as_json, timeout))


async def _type_of(name: str, as_json: bool, timeout: float) -> None:
    async with open_session() as session:
        types = await wait_for_types(session, name, timeout)
        if not types:
            raise no_server(session, name, timeout)
    if as_json:
        print_json({"name": name, "types": types})
    else:
        print("\n".join(types))


def find(
    srv_type: Type, hidden: Hidden = False, as_json: AsJson = False, wait: Wait = None
) -> None:
    """List the services of a type.

    \b
    Examples:
      $ rosasync find std_srvs/srv/SetBool
      $ rosasync find std_srvs/srv/SetBool --json
    """
    run(_find(srv_type, hidden, as_json, wait))


async def _find(srv_type: str, hidden: bool, as_json: bool, wait: float | None) -> int:
    found = await _services(wait)
    names = [n for n in sorted(found) if srv_type in found[n] and (hidden or not is_hidden(n))]
    if not names:
        # Raises if there is no such type, or it is not installed, so that it may be misspelt.
        srv_class(srv_type)
        note(f"no service of the type {srv_type}. Try: rosasync list -t")
        return Code.NO_SERVER
    for name in names:
        if as_json:
            print_json({"name": name})
        else:
            print(name)
    return Code.ANSWERED


def info(name: Name, as_json: AsJson = False, wait: Wait = None) -> None:
    """Show the servers and clients of a service.

    Each with its node, type and QoS; then what clashes, such as two types or several servers.

    \b
    Examples:
      $ rosasync info /lamp/switch
      $ rosasync info /lamp/switch --json
    """
    run(_info(name, as_json, wait))


async def _info(name: str, as_json: bool, wait: float | None) -> int:
    async with open_session() as session:
        resolved = resolve(session, name)
        await settle(session, wait)
        from rosasync._ros.inspect import client_endpoints, server_endpoints

        servers = server_endpoints(session.node, resolved)
        clients = client_endpoints(session.node, resolved)
        if not servers:
            note(f"{name}: no server of this name{meant_instead(session, name)}")
    if as_json:
        for role, endpoint in [("server", e) for e in servers] + [("client", e) for e in clients]:
            print_json({"role": role, **_described(endpoint)})
    else:
        _print_info(resolved, servers, clients)
    return Code.ANSWERED if servers else Code.NO_SERVER


def _print_info(name: str, servers: list[Endpoint], clients: list[Endpoint]) -> None:
    print(name)
    for role, endpoints in (("servers", servers), ("clients", clients)):
        print(f"{role}: {len(endpoints)}")
        for endpoint in endpoints:
            problem = f", {endpoint.problem}" if endpoint.problem else ""
            node = endpoint.node or "(node not known)"
            print(f"  {node} [{endpoint.srv_type}] {endpoint.reliability}{problem}")
    for clash in clashes(servers, clients):
        print(f"clash: {clash}")


def clashes(servers: list[Endpoint], clients: list[Endpoint]) -> list[str]:
    """Say what keeps calls of a service from being answered, or answers them twice."""
    found = []
    served = sorted({endpoint.srv_type for endpoint in servers})
    called = sorted({endpoint.srv_type for endpoint in clients} - set(served))
    if len(served) > 1:
        found.append(f"served with several types: {', '.join(served)}")
    if len(servers) > len(served):
        found.append(
            f"{len(servers)} servers: each request is run by every one of its type, and the first "
            "response wins. After a crash, the dead one is shown for up to 20 s"
        )
    if served and called:
        found.append(f"called as {', '.join(called)}, but served as {', '.join(served)}")
    if any(endpoint.problem for endpoint in servers):
        found.append("the QoS of a server does not match a client of default QoS")
    return found


def nodes(hidden: Hidden = False, as_json: AsJson = False, wait: Wait = None) -> None:
    """List the nodes.

    \b
    Examples:
      $ rosasync nodes
      $ rosasync nodes --hidden
    """
    run(_nodes(hidden, as_json, wait))


async def _nodes(hidden: bool, as_json: bool, wait: float | None) -> None:
    async with open_session() as session:
        await settle(session, wait)
        from rosasync._ros.inspect import node_names

        names = Counter(node_names(session.node))
        names.subtract([str(session.node.get_fully_qualified_name())])
    for name, count in sorted(names.items()):
        if count < 1 or (is_hidden(name) and not hidden):
            continue
        if as_json:
            print_json({"name": name, "count": count})
        else:
            print(name if count == 1 else f"{name} ({count} nodes of this name)")


async def _services(wait: float | None) -> dict[str, list[str]]:
    """Return the services of other processes."""
    async with open_session() as session:
        await settle(session, wait)
        from rosasync._ros.inspect import services

        own = f"{session.node.get_fully_qualified_name()}/"
        found = services(session.node)
    return {name: types for name, types in found.items() if not name.startswith(own)}


def _described(endpoint: Endpoint) -> dict[str, Any]:
    return {
        "node": endpoint.node or None,
        "type": endpoint.srv_type,
        "reliability": endpoint.reliability,
        "problem": endpoint.problem,
    }
