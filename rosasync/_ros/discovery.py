"""Asks the other participants to announce themselves again, once this one listens.

A participant of Fast DDS announces itself before it listens (``RTPSParticipantImpl::enable`` starts
the builtin protocols, then registers the receivers). A process on the same host answers within a
millisecond, so about half of all answers are lost, and the next announcement comes up to 3 s later.
In a fast network it is the same, but rarer.
More announcements do not help: a participant answers only one that it does not know yet.

So this module introduces a participant that exists for a second and has no endpoints. Its address
is the real participant's, which receives the answers.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

__all__ = [
    "introduce",
    "introduced",
    "introduction",
    "multicast_port",
    "own_ports",
    "ports_of",
    "udp_sockets",
]

SELF = "self"
LEASE = 1
"""Seconds until the other participants forget the one that is introduced."""
PARTICIPANTS = 32
"""Participants of a domain on one host that are asked: as many as Fast DDS looks for itself."""
LOCALHOST, LOOPBACK = "127.0.0.1", "lo"
MULTICAST = "239.255.0.1"
"""The group in which participants announce themselves to the network."""

# Ports and parameters of the RTPS specification, 2.3: sections 9.6.1 and 9.6.2.2.
BASE, DOMAIN_GAIN, UNICAST, PARTICIPANT_GAIN = 7400, 250, 10, 2
PROTOCOL, VENDOR, LEASE_DURATION, GUID = 0x15, 0x16, 0x02, 0x50
METATRAFFIC_LOCATOR, DEFAULT_LOCATOR, ENDPOINTS, DOMAIN = 0x32, 0x31, 0x58, 0x0F
VERSION, EPROSIMA = b"\x02\x03", b"\x01\x0f"
PARTICIPANT, WRITER, READER = b"\x00\x00\x01\xc1", b"\x00\x01\x00\xc2", b"\x00\x01\x00\xc7"
ONLY_A_READER = 2
DATA, LITTLE_ENDIAN_WITH_DATA = 0x15, 0x05


@contextlib.contextmanager
def introduced(domain: int) -> Iterator[None]:
    """Let the other participants announce themselves to one that is made in the block.

    Sends 31 packets on the loopback device, in about 1 ms. If the participant uses multicast, also
    one on each device to other hosts.
    """
    before = own_ports(domain)
    yield
    for port in own_ports(domain) - before:
        introduce(domain, port)


def introduce(domain: int, port: int, process: int | str = SELF) -> None:
    """Let the other participants announce themselves to the one that listens at a port.

    Args:
        domain: the ROS domain.
        port: the port on which the participant listens for announcements.
        process: the id of its process, if it is not this one.
    """
    _introduce_on_host(domain, port)
    if multicast_port(domain) in _udp_ports_of(process):
        for index, name in socket.if_nameindex():
            if name != LOOPBACK:
                _introduce_on_network(domain, port, index)


def own_ports(domain: int, process: int | str = SELF) -> set[int]:
    """Return the ports on which a process's participants of the domain listen."""
    return _udp_ports_of(process) & {*ports_of(domain)}


def multicast_port(domain: int) -> int:
    """Return the port on which participants listen for what is sent to all of the domain."""
    return BASE + DOMAIN_GAIN * domain


def _introduce_on_host(domain: int, port: int) -> None:
    packet = introduction(domain, port)
    with contextlib.suppress(OSError), socket.socket(type=socket.SOCK_DGRAM) as sender:
        for other in ports_of(domain):
            if other != port:
                sender.sendto(packet, (LOCALHOST, other))


def _introduce_on_network(domain: int, port: int, device: int) -> None:
    # An error means that the device is down or has no address.
    with contextlib.suppress(OSError), socket.socket(type=socket.SOCK_DGRAM) as sender:
        by_index = struct.pack("=8xi", device)
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, by_index)
        sender.connect((MULTICAST, multicast_port(domain)))
        # Another participant each time: the answer has to go to the address on this device.
        sender.send(introduction(domain, port, sender.getsockname()[0]))


def introduction(domain: int, port: int, address: str = LOCALHOST) -> bytes:
    """Return the announcement of a new participant that listens at a port of this host."""
    prefix = os.urandom(12)
    locator = struct.pack("<iI12x", 1, port) + socket.inet_aton(address)
    parameters = {
        PROTOCOL: VERSION + bytes(2),
        VENDOR: EPROSIMA + bytes(2),
        LEASE_DURATION: struct.pack("<iI", LEASE, 0),
        GUID: prefix + PARTICIPANT,
        METATRAFFIC_LOCATOR: locator,
        DEFAULT_LOCATOR: locator,
        ENDPOINTS: struct.pack("<I", ONLY_A_READER),
        DOMAIN: struct.pack("<I", domain),
    }
    encoded = (struct.pack("<HH", key, len(value)) + value for key, value in parameters.items())
    payload = b"\x00\x03\x00\x00" + b"".join(encoded) + b"\x01\x00\x00\x00"
    # The first sample, without inline QoS.
    sample = struct.pack("<HH4s4siI", 0, 16, READER, WRITER, 0, 1) + payload
    header = b"RTPS" + VERSION + EPROSIMA + prefix
    return header + struct.pack("<BBH", DATA, LITTLE_ENDIAN_WITH_DATA, len(sample)) + sample


def ports_of(domain: int, participants: int = PARTICIPANTS) -> range:
    """Return the ports on which the first participants of a host listen for announcements."""
    first = BASE + DOMAIN_GAIN * domain + UNICAST
    return range(first, first + PARTICIPANT_GAIN * participants, PARTICIPANT_GAIN)


def udp_sockets() -> Iterator[tuple[int, str]]:
    """Yield the port and the inode of each UDP socket of this network namespace, if readable."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/net/udp").read_text().splitlines()[1:]:
            fields = line.split()
            yield int(fields[1].rpartition(":")[2], 16), fields[9]


def _udp_ports_of(process: int | str) -> set[int]:
    """Return the ports of a process's UDP sockets, as far as this user may see them."""
    names = set()
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{process}/fd").iterdir():
            with contextlib.suppress(OSError):
                names.add(os.readlink(descriptor))
    return {port for port, inode in udp_sockets() if f"socket:[{inode}]" in names}
