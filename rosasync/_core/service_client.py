"""ServiceClient: a service type and name bound to a session."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from types import EllipsisType
from typing import TYPE_CHECKING, Any, Generic, Literal

from rosasync.options import Retry, check_timeout
from rosasync.typing import RequestT, ResponseT, Timeout

if TYPE_CHECKING:
    from rosasync._client.service import ServicePool
    from rosasync._core.core import Core

__all__ = ["ServiceClient"]


class ServiceClient(Generic[RequestT, ResponseT]):
    """A service type and name bound to a session; see `Session.client`."""

    __slots__ = ("_core", "_retry", "_service", "_timeout", "_wait")

    def __init__(
        self,
        core: Core,
        service: ServicePool,
        timeout: float | None,
        wait: bool | float,
        retry: Retry | None,
    ) -> None:
        self._core = core
        self._service = service
        self._timeout = timeout
        self._wait = wait
        self._retry = retry

    def __repr__(self) -> str:
        return f"<ServiceClient {self.srv_name} [{self.srv_type}]>"

    @property
    def srv_name(self) -> str:
        """The resolved service name."""
        return self._service.service.key.srv_name

    @property
    def srv_type(self) -> str:
        """The name of the service type."""
        return self._service.service.key.srv_type

    @property
    def ready(self) -> bool:
        """Whether a server is matched, so that a call is sent at once."""
        self._core.check_loop()
        return self._service.match()

    async def call(
        self,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        wait: bool | float | EllipsisType = ...,
        retry: Retry | None = None,
    ) -> ResponseT:
        """Call the service; see `Session.call`."""
        core = self._core
        core.check_loop()
        service = self._service
        if wait is ...:
            wait = self._wait
        if retry is None:
            retry = self._retry
        message, seconds = core.arguments.check_call(
            service.service, request, timeout, self._timeout, wait, retry
        )
        response: ResponseT = await service.call(message, seconds, wait, retry)
        return response

    def start(
        self,
        request: RequestT | Mapping[str, Any] | None = None,
        *,
        timeout: Timeout = ...,
        wait: bool | float | EllipsisType = ...,
        retry: Retry | None = None,
    ) -> asyncio.Task[ResponseT]:
        """Start the same call as a task; see `Session.start`."""
        core = self._core
        core.check_loop()
        service = self._service
        if wait is ...:
            wait = self._wait
        if retry is None:
            retry = self._retry
        message, seconds = core.arguments.check_call(
            service.service, request, timeout, self._timeout, wait, retry
        )
        service.check_open()
        return service.start(message, seconds, wait, retry, copy=request is not None)

    async def wait(self, timeout: Timeout = None) -> Literal[True]:
        """Wait until a server is matched, and return True; see `Session.wait_for_service`."""
        self._core.check_loop()
        await self._service.wait_for_server(check_timeout(timeout, self._timeout))
        return True
