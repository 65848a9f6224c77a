"""The arguments of a call, checked in one place for every way to make one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosasync.options import check_retry, check_timeout, check_wait

if TYPE_CHECKING:
    from rosasync._core.ports import NodePort, Service
    from rosasync.options import Retry
    from rosasync.typing import Timeout

__all__ = ["ArgumentChecker"]


class ArgumentChecker:
    """Checks the arguments of a call before anything is sent. Its methods may run on any thread."""

    def __init__(self, node: NodePort) -> None:
        self._node = node
        # Needs no lock: each access is a single operation, which is atomic.
        self._known: dict[tuple[Any, str], Service] = {}

    def service(self, srv_type: Any, srv_name: str, qos: Any) -> Service:
        """Resolve a service; raises as `NodePort.describe`."""
        if qos is not None:
            return self._node.describe(srv_type, srv_name, qos)
        try:
            return self._known[srv_type, srv_name]
        except (KeyError, TypeError):
            service = self._node.describe(srv_type, srv_name, None)
        self._known[srv_type, srv_name] = service
        return service

    def check_call(
        self,
        service: Service,
        request: Any,
        timeout: Timeout,
        default: float | None,
        wait: bool | float = True,
        retry: Retry | None = None,
    ) -> tuple[Any, float | None]:
        """Return the message to send, and the timeout in seconds (None for no deadline).

        Args:
            service: the service to call.
            request: a message, a mapping of its fields, or None for an empty one.
            timeout: what the caller passed.
            default: the timeout to use if the caller passed none.
            wait: checked to be a bool or a number of seconds.
            retry: checked to be a `Retry` or None.

        Raises:
            TypeError, ValueError: an argument does not fit.
        """
        if not service.fits(request):
            request = self._node.make_message(service.srv_type.Request, request)
        if timeout is not ...:
            default = check_timeout(timeout, None)
        if retry is not None:
            check_retry(retry)
        if wait is not True:
            check_wait(wait)
        return request, default

    def check_defaults(
        self, timeout: Timeout, default: float | None, wait: bool | float, retry: Retry | None
    ) -> float | None:
        """Check what a client's calls use if they give nothing; return the timeout.

        Raises:
            TypeError, ValueError: an argument does not fit.
        """
        if retry is not None:
            check_retry(retry)
        if wait is not True:
            check_wait(wait)
        return check_timeout(timeout, default)
