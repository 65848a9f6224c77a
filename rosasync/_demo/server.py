"""The servers of the demo and of ``rosasync doctor``, each in a process of its own."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

__all__ = ["stock_server"]

END_LIMIT = 1.5
"""Seconds for the server to end before it is killed."""


@asynccontextmanager
async def stock_server(*srv_names: str, bare: bool = False) -> AsyncIterator[bool]:
    """Run a stock server in its own process and session, so that Ctrl-C does not reach it.

    Args:
        srv_names: the services to serve.
        bare: answer in a bare loop instead of an executor's callbacks.

    Yields:
        Whether it is ready. If not, its process has ended.
    """
    from rosasync._demo.stock import READY

    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rosasync._demo.stock", *(["--bare"] if bare else []), *srv_names),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        # On Jazzy the middleware logs its errors there too.
        while (line := await process.stdout.readline()) not in (READY, b""):
            pass
        yield line == READY
    finally:
        process.stdin.close()
        try:
            async with asyncio.timeout(END_LIMIT):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()
