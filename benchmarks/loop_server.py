"""A server in an asyncio loop, on its client's own node: an eventfd, and no executor."""

from __future__ import annotations

import asyncio
import ctypes
import os
from typing import Any

from rclpy.callback_groups import CallbackGroup

from benchmarks.work import Work, load_type, make_handler, make_qos, make_response

__all__ = ["LoopServer", "signal_requests"]


class Untouched(CallbackGroup):  # type: ignore[misc]
    """Keeps a service from the executor that spins its node."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False


class LoopServer:
    """Answers one service at once, on the loop's thread."""

    def __init__(self, node: Any, work: Work, name: str) -> None:
        srv_type = load_type(work.srv_type)
        self._node = node
        self._service = node.create_service(
            srv_type,
            name,
            make_handler(work),
            qos_profile=make_qos(work.depth),
            callback_group=Untouched(),
        )
        self._request_type = srv_type.Request
        self._response = make_response(work)
        self._fd = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._answer)
        signal_requests(self._service.handle, self._fd)

    def close(self) -> None:
        signal_requests(self._service.handle, None)
        self._loop.remove_reader(self._fd)
        os.close(self._fd)
        self._node.destroy_service(self._service)

    def _answer(self) -> None:
        os.eventfd_read(self._fd)
        handle = self._service.handle
        while (taken := handle.service_take_request(self._request_type))[0] is not None:
            handle.service_send_response(self._response, taken[1].request_id)


def signal_requests(service: Any, fd: int | None) -> None:
    """Has the middleware count a service's new requests on an eventfd; None ends that."""
    on_request = ctypes.CDLL("librcl.so").rcl_service_set_on_new_request_callback
    on_request.argtypes = [ctypes.c_void_p] * 3
    callback = ctypes.cast(ctypes.CDLL(None).eventfd_write, ctypes.c_void_p)
    if on_request(service.pointer, None if fd is None else callback, fd):
        raise RuntimeError("the middleware takes no request callback")
