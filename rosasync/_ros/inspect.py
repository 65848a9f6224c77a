"""What the command line asks of a node: the graph's nodes, services and endpoints, and events.

Every function may be called from any thread. The graph is what the node has discovered so far.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from rosasync._ros import endpoints, rcl
from rosasync._ros.discovery import ports_of, udp_sockets
from rosasync._ros.endpoints import (
    clients_of,
    full_name,
    incompatibility,
    response_writers,
    servers_of,
)
from rosasync._ros.host import DISCOVERY_TOPIC
from rosasync._ros.names import SEND_GOAL, default_qos
from rosasync._ros.silence import explain_silence

__all__ = [
    "Endpoint",
    "action_endpoints",
    "action_types",
    "actions",
    "all_discovered",
    "bridge_reason",
    "client_endpoints",
    "count_publishers",
    "domain_id",
    "graph_state",
    "local_domains",
    "middleware",
    "node_names",
    "rclpy_location",
    "served_types",
    "server_endpoints",
    "services",
    "silence",
    "subscribe",
]

PARTICIPANTS = 120
"""Participants of a host whose ports fit between those of two domains (RTPS 2.3, 9.6.1)."""

UNEXPLAINED = (
    "the server is visible, but the name of its node has not arrived. If no data arrives from it "
    "at all, it may belong to another user, or to a container without a common /dev/shm: start "
    "both as one user, with --ipc=host"
)

SAFE_DOMAINS = 102
"""The ports of higher domains are also used for other purposes (Linux's ephemeral ports)."""


GOAL_TYPE = "_SendGoal"
"""How the type of this service ends."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A server or a client of a service, as the graph shows it.

    Attributes:
        node: the full name of its node, ``""`` while that is unknown.
        srv_type: the name of its service type.
        reliability: ``"reliable"``, ``"best_effort"`` or ``"unknown"``.
        problem: why its QoS does not match the default of services, None if it does.
    """

    node: str
    srv_type: str
    reliability: str
    problem: str | None


def server_endpoints(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the servers of a resolved name."""
    return [_described(server) for server in servers_of(node, srv_name)]


def client_endpoints(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the clients of a resolved name, this process's own included."""
    return [_described(client) for client in clients_of(node, srv_name)]


def silence(node: Node, srv_name: str | None = None) -> str | None:
    """Say why no data arrives from the servers of a name, or from any process, if none does.

    A server whose node is not known is such a one, some seconds after its discovery.

    Args:
        node: this process's node.
        srv_name: a resolved name; None for all services.

    Returns:
        None if nothing is missing.
    """
    names = [srv_name] if srv_name else [name for name, _ in node.get_service_names_and_types()]
    for name in names:
        writers = response_writers(node, name)
        if writers and not any(server.node for server in servers_of(node, name)):
            reason = explain_silence(node, writers)
            return f"{name}: {reason or UNEXPLAINED}"
    return None


def services(node: Node) -> dict[str, list[str]]:
    """Return the types of every service that has a server, by name."""
    return {
        name: served_types(node, name) or list(types)
        for name, types in node.get_service_names_and_types()
        if node.count_services(name)
    }


def served_types(node: Node, srv_name: str) -> list[str]:
    """Return the types under which a resolved name is served."""
    if not node.count_services(srv_name):
        return []
    types = {endpoint.srv_type for endpoint in server_endpoints(node, srv_name)}
    return sorted(types - {""})


def actions(node: Node) -> dict[str, list[str]]:
    """Return the types of every action that has a server, by name."""
    return {
        name.removesuffix(SEND_GOAL): [kind.removesuffix(GOAL_TYPE) for kind in types]
        for name, types in services(node).items()
        if name.endswith(SEND_GOAL)
    }


def action_types(node: Node, name: str) -> list[str]:
    """Return the types under which the action of a resolved name is served."""
    return [kind.removesuffix(GOAL_TYPE) for kind in served_types(node, f"{name}{SEND_GOAL}")]


def action_endpoints(node: Node, name: str) -> tuple[list[Endpoint], list[Endpoint]]:
    """Return the servers and the clients of the action of a resolved name."""
    servers = server_endpoints(node, f"{name}{SEND_GOAL}")
    clients = client_endpoints(node, f"{name}{SEND_GOAL}")
    return [_of_action(each) for each in servers], [_of_action(each) for each in clients]


def node_names(node: Node) -> list[str]:
    """Return the full names of all nodes, this one included. A name may occur several times."""
    names = node.get_node_names_and_namespaces()
    return sorted(full_name(name, namespace) for name, namespace in names)


def graph_state(node: Node) -> object:
    """Return what the graph shows now, to compare with a later state."""
    return (node_names(node), node.get_service_names_and_types(), _participants(node))


def all_discovered(node: Node) -> bool:
    """Return whether every participant of this machine has been discovered, with its nodes.

    Each participant is one context of a process, and has a UDP port of its own in the range of the
    domain. Participants on other machines, or in other network namespaces, cannot be counted. The
    names of its nodes may come some time after its endpoints.
    """
    local = _local_participants(domain_id(node), _used_ports())
    return 0 < local <= _participants(node) <= len(node_names(node))


def local_domains() -> dict[int, int]:
    """Return the ROS domains in use on this machine, with their number of participants."""
    ports = _used_ports()
    counts = {domain: _local_participants(domain, ports) for domain in range(SAFE_DOMAINS)}
    return {domain: count for domain, count in counts.items() if count}


def domain_id(node: Node) -> int:
    """Return the ROS domain that the node is in."""
    return int(node.context.get_domain_id())


def count_publishers(node: Node, topic: str) -> int:
    """Return how many publishers a topic has."""
    return int(node.count_publishers(topic))


def subscribe(
    node: Node, message_type: Any, topic: str, deliver: Callable[[Any], None]
) -> Callable[[], None]:
    """Subscribe to a topic, with the reliability of its publishers.

    Args:
        node: the node to create the subscription on.
        message_type: the class of the messages.
        topic: the resolved name.
        deliver: called with each message, on the executor's thread.

    Returns:
        A function that ends the subscription.
    """
    publishers = node.get_publishers_info_by_topic(topic)
    best_effort = any(
        info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for info in publishers
    )
    reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
    qos = QoSProfile(depth=1000, reliability=reliability)
    subscription = node.create_subscription(message_type, topic, deliver, qos)
    return lambda: node.destroy_subscription(subscription)


def middleware() -> str:
    """Return the name of the middleware in use."""
    return str(rclpy.get_rmw_implementation_identifier())


def rclpy_location() -> str:
    """Return the folder from which rclpy was imported."""
    return str(Path(rclpy.__file__).parent)


def bridge_reason() -> str:
    """Say which bridge ``bridge="auto"`` chooses here, and why, as a clause."""
    if rcl.load() is None:
        return f"executor, because {platform.system()} on {platform.machine()} has no direct bridge"
    if not middleware().startswith("rmw_fastrtps"):
        return f"executor, because the direct bridge has not been tried with {middleware()}"
    return f"direct, because this is Linux on {platform.machine()} with {middleware()}"


def _described(found: endpoints.Endpoint) -> Endpoint:
    qos = found.qos
    if qos is None:
        return Endpoint(found.node, found.srv_type, "unknown", None)
    reliability = str(qos.reliability.name).lower()
    return Endpoint(found.node, found.srv_type, reliability, _qos_problem(qos))


def _of_action(endpoint: Endpoint) -> Endpoint:
    return replace(endpoint, srv_type=endpoint.srv_type.removesuffix(GOAL_TYPE))


def _qos_problem(qos: QoSProfile) -> str | None:
    """Return why the QoS of an endpoint does not match the default QoS, None if it does."""
    ours = default_qos()
    return incompatibility(ours, qos) or incompatibility(qos, ours)


def _participants(node: Node) -> int:
    return len(node.get_publishers_info_by_topic(DISCOVERY_TOPIC, no_mangle=True))


def _local_participants(domain: int, used: set[int]) -> int:
    """Count the participants of a domain on this machine by their UDP ports; 0 if unknown."""
    return len(used.intersection(ports_of(domain, PARTICIPANTS)))


def _used_ports() -> set[int]:
    """Return the UDP ports in use in this network namespace, none if they cannot be read."""
    return {port for port, _ in udp_sockets()}
