"""The cost of the topics of status: a pair for each process, or for each of its services.

``python -m benchmarks.topics`` prints it for 1 and 500 pairs, twice. It runs two processes of
itself: one with the endpoints of a server, one with those of a client.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from rosasync._ros.domain import isolate
from tests.support.child import Child, serve_commands

__all__ = ["measure"]

ROLES = ("server", "client")

kept: list[Any] = []
"""The endpoints of this process, which the other one may still be looking for."""


def measure(pairs: int) -> list[dict[str, float]]:
    """Return what that many pairs cost the server's process, and the client's.

    Returns:
        For each process: its endpoints, the seconds of CPU until all are matched, and the MB that
        its memory has grown to.
    """
    with ExitStack() as stack, ThreadPoolExecutor(len(ROLES)) as pool:
        children = [
            stack.enter_context(Child("benchmarks.topics", role, quiet=True)) for role in ROLES
        ]
        return list(pool.map(lambda child: child.ask_now("match", pairs=pairs), children))


def match(role: str, pairs: int) -> dict[str, float]:
    """Create the endpoints of one side, and wait until all are matched."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticStatus
    from service_msgs.msg import ServiceEventInfo

    rclpy.init()
    node = rclpy.create_node(f"topics_{role}")
    began = time.process_time()
    publishers: list[Any] = []
    subscriptions: list[Any] = []
    for number in range(pairs):
        topics = [(DiagnosticStatus, "reports"), (ServiceEventInfo, "departures")]
        for publishes, (kind, name) in zip(
            (role == "server", role == "client"), topics, strict=True
        ):
            topic = f"/_topics/p{number}/{name}"
            if publishes:
                publishers.append(node.create_publisher(kind, topic, 100))
            else:
                subscriptions.append(
                    node.create_subscription(kind, topic, lambda message: None, 100)
                )
    kept.append((node, publishers, subscriptions))
    counts = [each.get_subscription_count for each in publishers]
    counts += [lambda each=each: node.count_publishers(each.topic_name) for each in subscriptions]
    for count in counts:
        while not count():
            time.sleep(0.01)
    return {
        "endpoints": len(counts),
        "cpu": time.process_time() - began,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _main(arguments: Sequence[str]) -> None:
    if arguments:
        serve_commands({"match": lambda pairs: match(arguments[0], pairs)})
        return
    isolate()
    for pairs in (1, 500, 1, 500):
        for role, found in zip(ROLES, measure(pairs), strict=True):
            print(pairs, role, {name: round(value, 3) for name, value in found.items()})


if __name__ == "__main__":
    _main(sys.argv[1:])
