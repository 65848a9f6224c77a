"""Which servers of this host have crashed, although the graph still shows them."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from rosasync._ros import host
from rosasync._ros.discovery import ports_of
from rosasync._ros.host import DISCOVERY_TOPIC, ended

OURS, OTHERS = b"\x01\x0f\x12\x34", b"\x01\x0f\x56\x78"
DOMAIN = 3


def guid(process: int, kind: bytes = OURS) -> bytes:
    """Return a GUID of a process, as Fast DDS makes it."""
    return (
        kind + (process & 0xFFFF).to_bytes(2, "little") + b"\xaa\xbb" + bytes(4) + b"\0\0\x04\x03"
    )


def dead_process() -> int:
    """Return an id that is no process's, nor ends as one's."""
    alive = {int(name) & 0xFFFF for name in os.listdir("/proc") if name.isdecimal()}
    return next(number for number in range(1, 0x10000) if number not in alive)


ME, DEAD = guid(os.getpid()), guid(dead_process())


class Node:
    """A node whose graph shows these participants."""

    def __init__(self, *participants: bytes) -> None:
        self.participants = participants
        self.context = SimpleNamespace(get_domain_id=lambda: DOMAIN)

    def get_name(self) -> str:
        return "me"

    def get_namespace(self) -> str:
        return "/"

    def get_publishers_info_by_topic(self, topic: str, no_mangle: bool = False) -> list[Any]:
        if topic == DISCOVERY_TOPIC:
            return [SimpleNamespace(endpoint_gid=list(gid)) for gid in self.participants]
        names = ("me", "other")
        return [
            SimpleNamespace(endpoint_gid=list(gid), node_name=name, node_namespace="/")
            for gid, name in zip((ME, guid(1, OTHERS)), names, strict=True)
        ]


def find(node: Any, *gids: bytes) -> frozenset[bytes]:
    return ended(node, gids)


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The UDP ports in use: that of one participant."""
    used = [ports_of(DOMAIN)[0]]
    monkeypatch.setattr(host, "udp_sockets", lambda: iter([(port, "1") for port in used]))
    return used


@pytest.mark.usefixtures("sockets")
def test_a_process_that_is_no_more() -> None:
    assert find(Node(ME, DEAD), ME, DEAD) == {DEAD}
    assert find(Node(ME), ME) == frozenset()


@pytest.mark.usefixtures("sockets")
def test_processes_of_other_hosts_are_not_known() -> None:
    theirs = guid(dead_process(), OTHERS)
    assert find(Node(ME, theirs), theirs) == frozenset()


def test_a_process_of_a_container_with_this_network_may_be_there(sockets: list[int]) -> None:
    """Its ids are its own, but its participant has a socket here."""
    sockets.append(ports_of(DOMAIN)[1])
    assert find(Node(ME, DEAD), DEAD) == frozenset()


def test_without_sockets_nothing_is_certain(sockets: list[int]) -> None:
    sockets.clear()
    assert find(Node(ME, DEAD), DEAD) == frozenset()
