"""Lossy hosts: they reach each other, lose packets as told, and leave nothing behind."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.hosts import NoHosts
from tests.support.lossy import LossyHosts
from tests.support.process import ended
from tests.support.times import LIMIT, TICK

PACKETS = 400
ECHO = """
import socket, sys
server = socket.socket(type=socket.SOCK_DGRAM)
server.bind(("", 7))
print("ready", flush=True)
while True:
    data, sender = server.recvfrom(2000)
    server.sendto(data, sender)
"""
ASK = """
import socket, sys
client, back = socket.socket(type=socket.SOCK_DGRAM), 0
client.settimeout(float(sys.argv[3]))
for _ in range(int(sys.argv[2])):
    client.sendto(b"x", (sys.argv[1], 7))
    try:
        back += client.recv(10) == b"x"
    except TimeoutError:
        pass
print(back)
"""


def ask(hosts: LossyHosts, host: str, packets: int, patience: float = LIMIT) -> int:
    """Return how many packets came back from the server, each within seconds of ``patience``."""
    arguments = (hosts.address("server"), str(packets), str(patience))
    command = [*hosts.on(host), sys.executable, "-c", ASK, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return int(done.stdout)


def test_three_hosts() -> None:
    try:
        with LossyHosts("server", "one", "two", seed=1) as hosts:
            spaces = [Path("/run/netns", hosts.namespace(n)) for n in ("server", "one", "two")]
            assert all(space.exists() for space in spaces)
            command = [*hosts.on("server"), sys.executable, "-c", ECHO]
            with ended(subprocess.Popen(command, stdout=subprocess.PIPE)) as server:
                assert server.stdout is not None
                assert server.stdout.readline() == b"ready\n"
                assert ask(hosts, "one", PACKETS) == ask(hosts, "two", PACKETS) == PACKETS
                assert hosts.counts()["lost"] == 0
                hosts.set(loss=0.2)
                assert ask(hosts, "one", 40, 4 * TICK) < 40
                assert hosts.counts()["lost"] > 0
    except NoHosts as exc:
        pytest.skip(str(exc))
    assert not any(space.exists() for space in spaces)
