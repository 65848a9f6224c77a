"""A process that sends one request to a server that does not read it.

It is a ``session``, a ``late session`` after a stock node, or ``stock``.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import Empty

import rosasync
from tests.support.times import LIMIT

NAME = "/unanswered"


def wait_for_word() -> None:
    print("ready", flush=True)
    sys.stdin.readline()


def serve() -> None:
    rclpy.init()
    node = rclpy.create_node("server")
    node.create_service(Empty, NAME, lambda _request, response: response)
    print("ready", flush=True)
    with contextlib.suppress(ExternalShutdownException, KeyboardInterrupt):
        rclpy.spin(node)


def call_stock() -> None:
    rclpy.init()
    node = rclpy.create_node("client")
    client = node.create_client(Empty, NAME)
    assert client.wait_for_service(LIMIT)
    wait_for_word()
    client.call_async(Empty.Request())
    sys.stdin.readline()
    node.destroy_node()
    rclpy.shutdown()


def make_node() -> None:
    # No test is in this domain.
    rclpy.init(domain_id=0)
    rclpy.create_node("before").destroy_node()
    rclpy.shutdown()


async def call_session() -> None:
    async with rosasync.Session("first"):
        pass
    # The second session of the process.
    async with rosasync.Session("second") as session:
        assert not any("PROFILES_FILE" in name for name in os.environ if name not in GIVEN)
        await session.wait_for_service(Empty, NAME, timeout=LIMIT)
        await session.pool.warm(Empty, NAME)
        wait_for_word()
        task = session.start(Empty, NAME, timeout=None)
        await asyncio.to_thread(sys.stdin.readline)
        task.cancel()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    GIVEN = set(os.environ)
    if sys.argv[1].startswith("late"):
        make_node()
    if sys.argv[1].endswith("session"):
        asyncio.run(call_session())
    elif sys.argv[1] == "stock":
        call_stock()
    else:
        serve()
