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

from rosasync._ros.endpoints import gid_of
from rosasync._ros.fresh_ports import live_ports, own_ports

__all__ = ["DISCOVERY_TOPIC", "explain_silence"]

HOST = 4
"""Bytes at the start of a GUID that name the vendor and the host (RTPS 2.5, 9.3.1; Fast DDS)."""

DISCOVERY_TOPIC = "ros_discovery_info"
"""The topic on which each context announces its nodes: one writer for each participant."""

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
        None if shared memory does not explain it.
    """
    hosts = {gid_of(own)[:HOST] for own in _own(node)}
    if not any(gid_of(endpoint)[:HOST] in hosts for endpoint in endpoints):
        return None
    ports = live_ports(int(node.context.get_domain_id()))
    visible = sum(
        gid_of(writer)[:HOST] in hosts
        for writer in node.get_publishers_info_by_topic(DISCOVERY_TOPIC, no_mangle=True)
    )
    if visible > len(ports):
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


def _own(node: Node) -> list[TopicEndpointInfo]:
    """Return the endpoints of this node, whose beginning is that of every process of the host."""
    return [
        endpoint
        for endpoint in node.get_publishers_info_by_topic("/parameter_events")
        if endpoint.node_name == node.get_name() and endpoint.node_namespace == node.get_namespace()
    ]


def _name(user: int) -> str:
    try:
        return f"user {pwd.getpwuid(user).pw_name}"
    except KeyError:
        return f"user {user}"
