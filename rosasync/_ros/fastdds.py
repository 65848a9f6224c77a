"""Asks Fast DDS whether responses were acknowledged, which neither rcl nor rclpy can tell."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from rclpy.utilities import get_rmw_implementation_identifier

__all__ = ["acknowledged"]

RMW = "rmw_fastrtps_cpp"
RESPONSE_WRITER = "_ZN16rmw_fastrtps_cpp23get_response_datawriterEP13rmw_service_s"
"""``rmw_fastrtps_cpp::get_response_datawriter(rmw_service_t *)`` (rmw_fastrtps_cpp/get_service.hpp)
returns null for a service of another middleware."""
WAITS = (
    "_ZN8eprosima7fastdds3dds10DataWriter24wait_for_acknowledgmentsERKNS_8fastrtps6Time_tE",
    "_ZN8eprosima7fastdds3dds10DataWriter24wait_for_acknowledgmentsERKNS1_6Time_tE",
)
"""``DataWriter::wait_for_acknowledgments(const Duration_t &)`` of Fast DDS 2.14 (Jazzy) and 3
(Kilted). Both return a code of 32 bits in a register: an integer, or a trivial class around one."""


class Duration(ctypes.Structure):
    """``Duration_t`` of Fast DDS, zero by default."""

    _fields_ = (("seconds", ctypes.c_int32), ("nanoseconds", ctypes.c_uint32))


class Acknowledgements:
    """The three functions that lead from a service to the acknowledgements of its responses."""

    def __init__(self) -> None:
        self._rmw_service = ctypes.CDLL("librcl.so").rcl_service_get_rmw_handle
        rmw = ctypes.CDLL(f"lib{RMW}.so")
        self._writer = getattr(rmw, RESPONSE_WRITER)
        # The symbols of the libraries that it is linked with are found too.
        (self._wait,) = (getattr(rmw, name) for name in WAITS if hasattr(rmw, name))
        for function in (self._rmw_service, self._writer):
            function.argtypes = [ctypes.c_void_p]
            function.restype = ctypes.c_void_p
        self._wait.argtypes = [ctypes.c_void_p, ctypes.POINTER(Duration)]
        self._wait.restype = ctypes.c_uint32

    def complete(self, pointer: int) -> bool:
        """Return whether all responses of an ``rcl_service_t`` were acknowledged; does not wait."""
        writer = self._writer(self._rmw_service(pointer))
        return bool(writer) and self._wait(writer, Duration()) == 0


def acknowledged(service: Any) -> bool:
    """Return whether all matched clients have acknowledged every response of a service.

    Args:
        service: the handle of an rclpy service, in use.

    Returns:
        False also if this middleware cannot tell.
    """
    acknowledgements = _load()
    return acknowledgements is not None and acknowledgements.complete(service.pointer)


@cache
def _load() -> Acknowledgements | None:
    if get_rmw_implementation_identifier() != RMW:
        return None
    try:
        return Acknowledgements()
    except (OSError, AttributeError, ValueError):
        return None
