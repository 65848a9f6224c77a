"""What a session sets in Fast DDS, for its process."""

from __future__ import annotations

import logging
import os
import threading
from pathlib import Path
from xml.etree import ElementTree

from rosasync._ros import fastdds
from rosasync._ros.fresh_ports import fresh_offset
from rosasync._ros.profile import (
    HEARTBEAT,
    STOCK_HEARTBEAT,
    is_old,
    missing_heartbeats,
    participant_text,
    profile_text,
    profile_variable,
    switched_off,
    user_profile,
)

__all__ = ["configure", "heartbeats", "repair_time"]

logger = logging.getLogger("rosasync")

INITIAL_ENVIRONMENT = Path("/proc/self/environ")


def configure(domain: int) -> None:
    """Load rosasync's profile, and choose a port for the next participant of the process.

    Does nothing if the user has a profile or switched this one off.
    """
    if switched_off():
        return
    if file := user_profile(is_old()):
        _report_missing(file)
        return
    with _State.lock:
        _State.loaded = _State.loaded or fastdds.load_profiles(profile_text(is_old()))
        if _State.loaded:
            _choose_port(domain)
        elif not _State.reported:
            _State.reported = True
            logger.info(
                "this Fast DDS does not load rosasync's profile, so a lost request is repaired "
                "after 3 s; `rosasync profile` prints what to set in the environment",
            )


def heartbeats(kind: str = "client") -> bool:
    """Return whether it is certain that new clients of this process send frequent heartbeats.

    Args:
        kind: ``"client"`` for the requests of clients, ``"service"`` for the responses of services.
    """
    if user_profile(is_old()):
        return _user_heartbeats(kind)
    return _State.loaded and not switched_off()


def repair_time() -> float:
    """Return the seconds after which the middleware repairs a lost response of a new service."""
    return HEARTBEAT if heartbeats("service") or not fastdds.is_present() else STOCK_HEARTBEAT


class _State:
    lock = threading.Lock()
    """Held while profiles are loaded: sessions may open in several threads."""
    loaded = False
    """Whether Fast DDS has accepted rosasync's profile in this process."""
    reported = False
    """Whether the log says why it has not."""
    offset: int | None = None
    """The offset in the default profile for participants."""
    offsets: set[int] = set()  # noqa: RUF012 - the state of the process
    """The offsets for which there is a profile. Fast DDS accepts each name only once."""


def _choose_port(domain: int) -> None:
    offset = fresh_offset(domain, _State.offset)
    if offset is None or offset == _State.offset or offset in _State.offsets:
        return
    if fastdds.load_profiles(participant_text(f"rosasync-{offset}", offset)):
        _State.offset = offset
        _State.offsets.add(offset)


def _user_heartbeats(kind: str) -> bool:
    """Return whether the user's profile sets them, and Fast DDS has read it.

    It reads profiles before the first participant of the process. If the variable was set after
    the start of the process, this may have been earlier.
    """
    old = is_old()
    file, variable = user_profile(old), profile_variable(old)
    try:
        if file is None or kind in missing_heartbeats(file.read_text()):
            return False
        started_with = INITIAL_ENVIRONMENT.read_bytes().split(b"\0")
    except (OSError, ValueError, ElementTree.ParseError):
        return False
    given = os.environ.get(variable)
    return not given or os.fsencode(f"{variable}={given}") in started_with


def _report_missing(file: Path) -> None:
    try:
        missing = missing_heartbeats(file.read_text())
    except (OSError, ValueError, ElementTree.ParseError) as error:
        logger.info("the Fast DDS profile %s cannot be read: %s", file, error)
        return
    if missing:
        logger.info(
            "the Fast DDS profile %s sets no heartbeat period for the publishers %s, so a lost "
            "request or response is repaired after 3 s; `rosasync profile` prints what to add",
            file,
            " and ".join(repr(name) for name in missing),
        )
