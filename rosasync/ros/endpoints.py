"""The DDS endpoints of a service, as the graph shows them.

rmw makes two topics of a service (https://design.ros2.org/articles/topic_and_service_names.html):
the clients write requests to one, and the server writes responses to the other.
"""

from __future__ import annotations

from collections.abc import Iterable

from rclpy.duration import Duration, Infinite
from rclpy.node import Node
from rclpy.qos import (
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    qos_check_compatible,
)
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync.ports import Service

__all__ = [
    "GUID_PREFIX",
    "compatible",
    "gid_of",
    "incompatibility",
    "prefixes",
    "request_writers",
    "response_readers",
    "response_writers",
    "serves",
]

GUID_PREFIX = 12
"""Bytes at the start of an endpoint's GUID that name its participant (RTPS 2.5, 9.3.1)."""


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


def serves(writer: TopicEndpointInfo, service: Service, qos: QoSProfile) -> bool:
    """Return whether this response writer's server fits, by type and QoS.

    A service has the same QoS for its requests as for its responses.
    """
    *path, name = service.key.srv_type.split("/")
    return bool(
        writer.topic_type == "::".join([*path, "dds_", f"{name}_Response_"])
        and compatible(writer.qos_profile, qos)
        and compatible(qos, writer.qos_profile)
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
