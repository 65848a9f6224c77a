"""Processes out of descriptors, threads and shared memory: a clear error, and then it works again.

The middleware is not as careful everywhere. Out of threads in the middle of creating a participant,
Fast DDS ends the process. If shared memory runs out in the middle, what it leaves there may block
the next participant.
"""

from __future__ import annotations

import pytest

from tests.faults.trial import Trial
from tests.support.hosts import own_shared_memory
from tests.support.program import as_root, run_program

# The program waits until it has discovered every process of its domain.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_domain")]

SHARED = """
import contextlib, gc, os, resource, subprocess, tempfile
from importlib.metadata import version
from pathlib import Path
from rosasync import RosasyncError
from rosasync._ros.inspect import all_discovered
from tests.support.checks import count_descriptors
from tests.support.echo import ECHO
from tests.support.serving import FORMS

async def use(text="text"):
    async with Session("short_of", bridge=bridge) as session:
        async with session.serve(ECHO, "/own", FORMS["async, call"]):
            await check_call(session, "/own", text, timeout=20.0)

async def refused():
    try:
        await use()
    except (RosasyncError, OSError) as error:
        assert str(error)
        return True
    return False
"""

DESCRIPTORS = """
async def main():
    await use()
    await use()
    print("called", flush=True)
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    async with Session("open", bridge=bridge) as session:
        async with session.serve(ECHO, "/open", FORMS["async, call"]):
            await check_call(session, "/open", "before")
            # Each process that is discovered takes descriptors.
            while not all_discovered(session.node):
                await asyncio.sleep(0.05)
            before = count_descriptors()
            for spare in (0, 1):
                resource.setrlimit(resource.RLIMIT_NOFILE, (before - 1 + spare, hard))
                assert await refused(), spare
                for number in range(100):
                    await check_call(session, "/open", str(number))
                resource.setrlimit(resource.RLIMIT_NOFILE, (before + 100, hard))
                gc.collect()
                assert count_descriptors() == before, spare
            await use()

asyncio.run(main())
"""

THREADS = """
async def main():
    await use()
    print("called", flush=True)
    with tempfile.TemporaryDirectory() as logs:
        os.environ["ROS_LOG_DIR"] = logs
        os.chown(logs, 61_234, 61_234)
        os.setgroups([])
        os.setgid(61_234)
        os.setuid(61_234)
        resource.setrlimit(resource.RLIMIT_NPROC, (1, 1_000))
        assert await refused()
        resource.setrlimit(resource.RLIMIT_NPROC, (1_000, 1_000))
        await use()

asyncio.run(main())
"""

MEMORY = """
async def main():
    assert os.statvfs("/dev/shm").f_blocks * os.statvfs("/dev/shm").f_frsize < 2**21
    # Without shared memory the middleware uses UDP, here for all of a call's packets.
    await use("x" * 2_000_000)
    print("called", flush=True)
    subprocess.run(["mount", "-o", "remount,size=64m", "/dev/shm"], check=True)
    await use("x" * 2_000_000)

asyncio.run(main())
"""

UNFINISHED = """
async def main():
    prefix = "fastrtps" if version("rclpy").startswith("7.") else "fastdds"
    left = Path(f"/dev/shm/{prefix}_port7000")
    for content in (b"", bytes(50_000), b"\\1" + bytes(50_000)):
        left.write_bytes(content)
        try:
            await use()
        except RosasyncError as error:
            assert str(left) in str(error), error
        else:
            raise AssertionError(content[:2])
    left.unlink()
    await use()
    print("called", flush=True)

asyncio.run(main())
"""


async def test_no_descriptors(trial: Trial) -> None:
    await _run(trial, DESCRIPTORS)


@as_root
async def test_no_threads(trial: Trial) -> None:
    await _run(trial, THREADS)


@as_root
async def test_no_shared_memory(trial: Trial) -> None:
    await _run(trial, MEMORY, *own_shared_memory("16k"))


@as_root
async def test_shared_memory_that_a_dead_process_left_unfinished(trial: Trial) -> None:
    """Fast DDS waits for it for ever (Fast-DDS issue 3878)."""
    await _run(trial, UNFINISHED, *own_shared_memory("64m"))


async def _run(trial: Trial, program: str, *prefix: str) -> None:
    """Run a program; each counts as one answered call."""
    trial.row.made += 1
    code, errors = await run_program(trial.bridge, SHARED + program, prefix=prefix)
    assert code == 0, errors[-2_000:]
    trial.row.answered += 1
