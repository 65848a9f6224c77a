"""What of the graph belongs to this host, and which of its processes have ended.

The GUIDs of Fast DDS begin with its vendor, the host, and the lower half of the process id. After a
crash, the graph shows a process until its lease runs out.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable

from rclpy.node import Node

from rosasync._ros import fastdds
from rosasync._ros.discovery import ports_of, udp_sockets
from rosasync._ros.endpoints import GUID_PREFIX, gid_of
from rosasync._ros.processes import STATE, THREADS, read_stat

__all__ = ["DISCOVERY_TOPIC", "ended", "of_this_host", "participants"]

HOST = 4
"""Bytes at the start of a GUID that name the vendor and the host (RTPS 2.5, 9.3.1; Fast DDS)."""

PROCESS = slice(4, 6)
"""The bytes of a GUID with the lower half of the process id, the lowest first (Fast DDS)."""

DEAD_STATES = ("Z", "X", "x")
"""States of a process that has ended (``man 5 proc``)."""

DISCOVERY_TOPIC = "ros_discovery_info"
"""The topic on which each context announces its nodes: one writer for each participant."""


def of_this_host(node: Node, gids: Iterable[bytes]) -> list[bytes]:
    """Return the GUIDs of this host's processes.

    Args:
        node: a node of this process, whose own endpoints show how they begin.
        gids: the GUIDs of any endpoints.
    """
    own = {
        gid_of(endpoint)[:HOST]
        for endpoint in node.get_publishers_info_by_topic("/parameter_events")
        if endpoint.node_name == node.get_name() and endpoint.node_namespace == node.get_namespace()
    }
    return [gid for gid in gids if gid[:HOST] in own]


def participants(node: Node) -> list[bytes]:
    """Return a GUID of each participant of this host that the graph shows."""
    writers = node.get_publishers_info_by_topic(DISCOVERY_TOPIC, no_mangle=True)
    return of_this_host(node, map(gid_of, writers))


def ended(
    node: Node, gids: Iterable[bytes], known: Collection[bytes] = frozenset()
) -> frozenset[bytes]:
    """Return the GUIDs whose process has certainly ended.

    Two signs have to agree. There is no process with this id: but in another container it may have
    another one. And the graph shows more participants than have a socket here: those of a container
    that shares this host's network have one. A process that is starting has one, too, before the
    graph shows it, so what was certain once stays so.

    Args:
        node: a node of this process.
        gids: the GUIDs of any endpoints.
        known: GUIDs of endpoints whose process was found to have ended.
    """
    if not fastdds.is_present():
        return frozenset()
    living = _living_processes()
    missing = [gid for gid in of_this_host(node, gids) if not living(_process_of(gid))]
    if not missing:
        return frozenset()
    sockets = {port for port, _ in udp_sockets()} & {*ports_of(int(node.context.get_domain_id()))}
    lost = {gid[:GUID_PREFIX] for gid in missing}
    # The graph loses the endpoints of a participant one by one.
    shown = {gid[:GUID_PREFIX] for gid in participants(node)} | lost
    if sockets and len(shown) - len(sockets) >= len(lost):
        return frozenset(missing)
    ended_before = {gid[:GUID_PREFIX] for gid in known}
    return frozenset(gid for gid in missing if gid[:GUID_PREFIX] in ended_before)


def _process_of(gid: bytes) -> int:
    return int.from_bytes(gid[PROCESS], "little")


def _living_processes() -> Callable[[int], bool]:
    """Return a test whether a process is alive whose id ends in these 16 bits."""
    ids: dict[int, list[str]] = {}
    for name in os.listdir("/proc"):
        if name.isdecimal():
            ids.setdefault(int(name) & 0xFFFF, []).append(name)
    return lambda lower_half: any(map(_is_alive, ids.get(lower_half, ())))


def _is_alive(process: str) -> bool:
    """Return whether a process is more than the entry that its parent has not collected."""
    try:
        fields = read_stat(process)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    # A process whose first thread has ended looks the same, but for its other threads.
    return fields[STATE] not in DEAD_STATES or int(fields[THREADS]) > 1
