"""Asks the participants on this host to announce themselves again, once this one listens.

A participant of Fast DDS announces itself before it listens (``RTPSParticipantImpl::enable`` starts
the builtin protocols, then registers the receivers). A process on the same host answers within a
millisecond, so about half of all answers are lost, and the next announcement comes up to 3 s later.
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

__all__ = ["introduced", "introduction", "own_ports", "ports_of", "udp_sockets"]

LEASE = 1
"""Seconds until the other participants forget the one that is introduced."""
PARTICIPANTS = 32
"""Participants of a domain on one host that are asked: as many as Fast DDS looks for itself."""
LOCALHOST = "127.0.0.1"

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
    """Let the participants on this host announce themselves to one that is made in the block.

    Sends 31 packets on the loopback device, in about 1 ms.
    """
    before = own_ports(domain)
    yield
    for port in own_ports(domain) - before:
        _introduce(domain, port)


def own_ports(domain: int) -> set[int]:
    """Return the ports on which this process's participants of the domain listen."""
    sockets, ports = _own_sockets(), ports_of(domain)
    return {port for port, inode in udp_sockets() if inode in sockets and port in ports}


def _introduce(domain: int, port: int) -> None:
    packet = introduction(domain, port)
    with contextlib.suppress(OSError), socket.socket(type=socket.SOCK_DGRAM) as sender:
        for other in ports_of(domain):
            if other != port:
                sender.sendto(packet, (LOCALHOST, other))


def introduction(domain: int, port: int) -> bytes:
    """Return the announcement of a new participant that listens at a port of this host."""
    prefix = os.urandom(12)
    locator = struct.pack("<iI12x", 1, port) + socket.inet_aton(LOCALHOST)
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


def _own_sockets() -> set[str]:
    names = set()
    for descriptor in Path("/proc/self/fd").glob("*"):
        with contextlib.suppress(OSError):
            names.add(os.readlink(descriptor))
    return {name[len("socket:[") : -1] for name in names if name.startswith("socket:[")}
