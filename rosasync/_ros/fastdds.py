"""The functions of Fast DDS that neither rcl nor rclpy offers, through ctypes.

Whether the middleware is Fast DDS is decided by what its library offers, not by its name.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any

from rclpy.exceptions import InvalidHandle
from rclpy.utilities import get_rmw_implementation_identifier

if TYPE_CHECKING:
    from rclpy.node import Node

__all__ = ["acknowledged", "end_discovery", "is_present", "load_profiles"]

RESPONSE_WRITER = "_ZN{length}{rmw}23get_response_datawriterEP13rmw_service_s"
"""``rmw_fastrtps_cpp::get_response_datawriter(rmw_service_t *)`` (rmw_fastrtps_cpp/get_service.hpp)
and its like in the namespace of another middleware of Fast DDS."""
WAITS = (
    "_ZN8eprosima7fastdds3dds10DataWriter24wait_for_acknowledgmentsERKNS_8fastrtps6Time_tE",
    "_ZN8eprosima7fastdds3dds10DataWriter24wait_for_acknowledgmentsERKNS1_6Time_tE",
)
"""``DataWriter::wait_for_acknowledgments(const Duration_t &)`` of Fast DDS 2.14 (Jazzy) and 3
(Kilted). Both return a code of 32 bits in a register: an integer, or a trivial class around one."""

PARTICIPANT = "_ZN{length}{rmw}22get_domain_participantEP10rmw_node_s"
"""``rmw_fastrtps_cpp::get_domain_participant(rmw_node_t *)`` (rmw_fastrtps_cpp/get_participant.hpp)
and its like, as above."""
SET_LISTENER = (
    "_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListenerE"
    "NSt6chrono8durationIlSt5ratioILl1ELl1EEEE"
)
"""``DomainParticipant::set_listener(DomainParticipantListener *, std::chrono::seconds)`` of both.
The seconds are passed as an integer of 64 bits; the return code is as above."""
LISTENER_TIMEOUT = 1
"""Whole seconds to wait for the end of a call of the participant's listener."""

FACTORY = "_ZN8eprosima7fastdds3dds24DomainParticipantFactory"
GET_FACTORY = f"{FACTORY}12get_instanceEv"
LOAD_DEFAULT = f"{FACTORY}13load_profilesEv"
LOAD_STRING = f"{FACTORY}24load_XML_profiles_stringEPKcm"
SET_DEFAULT = f"{FACTORY}27set_default_participant_qosERKNS1_20DomainParticipantQosE"
QOS_DEFAULT = "_ZN8eprosima7fastdds3dds23PARTICIPANT_QOS_DEFAULTE"
"""Public functions of ``DomainParticipantFactory``, and the QoS that stands for the default
profile. They have these names in Fast DDS 2.14 and 3, and return codes as above."""


class Duration(ctypes.Structure):
    """``Duration_t`` of Fast DDS, zero by default."""

    _fields_ = (("seconds", ctypes.c_int32), ("nanoseconds", ctypes.c_uint32))


class Acknowledgements:
    """The functions that lead from a service to the acknowledgements of its responses."""

    def __init__(self) -> None:
        self._writer = _getter("rcl_service_get_rmw_handle", RESPONSE_WRITER)
        rmw = _library()
        # The symbols of the libraries that it is linked with are found too.
        (self._wait,) = (getattr(rmw, name) for name in WAITS if hasattr(rmw, name))
        self._wait.argtypes = [ctypes.c_void_p, ctypes.POINTER(Duration)]
        self._wait.restype = ctypes.c_uint32

    def complete(self, pointer: int) -> bool:
        """Return whether all responses of an ``rcl_service_t`` were acknowledged; does not wait."""
        writer = self._writer(pointer)
        return bool(writer) and self._wait(writer, Duration()) == 0


def acknowledged(service: Any) -> bool:
    """Return whether all matched clients have acknowledged every response of a service.

    Args:
        service: the handle of an rclpy service, in use.

    Returns:
        False also if this middleware cannot tell.
    """
    acknowledgements = _load(Acknowledgements)
    return acknowledgements is not None and bool(acknowledgements.complete(service.pointer))


class Participants:
    """The functions that lead from a node to the listener of its participant."""

    def __init__(self) -> None:
        self._participant = _getter("rcl_node_get_rmw_handle", PARTICIPANT)
        self._set_listener = getattr(_library(), SET_LISTENER)
        self._set_listener.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64]
        self._set_listener.restype = ctypes.c_uint32

    def end_discovery(self, pointer: int) -> bool:
        """Remove the listener of the participant of an ``rcl_node_t``; waits while it is called."""
        participant = self._participant(pointer)
        return bool(participant) and self._set_listener(participant, None, LISTENER_TIMEOUT) == 0


def end_discovery(node: Node) -> bool:
    """End the discovery of a node's context, so that its participant can be destroyed safely.

    rmw_fastrtps removes the listener of a participant before it destroys it, and waits without a
    limit for a call of the listener that runs just then. In the wheels this never ends: they are
    built for a libc without ``pthread_cond_clockwait``, so the latest time of one clock is
    converted to another and overflows. ``pthread_cond_timedwait`` refuses it at once, each time,
    and never releases the mutex that the listener needs. With a limit nothing overflows; and once
    the listener is gone, there is no call to wait for.

    Args:
        node: the node. If it was destroyed, there is nothing to do.

    Returns:
        Whether it has ended. False if a call did not end within `LISTENER_TIMEOUT`, or this is not
        Fast DDS.
    """
    participants = _load(Participants)
    if participants is None:
        return False
    try:
        with node.handle:
            return bool(participants.end_discovery(node.handle.pointer))
    except InvalidHandle:
        return False


class Profiles:
    """The profiles of this process, in the factory that makes its participants."""

    def __init__(self) -> None:
        rmw = _library()
        get_factory = getattr(rmw, GET_FACTORY)
        get_factory.restype = ctypes.c_void_p
        self._factory = ctypes.c_void_p(get_factory())
        self._load_default = getattr(rmw, LOAD_DEFAULT)
        self._load_string = getattr(rmw, LOAD_STRING)
        self._set_default = getattr(rmw, SET_DEFAULT)
        self._load_default.argtypes = [ctypes.c_void_p]
        self._load_string.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t]
        self._set_default.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        for function in (self._load_default, self._load_string, self._set_default):
            function.restype = ctypes.c_uint32
        self._qos_default = ctypes.addressof(ctypes.c_char.in_dll(rmw, QOS_DEFAULT))

    def load(self, text: str) -> bool:
        """Add the profiles in a text, and use its default profile from now on, if it has one.

        Returns:
            Whether Fast DDS has accepted them.
        """
        data = text.encode()
        # It reads the user's files before the first participant. Read later, their default profile
        # would replace this one.
        self._load_default(self._factory)
        if self._load_string(self._factory, data, len(data)) != 0:
            return False
        return bool(self._set_default(self._factory, self._qos_default) == 0)


def load_profiles(text: str) -> bool:
    """Add profiles to those of this process, at any time.

    Entities that exist keep what they have.

    Args:
        text: the profiles, in XML. Their names must be new.

    Returns:
        Whether Fast DDS has accepted them; False also if this middleware has none.
    """
    profiles = _load(Profiles)
    return profiles is not None and bool(profiles.load(text))


@cache
def is_present() -> bool:
    """Return whether this middleware is Fast DDS: whether its library has the factory."""
    try:
        return hasattr(_library(), GET_FACTORY)
    except OSError:
        return False


@cache
def _load(functions: Callable[[], Any]) -> Any:
    """Make one of the classes of functions; None if this middleware lacks one of them."""
    try:
        return functions()
    except (OSError, AttributeError, ValueError):
        return None


def _library() -> ctypes.CDLL:
    return ctypes.CDLL(f"lib{get_rmw_implementation_identifier()}.so")


def _getter(get_handle: str, symbol: str) -> Callable[[int], int | None]:
    """Return the function that leads from an entity of rcl to what Fast DDS has for it.

    Args:
        get_handle: the function of librcl that returns the middleware's handle of the entity.
        symbol: the function of the middleware that takes this handle, without its namespace.
    """
    name = get_rmw_implementation_identifier()
    to_handle = getattr(ctypes.CDLL("librcl.so"), get_handle)
    to_entity = getattr(_library(), symbol.format(length=len(name), rmw=name))
    for function in (to_handle, to_entity):
        function.argtypes = [ctypes.c_void_p]
        function.restype = ctypes.c_void_p
    return lambda pointer: to_entity(to_handle(pointer))
