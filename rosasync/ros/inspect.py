"""What the command line asks of a node: the graph's nodes, services and endpoints, and events.

Every function may be called from any thread. The graph is what the node has discovered so far.
"""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync.ros import rcl
from rosasync.ros.endpoints import incompatibility, request_writers, response_writers
from rosasync.ros.names import default_qos

__all__ = [
    "Endpoint",
    "all_discovered",
    "bridge_reason",
    "client_endpoints",
    "count_publishers",
    "domain_id",
    "graph_state",
    "local_domains",
    "middleware",
    "node_names",
    "qos_problem",
    "rclpy_location",
    "served_types",
    "server_endpoints",
    "services",
    "subscribe",
]

DISCOVERY_TOPIC = "ros_discovery_info"
"""The topic on which each context announces its nodes: one writer for each participant."""

PORT_BASE, PORT_GAIN, PORT_OFFSET = 7400, 250, 10
"""How RTPS computes the first port of a participant in a domain (RTPS 2.5, 9.6.2)."""

SAFE_DOMAINS = 102
"""The ports of higher domains are also used for other purposes (Linux's ephemeral ports)."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A server or a client of a service, as the graph shows it.

    Attributes:
        node: the full name of its node, ``""`` while that is unknown.
        srv_type: the name of its service type.
        reliability: ``"reliable"`` or ``"best_effort"``.
        problem: why its QoS does not match the default of services, None if it does.
    """

    node: str
    srv_type: str
    reliability: str
    problem: str | None


def server_endpoints(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the servers of a resolved name."""
    found = response_writers(node, srv_name)
    if found:
        return [_endpoint(info, _Role.SERVER) for info in found]
    return _endpoints_by_node(node, srv_name, node.get_service_names_and_types_by_node)


def client_endpoints(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the clients of a resolved name, this process's own included."""
    found = request_writers(node, srv_name)
    if found:
        return [_endpoint(info, _Role.CLIENT) for info in found]
    return _endpoints_by_node(node, srv_name, node.get_client_names_and_types_by_node)


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


def node_names(node: Node) -> list[str]:
    """Return the full names of all nodes, this one included. A name may occur several times."""
    names = node.get_node_names_and_namespaces()
    return sorted(_full_name(name, namespace) for name, namespace in names)


def graph_state(node: Node) -> object:
    """Return what the graph shows now, to compare with a later state."""
    return (node_names(node), node.get_service_names_and_types(), _participants(node))


def all_discovered(node: Node) -> bool:
    """Return whether every participant of this machine has been discovered, with its nodes.

    Each participant is one context of a process, and has a UDP port of its own in the range of the
    domain. Participants on other machines, or in other network namespaces, cannot be counted. The
    names of its nodes may come some time after its endpoints.
    """
    local = _local_participants(domain_id(node))
    return 0 < local <= _participants(node) <= len(node_names(node))


def local_domains() -> dict[int, int]:
    """Return the ROS domains in use on this machine, with their number of participants."""
    ports = _udp_ports()
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


def qos_problem(endpoint: TopicEndpointInfo) -> str | None:
    """Return why an endpoint of a service does not match the default QoS, None if it does."""
    ours, theirs = default_qos(), endpoint.qos_profile
    return incompatibility(ours, theirs) or incompatibility(theirs, ours)


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


class _Role:
    SERVER, CLIENT = "_Response_", "_Request_"


def _endpoint(info: TopicEndpointInfo, suffix: str) -> Endpoint:
    return Endpoint(
        node="" if "UNKNOWN" in info.node_name else _full_name(info.node_name, info.node_namespace),
        srv_type=_srv_type(info.topic_type, suffix),
        reliability=str(info.qos_profile.reliability.name).lower(),
        problem=qos_problem(info),
    )


def _srv_type(topic_type: str, suffix: str) -> str:
    """Return ``std_srvs/srv/SetBool`` for ``std_srvs::srv::dds_::SetBool_Response_``."""
    parts = topic_type.removesuffix(suffix).split("::")
    return "/".join(part for part in parts if part != "dds_")


def _endpoints_by_node(node: Node, srv_name: str, query: Callable[..., Any]) -> list[Endpoint]:
    """Ask each node: for middlewares that name the topics of a service otherwise."""
    return [
        Endpoint(_full_name(name, namespace), srv_type, "unknown", None)
        for name, namespace in node.get_node_names_and_namespaces()
        for srv_type in _types_of(query, name, namespace, srv_name)
    ]


def _types_of(query: Callable[..., Any], name: str, namespace: str, srv_name: str) -> Iterable[str]:
    # The node may have left the graph since it was listed.
    with contextlib.suppress(rclpy_implementation.NodeNameNonExistentError):
        return list(dict(query(name, namespace)).get(srv_name, ()))
    return ()


def _full_name(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _participants(node: Node) -> int:
    return len(node.get_publishers_info_by_topic(DISCOVERY_TOPIC, no_mangle=True))


def _local_participants(domain: int, ports: set[int] | None = None) -> int:
    """Count the participants of a domain on this machine by their UDP ports; 0 if unknown."""
    first = PORT_BASE + PORT_GAIN * domain + PORT_OFFSET
    used = _udp_ports() if ports is None else ports
    return sum(port in used for port in range(first, first + PORT_GAIN - PORT_OFFSET, 2))


def _udp_ports() -> set[int]:
    """Return the UDP ports in use in this network namespace, none if they cannot be read."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/net/udp").read_text().splitlines()[1:]
        return {int(line.split()[1].rpartition(":")[2], 16) for line in lines}
    return set()
