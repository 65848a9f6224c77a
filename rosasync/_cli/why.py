"""``rosasync why``: why a call does not work, step by step."""

from __future__ import annotations

import difflib
import os

import rosasync
from rosasync._cli.checks import Report
from rosasync._cli.errors import Code
from rosasync._cli.graph import explain_type, is_hidden, resolve, settle
from rosasync._cli.options import AsJson, Name, OptionalType, Wait
from rosasync._cli.run import open_session, run
from rosasync._core.text import count
from rosasync._ros.domain import SAFE, environment_domain
from rosasync._ros.profile import SWITCH, switched_off
from rosasync._ros.types import service_type

__all__ = ["environment", "why"]

MATCH = 5.0
"""Seconds to wait until a client is matched with a server that the graph shows."""


def why(
    name: Name, srv_type: OptionalType = None, as_json: AsJson = False, wait: Wait = None
) -> None:
    """Say why a call does not work, and what to do.

    Nothing is sent to the service.

    \b
    Examples:
      $ rosasync why /lamp/switch
      $ rosasync why /lamp/switch std_srvs/srv/SetBool --json
    """
    run(_why(name, srv_type, as_json, wait))


async def _why(name: str, srv_type: str | None, as_json: bool, wait: float | None) -> int:
    report = Report(as_json)
    environment(report)
    if "domain" in report.failed:
        return Code.FAILED
    async with open_session() as session:
        resolved = resolve(session, name)
        await settle(session, wait)
        if not _data(report, session, resolved):
            return Code.FAILED
        if not (_nodes(report, session) and _name(report, session, resolved)):
            return Code.NO_SERVER
        found = _type(report, session, resolved, srv_type)
        _servers(report, session, resolved)
        if found is not None:
            await _match(report, session, resolved, found)
    return Code.FAILED if report.failed else Code.ANSWERED


def environment(report: Report) -> None:
    """Check the variables that decide which processes are discovered, and how soon."""
    _domain_and_range(report)
    _switch(report)


def _switch(report: Report) -> None:
    """Say what ``ROSASYNC_PROFILE`` means, if it is set."""
    value = os.environ.get(SWITCH)
    if switched_off():
        report.add(
            "profile switch",
            None,
            f"{SWITCH}={value}: a session applies no Fast DDS profile of its own, so a lost "
            "request is repaired after 3 s instead of 20 ms; and it does not introduce itself at "
            "its start, so servers on this host may be found up to 3 s later",
            f"Unset {SWITCH}, unless that is what you want",
        )
    elif value:
        report.add(
            "profile switch",
            None,
            f"{SWITCH}={value} has no effect: only the value off has",
            f"Unset {SWITCH}, or set it to off",
        )


def _domain_and_range(report: Report) -> None:
    try:
        domain = environment_domain()
    except rosasync.UsageError as error:
        report.add("domain", False, str(error), "Set ROS_DOMAIN_ID on both sides, or unset it")
    else:
        report.add(
            "domain",
            None,
            f"{domain} (ROS_DOMAIN_ID); both sides need the same",
            ""
            if domain <= SAFE
            else f"Domains above {SAFE} have ports that Linux also uses for outgoing connections",
        )
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        report.add(
            "range",
            None,
            "this machine only, by ROS_LOCALHOST_ONLY=1, which is deprecated",
            "Unset it, and use ROS_AUTOMATIC_DISCOVERY_RANGE",
        )
        return
    found = (os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET").upper()
    meaning = {
        "OFF": "no process is discovered",
        "LOCALHOST": "only processes of this machine are discovered",
        "SUBNET": "processes of this machine and its subnet are discovered",
        "SYSTEM_DEFAULT": "the middleware's configuration decides",
    }.get(found, "not a valid value")
    usable = found in ("LOCALHOST", "SUBNET", "SYSTEM_DEFAULT")
    report.add(
        "range",
        None if usable else False,
        f"{found}: {meaning} (ROS_AUTOMATIC_DISCOVERY_RANGE)",
        "" if usable else "Set it to SUBNET or LOCALHOST",
    )


def _data(report: Report, session: rosasync.Session, name: str) -> bool:
    """Check that data arrives from the servers that are visible."""
    from rosasync._ros.inspect import silence

    found = silence(session.node, name)
    if found:
        report.add("data", False, found, "Try: rosasync doctor")
    return not found


def _nodes(report: Report, session: rosasync.Session) -> bool:
    """Check that other nodes are visible."""
    from rosasync._ros.inspect import domain_id, local_domains, middleware, node_names

    report.add("middleware", None, f"{middleware()}; both sides need the same")
    own = str(session.node.get_fully_qualified_name())
    others = [name for name in node_names(session.node) if name != own]
    shown = ", ".join(others[:5]) + (", …" if len(others) > 5 else "")
    elsewhere = [str(d) for d in local_domains() if d != domain_id(session.node)]
    hint = f". On this machine domain {', '.join(elsewhere)} is in use too" if elsewhere else ""
    report.add(
        "nodes",
        bool(others),
        f"{count(len(others), 'other')} visible{': ' if others else ''}{shown}",
        "Start the server, or compare ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE and "
        f"RMW_IMPLEMENTATION with its{hint}",
    )
    return bool(others)


def _name(report: Report, session: rosasync.Session, name: str) -> bool:
    """Check that a server has the name."""
    from rosasync._ros.inspect import services

    served = [
        other
        for other in services(session.node)
        if other == name or is_hidden(name) or not is_hidden(other)
    ]
    if name in served:
        report.add("name", True, f"{name} is served")
        return True
    similar = difflib.get_close_matches(name, served, n=3, cutoff=0.6)
    same_end = [other for other in served if other.rpartition("/")[2] == name.rpartition("/")[2]]
    names = list(dict.fromkeys([*similar, *same_end]))[:3]
    advice = f"Did you mean {' or '.join(names)}?" if names else "Try: rosasync list -t"
    report.add("name", False, f"no server has the name {name}", advice)
    return False


def _type(report: Report, session: rosasync.Session, name: str, wanted: str | None) -> str | None:
    """Check that the type is the server's, and is installed here; return it if it is."""
    from rosasync._ros.inspect import served_types

    types = served_types(session.node, name)
    chosen = wanted or types[0]
    if chosen not in types:
        report.add("type", False, f"served as {', '.join(types)}", f"Call it as {types[0]}")
        return None
    one = len(types) == 1
    report.add(
        "type",
        one,
        f"served as {', '.join(types)}",
        "Servers of one name should have one type: stop the others",
    )
    try:
        service_type(chosen)
    except ValueError as error:
        report.add("installed", False, f"{chosen} is not", explain_type(chosen, error))
        return None
    return chosen


def _servers(report: Report, session: rosasync.Session, name: str) -> None:
    """Check the number of servers, and their QoS."""
    from rosasync._ros.inspect import server_endpoints

    servers = server_endpoints(session.node, name)
    nodes = ", ".join(sorted({server.node or "(node not known)" for server in servers}))
    report.add(
        "servers",
        len(servers) <= 1,
        f"{len(servers)}: {nodes}",
        "Every server runs each request, and the first response wins: stop all but one",
    )
    problems = sorted({server.problem for server in servers if server.problem})
    report.add(
        "qos",
        not problems,
        "; ".join(problems) or "fits a client of default QoS",
        "Give the client the server's QoS: session.call(…, qos=…)",
    )


async def _match(report: Report, session: rosasync.Session, name: str, srv_type: str) -> None:
    """Check that a client is connected with the server."""
    try:
        await session.wait_for_service(srv_type, name, timeout=MATCH)
    except rosasync.ServiceUnavailable as error:
        report.add(
            "match",
            False,
            f"no match within {MATCH:g} s: {error}",
            "A firewall may block it, or the server hangs. Try: rosasync doctor",
        )
    else:
        report.add("match", True, f"a client is matched; try: rosasync ping {name}")
