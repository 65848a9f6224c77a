"""Programs in processes of their own, which end in whatever way a test is about."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Sequence

import pytest

from tests.support.process import ROOT, own
from tests.support.times import LIMIT, TICK

__all__ = ["as_root", "run_program"]

as_root = pytest.mark.skipif(
    os.geteuid() != 0, reason="needs root, to mount a small /dev/shm or to give up its privileges"
)

BEGINNING = """
import asyncio, sys, warnings
from rosasync import Session
from tests.support.checks import check_call

async def opened(bridge):
    session = Session("left_open", bridge=bridge, timeout=30.0)
    await session.__aenter__()
    await check_call(session, "/echo", "text")
    print("called", flush=True)
    return session

bridge = sys.argv[1]
"""


async def run_program(
    bridge: str, program: str, *send: int, prefix: Sequence[str] = ()
) -> tuple[int, str]:
    """Run a program to its end; return its exit code and its stderr.

    Args:
        bridge: the bridge for its sessions.
        program: the program. It prints ``called`` when it has made its first call.
        send: signals to send it then, a tick apart. Of several, the last is sent again to a
            program that goes on: a second Ctrl-C may hit asyncio between taking a callback from
            its queue and running it, and then `asyncio.run` waits for a task that nobody wakes.
        prefix: the beginning of its command line.
    """
    process = await asyncio.create_subprocess_exec(
        *(*prefix, sys.executable, "-W", "default::ResourceWarning"),
        *("-c", BEGINNING + program, bridge),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(4 * LIMIT):
            # The middleware logs its errors there too.
            while (line := await process.stdout.readline()) != b"called\n":
                assert line, "it ended before its first call"
            for number in send:
                process.send_signal(number)
                await asyncio.sleep(TICK)
            ending = asyncio.ensure_future(process.communicate())
            while not (await asyncio.wait([ending], timeout=LIMIT))[0]:
                if len(send) > 1:
                    process.send_signal(send[-1])
            _, errors = await ending
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    assert process.returncode is not None
    text = own(errors.decode())
    assert "terminate called" not in text
    return process.returncode, text
