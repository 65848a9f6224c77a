"""A process that was forked from one that has used ROS gets an error at once."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.support.process import ROOT, own
from tests.support.times import LIMIT

PROGRAM = """
import asyncio, os, sys, threading
import rosasync

async def main():
    parent = "session" in sys.argv and rosasync.Session("parent")
    if parent:
        await parent.open()
        if "closed" in sys.argv:
            await parent.aclose()
    if "stock" in sys.argv:
        import rclpy
        rclpy.init()
        stock = rclpy.create_node("parent")
    child = os.fork()
    if not child:
        # asyncio knows by thread that a loop runs.
        thread = threading.Thread(target=lambda: asyncio.run(in_child(parent)))
        thread.start()
        thread.join()
        os._exit(0)
    os.waitpid(child, 0)
    if parent:
        await parent.aclose()
    if "stock" in sys.argv:
        rclpy.shutdown()

async def in_child(parent):
    try:
        if "portal" in sys.argv:
            await asyncio.to_thread(parent.from_thread.call, "std_srvs/srv/Empty", "/x")
        async with rosasync.Session("child"):
            print("opened", flush=True)
    except rosasync.UsageError as error:
        print(error, flush=True)

asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("session", "'spawn'"),
        ("session closed", "'spawn'"),
        ("session portal", "'spawn'"),
        ("stock", "'spawn'"),
        ("", "opened"),
    ],
)
def test_forked(arguments: str, expected: str) -> None:
    done = subprocess.run(
        (sys.executable, "-c", PROGRAM, *arguments.split()),
        capture_output=True,
        text=True,
        check=True,
        timeout=2 * LIMIT,
        cwd=ROOT,
    )
    assert expected in own(done.stdout)
