"""What the clients of a node's own services share: parameters and lifecycle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rosasync.errors import InvalidServiceName

if TYPE_CHECKING:
    from rosasync.options import Retry
    from rosasync.session import Session
    from rosasync.typing import Timeout

__all__ = ["NodeClient"]


class NodeClient:
    """Calls the services that a node offers under its own name.

    Args:
        session: an open session.
        node_name: the node's name.
        timeout: seconds for a call that gives no timeout, None for no deadline; ``...`` for the
            session's.
        srv_type: the name of the type of one of the services, by which the node's name is resolved.
        service: the last part of that service's name.

    Raises:
        TypeError: the node's name is not a str.
        InvalidServiceName: it is empty.
        Exception: as `Session.client`.
    """

    def __init__(
        self, session: Session, node_name: str, timeout: Timeout, srv_type: str, service: str
    ) -> None:
        if not isinstance(node_name, str):
            raise TypeError(f"a node's name is a str, not a {type(node_name).__name__}")
        if not node_name:
            raise InvalidServiceName("the name of a node is missing: expected one such as '/arm'")
        client = session.client(srv_type, f"{node_name}/{service}", timeout=timeout)
        self._session = session
        self._timeout = timeout
        self._node_name = client.srv_name.removesuffix(f"/{service}")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._node_name}>"

    @property
    def node_name(self) -> str:
        """The node's full name."""
        return self._node_name

    async def _call_node(
        self,
        srv_type: str,
        service: str,
        request: Mapping[str, Any],
        timeout: Timeout,
        retry: Retry | None = None,
    ) -> Any:
        return await self._session.call(
            srv_type,
            f"{self._node_name}/{service}",
            request,
            timeout=self._timeout if timeout is ... else timeout,
            retry=retry,
        )
