"""The endpoints of a service, as the graph shows them.

A middleware of DDS makes two topics of a service
(https://design.ros2.org/articles/topic_and_service_names.html): the clients write requests to one,
and the server writes responses to the other. Zenoh has no such topics. There, rclpy's own query for
the servers of a service is used, if this rclpy has it and the middleware answers it (Lyrical).
Without either, the nodes are asked for the services that they have, which identifies no server.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    qos_check_compatible,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync._core.ports import Service

__all__ = [
    "GUID_PREFIX",
    "Endpoint",
    "clients_of",
    "compatible",
    "full_name",
    "gid_of",
    "identified_servers",
    "incompatibility",
    "prefixes",
    "request_writers",
    "response_readers",
    "response_writers",
    "servers_of",
    "serves",
]

GUID_PREFIX = 12
"""Bytes at the start of an endpoint's GUID that name its participant (RTPS 2.5, 9.3.1)."""

REQUEST, RESPONSE = "_Request_", "_Response_"
"""The ends of the names of the DDS types of a service."""

READER, WRITER = 0, -1
"""The places of an endpoint's reader and writer in what rclpy lists of a service."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A server or a client of a service, as the graph shows it.

    Attributes:
        node: the full name of its node, ``""`` while that is unknown.
        srv_type: the name of its service type, ``""`` while that is unknown.
        qos: its QoS; None if the middleware does not tell.
        gid: its GUID, of the writer or reader of responses; None if the middleware does not tell.
    """

    node: str
    srv_type: str
    qos: QoSProfile | None
    gid: bytes | None = None


def servers_of(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the servers of a resolved name."""
    return identified_servers(node, srv_name) or _by_node(
        node, srv_name, node.get_service_names_and_types_by_node
    )


def identified_servers(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the servers of a resolved name; none if the middleware does not identify them."""
    if found := response_writers(node, srv_name):
        return [_endpoint(writer, RESPONSE) for writer in found]
    return _asked(node, "get_servers_info_by_service", srv_name, WRITER)


def clients_of(node: Node, srv_name: str) -> list[Endpoint]:
    """Return the clients of a resolved name, including those of the node itself."""
    if found := request_writers(node, srv_name):
        return [_endpoint(writer, REQUEST) for writer in found]
    return _asked(node, "get_clients_info_by_service", srv_name, READER) or _by_node(
        node, srv_name, node.get_client_names_and_types_by_node
    )


def full_name(name: str, namespace: str) -> str:
    """Return the full name of a node."""
    return f"{namespace.rstrip('/')}/{name}"


def request_writers(node: Node, srv_name: str) -> list[TopicEndpointInfo]:
    """Return the request writers of the clients of a resolved name."""
    return list(node.get_publishers_info_by_topic(f"rq{srv_name}Request", no_mangle=True))


def response_readers(node: Node, srv_name: str) -> list[TopicEndpointInfo]:
    """Return the response readers of the clients of a resolved name."""
    return list(node.get_subscriptions_info_by_topic(f"rr{srv_name}Reply", no_mangle=True))


def response_writers(node: Node, srv_name: str) -> list[TopicEndpointInfo]:
    """Return the response writers of the servers of a resolved name."""
    return list(node.get_publishers_info_by_topic(f"rr{srv_name}Reply", no_mangle=True))


def gid_of(endpoint: TopicEndpointInfo) -> bytes:
    """Return the GUID of an endpoint."""
    return bytes(endpoint.endpoint_gid)


def serves(server: Endpoint, service: Service, qos: QoSProfile) -> bool:
    """Return whether a server fits, by type and QoS.

    A service has the same QoS for its requests as for its responses.
    """
    return server.srv_type == service.key.srv_type and (
        server.qos is None or (compatible(server.qos, qos) and compatible(qos, server.qos))
    )


def compatible(writer: QoSProfile, reader: QoSProfile) -> bool:
    """Return whether the middleware matches a writer and a reader of these QoS."""
    return incompatibility(writer, reader) is None


def incompatibility(writer: QoSProfile, reader: QoSProfile) -> str | None:
    """Return why the middleware does not match a writer and a reader, None if it does."""
    verdict, reason = qos_check_compatible(_explicit(writer), _explicit(reader))
    return str(reason) if verdict == QoSCompatibility.ERROR else None


def prefixes(endpoints: Iterable[TopicEndpointInfo]) -> list[bytes]:
    """Return the participant of each endpoint, as the prefix of its GUID."""
    return [gid_of(endpoint)[:GUID_PREFIX] for endpoint in endpoints]


def _endpoint(info: TopicEndpointInfo, suffix: str) -> Endpoint:
    name = "" if "UNKNOWN" in info.node_name else full_name(info.node_name, info.node_namespace)
    return Endpoint(name, _srv_type(info.topic_type, suffix), info.qos_profile, gid_of(info))


def _srv_type(topic_type: str, suffix: str) -> str:
    """Return ``std_srvs/srv/SetBool`` for ``std_srvs::srv::dds_::SetBool_Response_``."""
    parts = topic_type.removesuffix(suffix).split("::")
    return "/".join(part for part in parts if part != "dds_")


def _asked(node: Node, query: str, srv_name: str, which: int) -> list[Endpoint]:
    """Ask rclpy for the endpoints of a service.

    Args:
        node: the node that asks.
        query: the name of its method, which rclpy has from 10.0.2 on.
        srv_name: the resolved name.
        which: the one of the two GUIDs and QoS that counts. Zenoh has only one of each.
    """
    if (ask := getattr(node, query, None)) is None:
        return []
    try:
        found = ask(srv_name)
    except NotImplementedError:  # by this middleware
        return []
    return [
        Endpoint(
            full_name(info.node_name, info.node_namespace),
            info.service_type,
            info.qos_profiles[which],
            bytes(info.endpoint_gids[which]),
        )
        for info in found
    ]


def _by_node(node: Node, srv_name: str, query: Callable[..., Any]) -> list[Endpoint]:
    """Ask each node, for middlewares that name the topics of a service otherwise.

    The answer may be some milliseconds old, and nodes of the same name hide each other.
    """
    return [
        Endpoint(full_name(name, namespace), srv_type, None)
        for name, namespace in node.get_node_names_and_namespaces()
        for srv_type in _types_of(query, name, namespace, srv_name)
    ]


def _types_of(query: Callable[..., Any], name: str, namespace: str, srv_name: str) -> Iterable[str]:
    # The node may have left the graph since it was listed.
    with contextlib.suppress(rclpy_implementation.NodeNameNonExistentError):
        return list(dict(query(name, namespace)).get(srv_name, ()))
    return ()


def _explicit(qos: QoSProfile) -> QoSProfile:
    """Return the QoS with the middleware's values for the defaults.

    The graph shows these values, but a profile that leaves them to the middleware has zeros. The
    comparison of the two would report an incompatibility.
    """
    unset = Duration()
    explicit = QoSProfile(depth=1, reliability=qos.reliability, durability=qos.durability)
    explicit.deadline = Infinite if qos.deadline == unset else qos.deadline
    lease = qos.liveliness_lease_duration
    explicit.liveliness_lease_duration = Infinite if lease == unset else lease
    explicit.liveliness = qos.liveliness or LivelinessPolicy.AUTOMATIC
    return explicit
