"""A link between two hosts that loses and delays packets: ``python -m benchmarks.link``.

The kernel's own tool for that, netem, is missing on many small machines. So the cable is a process
with the ends of two virtual network cards, which passes their packets on.
"""

from __future__ import annotations

import fcntl
import heapq
import itertools
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from benchmarks.hosts import Hosts, NoHosts
from benchmarks.pipes import ROOT

__all__ = ["lossy_hosts", "relay"]

TUNSETIFF = 0x400454CA
IFF_TAP, IFF_NO_PI = 0x0002, 0x1000
"""From ``linux/if_tun.h``."""
FRAME = 65_536
SEED = 1


@contextmanager
def lossy_hosts(loss: float, delay: float) -> Iterator[Hosts]:
    """Yield two hosts whose link loses a share of the packets and delays the others.

    Args:
        loss: from 0 to 1, in each direction.
        delay: seconds, in each direction.

    Raises:
        NoHosts: this machine does not support it.
    """
    with ExitStack() as stack:
        hosts = Hosts(cards=(f"tap{os.getpid()}a", f"tap{os.getpid()}b"))
        process = subprocess.Popen(
            [sys.executable, "-m", __name__, str(loss), str(delay), *hosts.cards],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=ROOT,
        )
        assert process.stdout is not None
        stack.callback(_end, process)
        with process.stdout:
            if not process.stdout.readline():
                raise NoHosts("virtual network cards cannot be created")
        stack.enter_context(hosts)
        # Before the hosts end, because their network cards end with them.
        stack.callback(_end, process)
        yield hosts


def _end(process: subprocess.Popen[bytes]) -> None:
    assert process.stdin is not None
    process.stdin.close()
    process.wait()


def relay(ends: Sequence[int], loss: float, delay: float, until: int) -> None:
    """Pass packets between two descriptors, until a third one has data or ends."""
    lottery = random.Random(SEED)
    order = itertools.count()
    due: list[tuple[float, int, int, bytes]] = []
    while True:
        wait = max(0.0, due[0][0] - time.monotonic()) if due else None
        ready, _, _ = select.select([until, *ends], [], [], wait)
        if until in ready:
            return
        for end in ready:
            frame = os.read(end, FRAME)
            if lottery.random() >= loss:
                other = ends[1 - ends.index(end)]
                heapq.heappush(due, (time.monotonic() + delay, next(order), other, frame))
        while due and due[0][0] <= time.monotonic():
            _, _, other, frame = heapq.heappop(due)
            os.write(other, frame)


def main(loss: float, delay: float, *cards: str) -> None:
    """Join two new network cards until standard input ends."""
    ends = [_card(name) for name in cards]
    print("ready", flush=True)
    relay(ends, loss, delay, until=0)


def _card(name: str) -> int:
    """Create a virtual network card and return the descriptor of its cable's end."""
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TAP | IFF_NO_PI))
    return end


if __name__ == "__main__":
    main(float(sys.argv[1]), float(sys.argv[2]), *sys.argv[3:])
