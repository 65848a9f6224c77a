"""The identities of a node's own clients and servers, by which other processes know them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rosasync._ros import fastdds
from rosasync._ros.endpoints import GUID_PREFIX, gid_of, request_writers
from rosasync._ros.rcl import client_gid

__all__ = ["Identities"]

Query = Callable[[Node, str], list[TopicEndpointInfo]]


class Identities:
    """Finds the GUID of an endpoint by what its creation adds to the graph.

    rclpy shows no GUID of its own clients and services, but the graph has them as soon as they are
    created: a query before and one after differ by them. Each takes 0.16 ms.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # The start of the GUIDs of this process, once it is known.
        self._process: bytes | None = None
        # Whether the middleware knows clients by the GUIDs of the graph, once that is known.
        self._uses_guids: bool | None = None

    def before(self, query: Query, srv_name: str) -> Callable[[], bytes | None]:
        """Query the endpoints of a service; call what is returned after creating another.

        Returns:
            A function that returns the GUID of the endpoint created meanwhile. It returns None if
            the middleware does not show it, or if it cannot be told from one that another process
            has created meanwhile.
        """
        known = {gid_of(endpoint) for endpoint in query(self._node, srv_name)}

        def created() -> bytes | None:
            added = {gid_of(endpoint) for endpoint in query(self._node, srv_name)} - known
            if len(added) > 1 and self._process is not None:
                added = {gid for gid in added if gid.startswith(self._process)}
            if len(added) != 1:
                return None
            (gid,) = added
            self._process = gid[:GUID_PREFIX]
            return gid

        return created

    def confirm(self, client: Any, srv_name: str, guid: bytes | None) -> bytes | None:
        """Return what a server knows a client by.

        Requests of Fast DDS have the GUID of the response reader. Those of Cyclone DDS name their
        client by a number of its own, which the graph does not show. So without Fast DDS, the GUID
        counts only if the GID of the first client is one of the graph's.

        Args:
            client: the handle of the client.
            srv_name: the resolved name of its service.
            guid: the GUID of its response reader, if the graph shows it.

        Returns:
            None if it is unknown.
        """
        if guid is not None and self._uses_guids is None:
            self._uses_guids = fastdds.is_present() or self._shows(client, srv_name, guid)
        return guid if self._uses_guids else None

    def _shows(self, client: Any, srv_name: str, guid: bytes) -> bool:
        """Return whether the graph shows a client by the GID that the middleware gives it."""
        writers = (gid_of(writer) for writer in request_writers(self._node, srv_name))
        return client_gid(client) in {guid, *writers}
