"""Hosts on one machine: temporary network namespaces, joined by a virtual cable."""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import ExitStack
from types import TracebackType

__all__ = [
    "ENVIRONMENT",
    "Hosts",
    "NoHosts",
    "bring_up",
    "check_namespaces",
    "own_shared_memory",
    "run_ip",
]

ENVIRONMENT = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
    # The namespaces share memory through one kernel, unlike two machines.
    "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
}


class NoHosts(Exception):
    """Network namespaces cannot be created on this machine; the message says why."""


class Hosts:
    """A host for the server and one for the contestants.

    Raises:
        NoHosts: on entering, if iproute2 is missing or must not be used.
    """

    environment = ENVIRONMENT

    def __init__(self) -> None:
        self._names = [f"rosasync-{os.getpid()}-{side}" for side in ("server", "client")]
        self._stack = ExitStack()

    def __enter__(self) -> Hosts:
        check_namespaces()
        with self._stack:
            for name in self._names:
                run_ip("netns", "add", name)
                self._stack.callback(run_ip, "netns", "delete", name)
            server, client = self._names
            cable = ["type", "veth", "peer", "name", "eth0", "netns", client]
            run_ip("link", "add", "eth0", "netns", server, *cable)
            for number, name in enumerate(self._names, 1):
                bring_up(name, f"10.0.0.{number}")
            self._stack = self._stack.pop_all()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        self._stack.close()

    @property
    def on_server(self) -> list[str]:
        """The prefix of a command that runs on the server's host."""
        return ["ip", "netns", "exec", self._names[0]]

    @property
    def on_client(self) -> list[str]:
        """The prefix of a command that runs on the contestants' host."""
        return ["ip", "netns", "exec", self._names[1]]


def check_namespaces() -> None:
    """Raise NoHosts if network namespaces cannot be made here."""
    if shutil.which("ip") is None:
        raise NoHosts("`ip` is missing: install iproute2")
    if os.geteuid() != 0:
        raise NoHosts("network namespaces need root")


def bring_up(namespace: str, address: str) -> None:
    """Give the device ``eth0`` of a namespace an address, and start it with a multicast route."""
    inside = ["-n", namespace]
    run_ip(*inside, "address", "add", f"{address}/24", "dev", "eth0")
    for device in ("lo", "eth0"):
        run_ip(*inside, "link", "set", device, "up")
    run_ip(*inside, "route", "add", "224.0.0.0/4", "dev", "eth0")


def run_ip(*arguments: str) -> None:
    """Run ``ip``; raise NoHosts if it fails."""
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoHosts(f"`ip {' '.join(arguments)}` failed: {done.stderr.strip()}")


def own_shared_memory(size: str) -> tuple[str, ...]:
    """Return the beginning of a command line: what it starts has a ``/dev/shm`` of its own."""
    mount = f'mount -t tmpfs -o size={size} tmpfs /dev/shm && exec "$@"'
    return ("unshare", "--mount", "sh", "-c", mount, "sh")
