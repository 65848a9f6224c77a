"""The Fast DDS profile that makes services repair lost packets after 20 ms instead of 3 s.

On Jazzy it also moves the middleware's errors from stdout to stderr, where Kilted has them.

Fast DDS repairs a lost packet when the writer's next heartbeat shows the reader the gap, and sends
heartbeats every 3 s. rmw_fastrtps creates writers of requests with the profile named ``client``
and those of responses with the profile named ``service``, so a profile with these two names
reaches services and nothing else. Fast DDS reads profiles once, before the first participant of a
process.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

__all__ = [
    "HEARTBEAT",
    "SWITCH",
    "applied",
    "heartbeats",
    "is_old",
    "missing_heartbeats",
    "profile_text",
    "profile_variable",
    "switched_off",
    "user_profile",
]

logger = logging.getLogger("rosasync")

HEARTBEAT = 0.02
"""Seconds between the heartbeats of a writer with unacknowledged samples."""
ANNOUNCEMENT = 0.2
"""Seconds between a process's announcements of itself, in a profile for every process."""
SWITCH = "ROSASYNC_PROFILE"
"""The environment variable that switches the profile off: ``ROSASYNC_PROFILE=off``."""

OLD_VARIABLE, NEW_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
OLD_FILE, NEW_FILE = "DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml"
SKIP_FILE = "SKIP_DEFAULT_XML_FILE"
NAMES = ("client", "service")

PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
<profiles>
{profiles}</profiles>
{log}</dds>
"""
LOG = """<!-- The middleware's errors: to stderr instead of stdout. -->
<log><use_default>FALSE</use_default><consumer>
  <class>StdoutErrConsumer</class>
  <property><name>stderr_threshold</name><value>Log::Kind::Error</value></property>
</consumer></log>
"""
WRITER = """  <!-- {what}: repair a lost packet after {milliseconds} ms instead of 3 s. -->
  <publisher profile_name="{name}"><times><{tag}>
    <sec>{seconds}</sec><nanosec>{nanoseconds}</nanosec>
  </{tag}></times></publisher>
"""
PARTICIPANT = """  <!-- Announce every process each {milliseconds} ms instead of 3 s. -->
  <participant profile_name="rosasync" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseAnnouncement><sec>{seconds}</sec><nanosec>{nanoseconds}</nanosec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
"""


def is_old() -> bool:
    """Return whether the installed rclpy uses Fast DDS 2, as Jazzy does, without importing it."""
    try:
        return int(version("rclpy").split(".")[0]) < 8
    except PackageNotFoundError:
        return os.environ.get("ROS_DISTRO", "") in ("humble", "iron", "jazzy")


def switched_off() -> bool:
    """Return whether the user switched off what rosasync sets in the middleware."""
    return os.environ.get(SWITCH, "").lower() == "off"


def profile_variable(old: bool) -> str:
    """Return the environment variable that names a profile file for Fast DDS 2 or 3."""
    return OLD_VARIABLE if old else NEW_VARIABLE


def profile_text(
    old: bool,
    *,
    names: tuple[str, ...] = NAMES,
    heartbeat: float = HEARTBEAT,
    announcement: float | None = None,
) -> str:
    """Return a profile in XML.

    Args:
        old: whether it is for Fast DDS 2, which names an element otherwise than Fast DDS 3.
        names: the profiles in it: ``client`` for requests, ``service`` for responses.
        heartbeat: seconds between heartbeats.
        announcement: seconds between the announcements of a process; None to leave them as they
            are.
    """
    tag = "heartbeatPeriod" if old else "heartbeat_period"
    what = {"client": "Requests", "service": "Responses"}
    profiles = [
        WRITER.format(what=what[name], name=name, tag=tag, **_duration(heartbeat)) for name in names
    ]
    if announcement is not None:
        profiles.append(PARTICIPANT.format(**_duration(announcement)))
    return PROFILE.format(profiles="".join(profiles), log=LOG if old else "")


def user_profile(old: bool) -> Path | None:
    """Return the profile file that the user has configured, if any.

    Fast DDS also reads a file of a certain name in the working directory.
    """
    if named := os.environ.get(profile_variable(old)):
        return Path(named)
    file = Path(OLD_FILE if old else NEW_FILE)
    return file if os.environ.get(SKIP_FILE) != "1" and file.exists() else None


def missing_heartbeats(text: str) -> list[str]:
    """Return the names of the publishers for services that set no heartbeat period.

    Raises:
        ElementTree.ParseError: the text is not XML.
    """
    present = set()
    for element in ElementTree.fromstring(text).iter():
        if _tag(element) in ("publisher", "data_writer"):
            tags = {_tag(inner) for inner in element.iter()}
            if tags & {"heartbeatPeriod", "heartbeat_period"}:
                present.add(element.get("profile_name"))
    return [name for name in NAMES if name not in present]


def heartbeats() -> bool:
    """Return whether the requests of this process have frequent heartbeats."""
    return _State.applied or _user_heartbeats()


@contextlib.contextmanager
def applied(*, first: bool) -> Iterator[None]:
    """Let Fast DDS find the profile when the block makes a participant.

    Environment and file are gone afterwards: a child process configures itself. Does nothing if
    the user has a profile or switched this one off.

    Args:
        first: whether it is the first participant of the process. Later ones use what Fast DDS
            has read then.
    """
    old = is_old()
    if switched_off() or _State.applied:
        yield
    elif file := user_profile(old):
        _report_missing(file)
        yield
    elif not first:
        # Each process says it once.
        report = logger.debug if _State.reported else logger.info
        _State.reported = True
        report(
            "Fast DDS has read its profiles before this session, so a lost request is repaired "
            "after 3 s; `rosasync profile` prints what to set in the environment",
        )
        yield
    else:
        with TemporaryDirectory(prefix="rosasync-") as folder:
            file = Path(folder, "profile.xml")
            file.write_text(profile_text(old))
            with _environment(profile_variable(old), str(file)):
                yield
        _State.applied = True


class _State:
    applied = False
    """Whether Fast DDS has read rosasync's profile in this process."""
    reported = False
    """Whether the log says why it has not."""


def _user_heartbeats() -> bool:
    file = user_profile(is_old())
    try:
        return file is not None and "client" not in missing_heartbeats(file.read_text())
    except (OSError, ValueError, ElementTree.ParseError):
        return False


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    os.environ[name] = value
    try:
        yield
    finally:
        os.environ.pop(name, None)


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


def _duration(seconds: float) -> dict[str, int]:
    whole, nanoseconds = divmod(round(seconds * 1e9), 10**9)
    milliseconds = round(seconds * 1000)
    return {"seconds": whole, "nanoseconds": nanoseconds, "milliseconds": milliseconds}


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]
