"""The functions of librcl that rclpy does not offer, through ctypes."""

from __future__ import annotations

import ctypes
import platform
import sys
from functools import cache
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.utilities import get_rmw_implementation_identifier

__all__ = ["Rcl", "client_gid", "load"]


class Rcl:
    """librcl, and the libc function used as its callback.

    ``rcl_event_callback_t`` is ``void (*)(const void * user_data, size_t number_of_events)``
    (rcl/event_callback.h). libc's ``int eventfd_write(int fd, eventfd_t value)`` fits that shape
    if a pointer, ``size_t`` and ``eventfd_t`` are passed in the same registers and an ``int`` is
    the low half of one, as on x86-64 and aarch64. So the middleware's own thread signals an
    eventfd without Python and without the GIL (a Python callback there can deadlock: rclpy issue
    1722).
    """

    def __init__(self) -> None:
        rcl = ctypes.CDLL("librcl.so")
        self._signal = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
        pointers = [ctypes.c_void_p] * 3
        self._on_response = rcl.rcl_client_set_on_new_response_callback
        self._on_response.argtypes = pointers
        self._on_request = rcl.rcl_service_set_on_new_request_callback
        self._on_request.argtypes = pointers
        self._on_message = rcl.rcl_subscription_set_on_new_message_callback
        self._on_message.argtypes = pointers
        self._graph = rcl.rcl_node_get_graph_guard_condition
        self._graph.argtypes = [ctypes.c_void_p]
        self._graph.restype = ctypes.c_void_p
        self._add_guard = rcl.rcl_wait_set_add_guard_condition
        self._add_guard.argtypes = [*pointers[:2], ctypes.POINTER(ctypes.c_size_t)]

    def signal_responses(self, client: Any, fd: int | None) -> bool:
        """Make an eventfd count the client's new responses; None ends it.

        Returns:
            False if the middleware does not support it or the client was destroyed.
        """
        return _set_callback(self._on_response, client, self._signal, fd)

    def signal_requests(self, service: Any, fd: int | None) -> bool:
        """Make an eventfd count the service's new requests; None ends it.

        Returns:
            False if the middleware does not support it or the service was destroyed.
        """
        return _set_callback(self._on_request, service, self._signal, fd)

    def signal_messages(self, subscription: Any, fd: int | None) -> bool:
        """Make an eventfd count the subscription's new messages; None ends it.

        Returns:
            False if the middleware does not support it or the subscription was destroyed.
        """
        return _set_callback(self._on_message, subscription, self._signal, fd)

    def add_graph_guard(self, node: Any, wait_set: Any) -> int | None:
        """Add the node's graph guard condition to a wait set.

        Returns:
            Its index there, or None if there is no such condition.
        """
        guard = self._graph(node.pointer)
        index = ctypes.c_size_t()
        if guard is None or self._add_guard(wait_set.pointer, guard, ctypes.byref(index)) != 0:
            return None
        return index.value


def _set_callback(function: Any, handle: Any, signal: Any, fd: int | None) -> bool:
    try:
        # Held, because another thread may destroy the node meanwhile, as a shutdown on Kilted does.
        with handle:
            if fd is None:
                return bool(function(handle.pointer, None, None) == 0)
            # rmw_fastrtps counts the queued messages and then installs its listener. A message that
            # arrives in between is neither counted nor signalled, so a second call counts it.
            arguments = (handle.pointer, signal, ctypes.c_void_p(fd))
            return all(function(*arguments) == 0 for _ in range(2))
    except InvalidHandle:
        return False


class _Gid(ctypes.Structure):
    """``rmw_gid_t``."""

    _fields_ = (("middleware", ctypes.c_char_p), ("data", ctypes.c_uint8 * 16))


def client_gid(client: Any) -> bytes | None:
    """Return the GID that the middleware gives a client, None if it cannot be asked.

    Args:
        client: the handle of an rclpy client.
    """
    functions = _load_gids()
    if functions is None:
        return None
    get_handle, get_gid = functions
    gid = _Gid()
    with client:
        failed = get_gid(get_handle(client.pointer), ctypes.byref(gid))
    return None if failed else bytes(gid.data)


@cache
def _load_gids() -> tuple[Any, Any] | None:
    try:
        get_handle = ctypes.CDLL("librcl.so").rcl_client_get_rmw_handle
        rmw = ctypes.CDLL(f"lib{get_rmw_implementation_identifier()}.so")
        get_gid = rmw.rmw_get_gid_for_client
    except (OSError, AttributeError):
        return None
    get_handle.argtypes, get_handle.restype = [ctypes.c_void_p], ctypes.c_void_p
    get_gid.argtypes = [ctypes.c_void_p, ctypes.POINTER(_Gid)]
    return get_handle, get_gid


@cache
def load() -> Rcl | None:
    """Return librcl, or None if this platform does not support it."""
    if sys.platform != "linux" or platform.machine() not in ("x86_64", "aarch64"):
        return None
    if sys.maxsize < 2**32:
        return None
    try:
        return Rcl()
    except (OSError, AttributeError):
        return None
