"""Explains why nothing arrives from a process of this host although it is visible.

Processes discover each other by UDP. Messages between processes of one host go through ports in
shared memory (`rosasync._ros.fresh_ports`). Another user's port cannot be written to, and without
a common ``/dev/shm`` each process writes into ports of its own that no other reads. Fast DDS
reports neither.
"""

from __future__ import annotations

import os
import pwd
from collections.abc import Iterable

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync._ros import fastdds
from rosasync._ros.endpoints import gid_of
from rosasync._ros.fresh_ports import live_ports, own_ports
from rosasync._ros.host import of_this_host, participants

__all__ = ["explain_silence"]

SILENT = "the server is visible, but no data arrives from it"
REMEDY = (
    "Or start both without shared memory: FASTDDS_BUILTIN_TRANSPORTS=UDPv4 with "
    "ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET"
)


def explain_silence(node: Node, endpoints: Iterable[TopicEndpointInfo]) -> str | None:
    """Describe what keeps messages of these endpoints from arriving, as a clause.

    Args:
        node: this process's node.
        endpoints: endpoints whose node is not known. The names of a process's nodes are messages
            too, so something has arrived from all others.

    Returns:
        None if shared memory does not explain it, or another middleware than Fast DDS is in use.
    """
    if not fastdds.is_present():
        return None
    if not any(of_this_host(node, map(gid_of, endpoints))):
        return None
    ports = live_ports(int(node.context.get_domain_id()))
    if len(participants(node)) > len(ports):
        return (
            f"{SILENT}: the two processes have no /dev/shm in common. Start both containers with "
            f"--ipc=host. {REMEDY}"
        )
    others = {number: found for number, found in ports.items() if number not in own_ports()}
    for file, user in others.values():
        if user != os.getuid():
            return (
                f"{SILENT}: {_name(user)} owns {file}, and processes of different users cannot "
                f"write to each other's ports. Run both as one user. {REMEDY}"
            )
    return None


def _name(user: int) -> str:
    try:
        return f"user {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"user {user}"
