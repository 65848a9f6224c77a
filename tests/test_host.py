"""Which servers of this host have crashed, although the graph still shows them."""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from rosasync._ros import host
from rosasync._ros.discovery import ports_of
from rosasync._ros.graph import GraphQueries
from rosasync._ros.host import DISCOVERY_TOPIC, ended

OURS, OTHERS = b"\x01\x0f\x12\x34", b"\x01\x0f\x56\x78"
DOMAIN = 3


def guid(process: int, kind: bytes = OURS) -> bytes:
    """Return a GUID of a process, as Fast DDS makes it."""
    return (
        kind + (process & 0xFFFF).to_bytes(2, "little") + b"\xaa\xbb" + bytes(4) + b"\0\0\x04\x03"
    )


def dead_processes() -> Iterator[int]:
    """Yield ids that are no process's, nor end as one's."""
    alive = {int(name) & 0xFFFF for name in os.listdir("/proc") if name.isdecimal()}
    return (number for number in range(1, 0x10000) if number not in alive)


ME = guid(os.getpid())
DEAD, NEXT_DEAD = map(guid, itertools.islice(dead_processes(), 2))


class Handle(contextlib.nullcontext[None]):
    """The handle of a node that is up."""

    pointer = 1


class Node:
    """A node whose graph shows these participants."""

    def __init__(self, *participants: bytes) -> None:
        self.participants = participants
        self.context = SimpleNamespace(get_domain_id=lambda: DOMAIN, ok=lambda: True)
        self.handle = Handle()

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
    theirs = guid(next(dead_processes()), OTHERS)
    assert find(Node(ME, theirs), theirs) == frozenset()


def test_a_process_of_a_container_with_this_network_may_be_there(sockets: list[int]) -> None:
    """Its ids are its own, but its participant has a socket here."""
    sockets.append(ports_of(DOMAIN)[1])
    assert find(Node(ME, DEAD), DEAD) == frozenset()


def test_without_sockets_nothing_is_certain(sockets: list[int]) -> None:
    sockets.clear()
    assert find(Node(ME, DEAD), DEAD) == frozenset()


@pytest.mark.usefixtures("sockets")
def test_processes_that_their_parent_has_not_collected() -> None:
    """A container's first process may collect none."""
    with contextlib.ExitStack() as stack:
        started = [stack.enter_context(subprocess.Popen("true")) for _ in range(3)]
        for process in started:
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        dead = [guid(process.pid) for process in started]
        # Not all: a process may be alive whose id ends in the same bits.
        assert len(find(Node(ME, *dead), *dead)) > 1


@pytest.mark.usefixtures("sockets")
def test_a_participant_that_the_graph_is_losing() -> None:
    """The server of the first is still there, and what announced its nodes is gone."""
    assert find(Node(ME, NEXT_DEAD), DEAD, NEXT_DEAD) == {DEAD, NEXT_DEAD}


def test_a_process_that_has_ended_stays_so(sockets: list[int]) -> None:
    """The next server has its socket already when the one before it has crashed, too."""
    queries = GraphQueries(Node(ME, DEAD, NEXT_DEAD), events=True)
    assert queries.find_ended(frozenset({DEAD})) == {DEAD}
    sockets.append(ports_of(DOMAIN)[1])
    sockets.append(ports_of(DOMAIN)[2])
    assert queries.find_ended(frozenset({DEAD, NEXT_DEAD})) == {DEAD}
    del sockets[1:]
    assert queries.find_ended(frozenset({DEAD, NEXT_DEAD})) == {DEAD, NEXT_DEAD}
