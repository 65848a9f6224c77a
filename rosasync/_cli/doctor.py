"""``rosasync doctor``: whether services can work on this machine."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import socket
import sys
import time
from pathlib import Path

import rosasync
from rosasync._cli.checks import Report
from rosasync._cli.errors import Code
from rosasync._cli.graph import settle
from rosasync._cli.options import AsJson
from rosasync._cli.run import open_session, run
from rosasync._cli.why import environment
from rosasync._core.text import count
from rosasync._demo.server import stock_server
from rosasync._ros.domain import environment_domain
from rosasync._ros.fresh_ports import dead_ports
from rosasync._ros.middleware import check_middleware, installed_middlewares
from rosasync._ros.profile import SWITCH, is_old, profile_variable, switched_off, user_profile
from rosasync._ros.shared_memory import (
    FOLDER,
    describe_unfinished,
    removal_command,
    unfinished_ports,
)

__all__ = ["doctor"]

ENOUGH = 64 << 20
"""Bytes of shared memory that some tens of Fast DDS processes need."""

MULTICAST = "239.255.0.1"
"""The group in which RTPS participants announce themselves (RTPS 2.5, 9.6.1)."""

DISCOVERY, SLOW = 10.0, 1.0
SRV_TYPE = "diagnostic_msgs/srv/AddDiagnostics"

PROFILE_HINT = (
    "Where packets get lost, give other nodes the profile that repairs it: rosasync profile"
)

FRESH_HINT = (
    "A session chooses no port where you have a profile. For processes that are started again "
    "after a crash: rosasync run -- COMMAND, which adds one to a copy of it"
)


def doctor(as_json: AsJson = False) -> None:
    """Say whether services can work on this machine.

    Each check that fails says what to do. It starts a server process of its own and calls it.

    \b
    Examples:
      $ rosasync doctor
      $ rosasync doctor --json
    """
    run(_doctor(as_json))


async def _doctor(as_json: bool) -> int:
    report = Report(as_json)
    report.add("python", True, f"{platform.python_version()}, {sys.executable}")
    if _rclpy(report) and _middleware(report):
        environment(report)
        _shared_memory(report)
        _multicast(report)
        _profile(report)
        if "domain" not in report.failed and _ports(report):
            await _calls(report)
    return Code.FAILED if report.failed else Code.ANSWERED


def _rclpy(report: Report) -> bool:
    found = importlib.util.find_spec("rclpy")
    report.add(
        "rclpy",
        found is not None,
        f"from {Path(found.origin or '').parent}" if found else "not installed for this Python",
        "pip install 'rosasync[jazzy]' (or [kilted]), or source /opt/ros/<distribution>/setup.bash "
        "and use its Python",
    )
    return found is not None


def _middleware(report: Report) -> bool:
    wanted = os.environ.get("RMW_IMPLEMENTATION")
    there = ", ".join(installed_middlewares()) or "none found"
    try:
        check_middleware()
    except ImportError as error:
        report.add("middleware", False, str(error), "Unset RMW_IMPLEMENTATION")
        return False
    shown = f"RMW_IMPLEMENTATION={wanted}" if wanted else "RMW_IMPLEMENTATION is not set"
    report.add("middleware", True, f"{shown}; installed: {there}")
    return True


def _is_fast_dds() -> bool:
    from rosasync._ros import fastdds

    return fastdds.is_present()


def _shared_memory(report: Report) -> None:
    """Check that Fast DDS can use shared memory; without it, it falls back to UDP."""
    if not _is_fast_dds():
        return
    usable = os.access(FOLDER, os.W_OK | os.X_OK)
    free = shutil.disk_usage(FOLDER).free if usable else 0
    files = len(list(FOLDER.glob("fast*")))
    report.add(
        "shared memory",
        usable and free > ENOUGH,
        f"{free >> 20} MB free in {FOLDER}, {files} files of Fast DDS",
        "Give a container more: docker run --shm-size=1g, or --ipc=host. Files of killed processes "
        "can be removed when no ROS process runs: fastdds shm clean",
    )


def _ports(report: Report) -> bool:
    """Check the ports in shared memory; return whether a new node can be created."""
    if not _is_fast_dds():
        return True
    domain = environment_domain()
    left = unfinished_ports(domain)
    if left:
        report.add("ports", False, describe_unfinished(left), removal_command(left))
    elif dead := dead_ports(domain):
        report.add(
            "ports",
            None,
            f"dead processes have left {count(len(dead), 'file')} of ports behind. The next "
            "process of the same number is reached only after seconds, unless it is a session or "
            "was started by rosasync run",
            removal_command(dead),
        )
    return not left


def _multicast(report: Report) -> None:
    """Send a packet to a multicast group, and receive it."""
    problem = None
    try:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        ):
            receiver.bind(("", 0))
            group = socket.inet_aton(MULTICAST) + socket.inet_aton("0.0.0.0")
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
            receiver.settimeout(1.0)
            sender.sendto(b"rosasync", (MULTICAST, receiver.getsockname()[1]))
            receiver.recv(16)
    except OSError as error:
        problem = str(error)
    local = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    ok = True if problem is None else None if local else False
    report.add(
        "multicast",
        ok,
        f"a packet to {MULTICAST} came back" if ok else f"none came back: {problem}",
        "Other machines are found by multicast: allow it in the firewall and the network, or name "
        "them in ROS_STATIC_PEERS",
    )


def _profile(report: Report) -> None:
    """Say which profile of Fast DDS is in use."""
    if not _is_fast_dds():
        return
    old = is_old()
    read, other = profile_variable(old), profile_variable(not old)
    if os.environ.get(other) and not os.environ.get(read):
        shown = f"{other}={os.environ[other]}"
        report.add("profile", False, shown, f"This Fast DDS reads {read} instead")
    elif (file := user_profile(old)) and not file.is_file():
        report.add("profile", False, f"{read}={file}", "There is no such file")
    else:
        hint = FRESH_HINT if file else PROFILE_HINT
        report.add("profile", None, _profile_in_use(file), hint)


def _profile_in_use(file: Path | None) -> str:
    if file:
        return f"yours, {file}, instead of rosasync's"
    if switched_off():
        return f"none: {SWITCH}={os.environ[SWITCH]}, and you have none"
    return "rosasync's own in sessions, none in other nodes started from here"


async def _calls(report: Report) -> None:
    """Discover and call a server in this process, and one in another."""
    from rosasync._ros.inspect import bridge_reason, silence

    report.add("bridge", True, bridge_reason())
    name = f"/_rosasync_doctor_{os.getpid()}"
    async with open_session(DISCOVERY) as session:
        async with session.serve(SRV_TYPE, f"{name}/own", lambda _, response: response):
            await _try(report, session, "call to itself", f"{name}/own", {})
        async with stock_server(f"{name}/other"):
            await _try(report, session, "other process", f"{name}/other", {})
        await settle(session)
        if found := silence(session.node):
            report.add(
                "other nodes",
                False,
                found,
                "Start both as one user, and in one /dev/shm",
            )


async def _try(
    report: Report, session: rosasync.Session, check: str, name: str, request: dict[str, str]
) -> None:
    begin = time.perf_counter()
    try:
        await session.wait_for_service(SRV_TYPE, name, timeout=DISCOVERY)
        discovered = time.perf_counter()
        await session.call(SRV_TYPE, name, request)
    except rosasync.CallError as error:
        advice = "Look at the checks above: shared memory, multicast, and a firewall"
        report.add(check, False, " ".join(str(error).split()), advice)
    else:
        discovery, call = discovered - begin, time.perf_counter() - discovered
        slow = "; processes announce themselves every 3 s" if discovery > SLOW else ""
        report.add(
            check, True, f"discovered in {discovery:.2f} s{slow}, answered in {1e3 * call:.1f} ms"
        )
