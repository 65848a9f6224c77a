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


ENDING = """
import asyncio, multiprocessing, os, sys, threading
import rosasync

EMPTY = "std_srvs/srv/Empty"
opened, ended = threading.Event(), asyncio.Event()

async def main():
    global session, loop
    loop = asyncio.get_running_loop()
    async with rosasync.Session("parent") as session:
        session.serve(EMPTY, "/own", lambda request, response: response)
        await session.call(EMPTY, "/own")
        opened.set()
        await ended.wait()

def child():
    if "closes" in sys.argv:
        asyncio.run(session.aclose())
    if "raises" in sys.argv:
        raise ValueError
    sys.exit(0 if "returns" in sys.argv else 3)

thread = threading.Thread(target=lambda: asyncio.run(main()))
thread.start()
opened.wait()
if "multiprocessing" in sys.argv:
    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join()
    code = process.exitcode
else:
    pid = os.fork()
    if not pid:
        child()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
session.from_thread.call(EMPTY, "/own")
loop.call_soon_threadsafe(ended.set)
thread.join()
print("code", code, flush=True)
"""


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ("exits", 3),
        ("returns", 0),
        ("raises", 1),
        ("closes", 3),
        ("multiprocessing exits", 3),
        ("multiprocessing returns", 0),
    ],
)
def test_the_end_of_a_child(arguments: str, code: int) -> None:
    """It has its exit code and no warning, and the session of the parent goes on."""
    done = subprocess.run(
        (sys.executable, "-W", "default::ResourceWarning", "-c", ENDING, *arguments.split()),
        capture_output=True,
        text=True,
        check=True,
        timeout=2 * LIMIT,
        cwd=ROOT,
    )
    assert own(done.stdout) == f"code {code}\n"
    assert "ResourceWarning" not in done.stderr
