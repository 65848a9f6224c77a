"""The Fast DDS profile that makes services repair lost packets after 20 ms instead of 3 s.

On Jazzy it also moves the middleware's errors from stdout to stderr, where Kilted has them.

Fast DDS repairs a lost packet when the writer's next heartbeat shows the reader the gap, and sends
heartbeats every 3 s. rmw_fastrtps creates writers of requests with the profile named ``client``
and those of responses with the profile named ``service``, so a profile with these two names
reaches services and nothing else. A default profile for participants chooses the port at which
the next one receives messages (`rosasync._ros.fresh_ports`).
"""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from xml.etree import ElementTree

__all__ = [
    "HEARTBEAT",
    "STOCK_HEARTBEAT",
    "SWITCH",
    "is_old",
    "missing_heartbeats",
    "participant_text",
    "profile_text",
    "profile_variable",
    "switched_off",
    "user_profile",
    "with_offset",
]

HEARTBEAT = 0.02
"""Seconds between the heartbeats of a writer with unacknowledged samples."""
STOCK_HEARTBEAT = 3.0
"""The same without the profile."""
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
PARTICIPANT = """  <participant profile_name="{name}" is_default_profile="true"><rtps>
{settings}  </rtps></participant>
"""
ANNOUNCE = """    <!-- Announce every process each {milliseconds} ms instead of 3 s. -->
    <builtin><discovery_config><leaseAnnouncement>
      <sec>{seconds}</sec><nanosec>{nanoseconds}</nanosec>
    </leaseAnnouncement></discovery_config></builtin>
"""
PORT = """    <!-- Receive messages at ports that no dead process of this host has left behind. -->
    <port><offsetd3>{offset}</offsetd3></port>
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
    offset: int | None = None,
) -> str:
    """Return a profile in XML.

    Args:
        old: whether it is for Fast DDS 2, which names an element otherwise than Fast DDS 3.
        names: the profiles in it: ``client`` for requests, ``service`` for responses.
        heartbeat: seconds between heartbeats.
        announcement: seconds between the announcements of a process; None to leave them as they
            are.
        offset: what the first process adds to its metatraffic port for its messages, less 10
            (``offsetd3``); None to leave it as it is.
    """
    tag = "heartbeatPeriod" if old else "heartbeat_period"
    what = {"client": "Requests", "service": "Responses"}
    profiles = [
        WRITER.format(what=what[name], name=name, tag=tag, **_duration(heartbeat)) for name in names
    ]
    if announcement is not None or offset is not None:
        profiles.append(_participant("rosasync", announcement, offset))
    return PROFILE.format(profiles="".join(profiles), log=LOG if old else "")


def participant_text(name: str, offset: int) -> str:
    """Return a default profile for participants alone, with this name and ``offsetd3``."""
    return PROFILE.format(profiles=_participant(name, None, offset), log="")


def with_offset(text: str, offset: int) -> str:
    """Return a user's profiles with an ``offsetd3`` in the default profile for participants.

    Raises:
        ValueError: it is not XML, or chooses its ports itself.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not valid XML: {error}") from None
    namespace = str(root.tag).rpartition("}")[0]
    prefix = f"{namespace}}}" if namespace else ""
    if namespace:
        ElementTree.register_namespace("", namespace.removeprefix("{"))
    profiles = next((e for e in root.iter() if _tag(e) == "profiles"), root)
    default = [
        element
        for element in profiles
        if _tag(element) == "participant" and element.get("is_default_profile") == "true"
    ]
    attributes = {"profile_name": "rosasync", "is_default_profile": "true"}
    participant = (
        default[-1]
        if default
        else ElementTree.SubElement(profiles, f"{prefix}participant", attributes)
    )
    rtps = _child(participant, prefix, "rtps")
    port = next((element for element in rtps if _tag(element) == "port"), None)
    if port is not None and participant.get("profile_name") != attributes["profile_name"]:
        raise ValueError("its default profile for participants chooses the ports already")
    _child(_child(rtps, prefix, "port"), prefix, "offsetd3").text = str(offset)
    return ElementTree.tostring(root, encoding="unicode")


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


def _participant(name: str, announcement: float | None, offset: int | None) -> str:
    settings = ""
    if announcement is not None:
        settings += ANNOUNCE.format(**_duration(announcement))
    if offset is not None:
        settings += PORT.format(offset=offset)
    return PARTICIPANT.format(name=name, settings=settings)


def _child(parent: ElementTree.Element, prefix: str, tag: str) -> ElementTree.Element:
    """Return the child with this tag; create it if there is none."""
    found = next((element for element in parent if _tag(element) == tag), None)
    return ElementTree.SubElement(parent, f"{prefix}{tag}") if found is None else found


def _duration(seconds: float) -> dict[str, int]:
    whole, nanoseconds = divmod(round(seconds * 1e9), 10**9)
    milliseconds = round(seconds * 1000)
    return {"seconds": whole, "nanoseconds": nanoseconds, "milliseconds": milliseconds}


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]
