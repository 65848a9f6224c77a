"""A session asks the participants on its host to announce themselves again."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
from collections.abc import Iterator

import pytest

import rosasync
from rosasync._ros import discovery, profile
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT

PARTICIPANT_DATA = b"\x00\x01\x00\xc2"
LAST = 2 * (discovery.PARTICIPANTS - 1)


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    """Where another participant of the domain would listen."""
    with socket.socket(type=socket.SOCK_DGRAM) as listening:
        listening.bind((discovery.LOCALHOST, 7410 + 250 * domain() + LAST))
        listening.settimeout(LIMIT)
        yield listening


def domain() -> int:
    return int(os.environ["ROS_DOMAIN_ID"])


def introductions(listener: socket.socket) -> list[bytes]:
    """Return the packets that have come and have the length of an introduction."""
    listener.setblocking(False)
    packets = []
    with contextlib.suppress(BlockingIOError):
        while True:
            packets.append(listener.recv(1 << 16))
    length = len(discovery.introduction(domain(), 1))
    return [packet for packet in packets if len(packet) == length]


def test_a_stock_node_answers_at_the_address(server: ServerProcess) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as asking:
        asking.bind((discovery.LOCALHOST, 0))
        asking.settimeout(LIMIT)
        packet = discovery.introduction(domain(), asking.getsockname()[1])
        for port in discovery.ports_of(domain()):
            asking.sendto(packet, (discovery.LOCALHOST, port))
        answer = asking.recv(1 << 16)
    assert answer.startswith(b"RTPS")
    assert PARTICIPANT_DATA in answer
    assert answer[8:20] != packet[8:20]


async def test_a_session_introduces_itself(listener: socket.socket) -> None:
    before = discovery.own_ports(domain())
    async with rosasync.Session():
        [port] = discovery.own_ports(domain()) - before
        [packet] = introductions(listener)
    assert port.to_bytes(4, "little") + bytes(12) + b"\x7f\x00\x00\x01" in packet


async def test_switched_off(listener: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(profile.SWITCH, "off")
    async with rosasync.Session():
        await asyncio.to_thread(listener.recv, 1 << 16, socket.MSG_PEEK)
        assert introductions(listener) == []


def test_one_that_uses_multicast_introduces_itself_to_the_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loopback = socket.if_nametoindex(discovery.LOOPBACK)
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(loopback, "eth0"), (10_000, "gone")])
    with (
        socket.socket(type=socket.SOCK_DGRAM) as group,
        socket.socket(type=socket.SOCK_DGRAM) as own,
    ):
        group.bind(("", discovery.multicast_port(domain())))
        member = struct.pack("=4s4xi", socket.inet_aton(discovery.MULTICAST), loopback)
        group.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        port = discovery.ports_of(domain())[-1]
        with discovery.introduced(domain()):
            own.bind(("", port))
        [packet] = introductions(group)
    assert port.to_bytes(4, "little") + bytes(12) in packet


def test_without_a_new_participant_nothing_is_sent(listener: socket.socket) -> None:
    with discovery.introduced(domain()):
        pass
    assert introductions(listener) == []
