"""Hosts on one machine, joined by a switch that loses and delays packets."""

from __future__ import annotations

import ctypes
import fcntl
import os
import random
import select
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.support.child import Child, serve_commands
from tests.support.hosts import ENVIRONMENT, NoHosts, bring_up, check_namespaces, run_ip

__all__ = ["LossyHosts"]

PATIENCE = 10.0
"""Seconds in which the switch answers."""

TUNSETIFF = 0x400454CA
IFF_TAP, IFF_NO_PI = 0x2, 0x1000
CLONE_NEWNET = 0x40000000
FRAME = 1 << 16
BATCH = 64
"""Frames that are read from one host before the others are looked at."""
ARP = b"\x08\x06"
"""The type of the frames that resolve addresses. A lost one would stop a host for a second."""


class LossyHosts:
    """Network namespaces, each joined by a network device to a switch in a process of its own.

    ::

        with LossyHosts("server", "client", loss=0.02) as hosts:
            subprocess.run([*hosts.on("client"), "ping", "-c", "1", hosts.address("server")])
            hosts.set(loss=0.2, delay=0.02)

    Run processes with the prefix `on` and with `environment`, which keeps Fast DDS from using
    shared memory. Broadcast and multicast packets reach every other host.

    Args:
        names: a name for each host, of letters.
        loss: the share of the packets that get lost, 0 to 1. Each receiver loses its own.
        delay: seconds that a packet takes from one host to another.
        seed: decides which packets get lost.

    Raises:
        NoHosts: on entering, if network namespaces cannot be made here; the message says why.
    """

    environment = ENVIRONMENT

    def __init__(
        self, *names: str, loss: float = 0.0, delay: float = 0.0, seed: int | None = None
    ) -> None:
        self._names = list(names or ("server", "client"))
        self._link = {"loss": loss, "delay": delay, "seed": seed}
        self._stack = ExitStack()

    def __enter__(self) -> LossyHosts:
        check_namespaces()
        if not Path("/dev/net/tun").exists():
            raise NoHosts("/dev/net/tun is missing")
        with self._stack:
            for name in self._names:
                run_ip("netns", "add", self.namespace(name))
                self._stack.callback(run_ip, "netns", "delete", self.namespace(name))
            namespaces = [self.namespace(name) for name in self._names]
            # Leaves the stack first: its devices end with it.
            self._switch = self._stack.enter_context(Child("tests.support.lossy", *namespaces))
            self.set(**self._link)
            for name in self._names:
                bring_up(self.namespace(name), self.address(name))
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.close()

    def namespace(self, name: str) -> str:
        """The network namespace of a host."""
        return f"rosasync-{os.getpid()}-{name}"

    def address(self, name: str) -> str:
        """The IPv4 address of a host."""
        return f"10.0.0.{self._names.index(name) + 1}"

    def on(self, name: str) -> list[str]:
        """The prefix of a command that runs on a host."""
        return ["ip", "netns", "exec", self.namespace(name)]

    def set(self, **link: Any) -> None:
        """Change ``loss``, ``delay`` or ``seed`` for the packets from now on."""
        self._switch.ask_now("set", patience=PATIENCE, **link)

    def counts(self) -> dict[str, int]:
        """Return the number of ``frames`` and ``bytes`` sent so far, and of frames ``lost``."""
        counts: dict[str, int] = self._switch.ask_now("counts", patience=PATIENCE)
        return counts


class Switch:
    """Forwards frames among the network devices of hosts, in a thread.

    A frame for a known address goes to its host, any other one to all hosts but its own.
    """

    def __init__(self, devices: list[int]) -> None:
        self._devices = devices
        self._random = random.Random()
        self._loss = self._delay = 0.0
        self._host_of: dict[bytes, int] = {}
        self._under_way: deque[tuple[float, int, bytes]] = deque()
        self._counts = {"frames": 0, "bytes": 0, "lost": 0}
        threading.Thread(target=self._run, daemon=True).start()

    def set(
        self, loss: float | None = None, delay: float | None = None, seed: int | None = None
    ) -> None:
        self._loss = self._loss if loss is None else loss
        self._delay = self._delay if delay is None else delay
        if seed is not None:
            self._random.seed(seed)

    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def _run(self) -> None:
        poll = select.epoll()
        for device in self._devices:
            os.set_blocking(device, False)
            poll.register(device, select.EPOLLIN)
        while True:
            # epoll counts in milliseconds, and rounds up.
            for device, _ in poll.poll(self._left()):
                self._forward(device)
            self._deliver()

    def _left(self) -> float:
        if not self._under_way:
            return -1.0
        return max(0.0, self._under_way[0][0] - time.monotonic())

    def _forward(self, device: int) -> None:
        for frame in _frames(device):
            self._host_of[frame[6:12]] = device
            self._counts["frames"] += 1
            self._counts["bytes"] += len(frame)
            known = self._host_of.get(frame[:6])
            for host in self._devices if known is None else (known,):
                if host != device:
                    self._send(host, frame)

    def _send(self, host: int, frame: bytes) -> None:
        if self._loss and frame[12:14] != ARP and self._random.random() < self._loss:
            self._counts["lost"] += 1
        elif self._delay or self._under_way:
            self._under_way.append((time.monotonic() + self._delay, host, frame))
        else:
            _write(host, frame)

    def _deliver(self) -> None:
        while self._under_way and self._under_way[0][0] <= time.monotonic():
            _, host, frame = self._under_way.popleft()
            _write(host, frame)


def _frames(device: int) -> Iterator[bytes]:
    for _ in range(BATCH):
        try:
            yield os.read(device, FRAME)
        except BlockingIOError:
            return


def _write(device: int, frame: bytes) -> None:
    try:
        os.write(device, frame)
    except OSError:
        # The device is not up yet.
        return


def _open_device(namespace: str) -> int:
    """Make the network device ``eth0`` of a namespace; it ends with the descriptor."""
    with open(f"/run/netns/{namespace}", "rb") as entered:
        if ctypes.CDLL(None, use_errno=True).setns(entered.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), f"cannot enter {namespace}")
    device = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", b"eth0", IFF_TAP | IFF_NO_PI))
    return device


if __name__ == "__main__":
    serve_commands(Switch([_open_device(namespace) for namespace in sys.argv[1:]]))
