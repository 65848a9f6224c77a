"""The example applications as they are run: as processes, beside stock nodes.

Their own tests and the commands of their pages are run by `test_docs.py`.
"""

from __future__ import annotations

import asyncio
import os
import re
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import httpx
import pexpect
import pytest
from std_srvs.srv import SetBool

from rosasync import ServerGone, Session
from tests.support.process import ROOT
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, until

EXAMPLES = ROOT / "docs" / "examples"
LAMP = "/lamp/switch"
GRIPPER = "/gripper/close"

pytestmark = pytest.mark.usefixtures("own_domain")


@pytest.fixture
def stock() -> Iterator[ServerProcess]:
    """A process of stock servers, in the domain of this module."""
    with ServerProcess("stock") as server:
        yield server


@asynccontextmanager
async def started(folder: str, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run an example until SIGTERM, which it should survive without a warning."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-W", "error::ResourceWarning", *arguments),
        cwd=EXAMPLES / folder,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    try:
        yield process
        process.terminate()
        output, _ = await process.communicate()
        assert b"Traceback" not in output, output.decode()
        assert b"Warning" not in output, output.decode()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def line_with(process: asyncio.subprocess.Process, text: bytes) -> None:
    assert process.stdout is not None
    async with asyncio.timeout(4 * LIMIT):
        while text not in (line := await process.stdout.readline()):
            assert line, f"it ended without {text!r}"


async def test_300_http_requests_at_once_reach_a_stock_server(
    stock: ServerProcess, tmp_path: Path
) -> None:
    await stock.serve(LAMP, "std_srvs/srv/SetBool")
    command = "uvicorn --factory app:create_app"
    assert f"\n{command}\n" in (EXAMPLES / "web" / "README.md").read_text()
    socket = str(tmp_path / "socket")
    async with started("web", "-m", *command.split(), "--uds", socket) as process:
        await line_with(process, b"running on")
        limits = httpx.Limits(max_connections=300)
        transport = httpx.AsyncHTTPTransport(uds=socket, limits=limits)
        async with httpx.AsyncClient(
            transport=transport, base_url="http://robot", timeout=4 * LIMIT
        ) as browser:
            first = await browser.post("/lamp/true")
            assert first.json() == {"lamp": "True"}, first.text
            states = [number % 2 == 0 for number in range(300)]
            answers = await asyncio.gather(*(browser.post(f"/lamp/{on}") for on in states))
            assert [answer.json() for answer in answers] == [{"lamp": str(on)} for on in states]
            assert (await browser.get("/health")).json() == {
                "lamp": True,
                "calls": {"waiting": 0, "completed": 301},
            }
    received = await stock.received(LAMP)
    assert sorted(received[1:]) == sorted(map(str, states))
    assert process.returncode in (0, -signal.SIGTERM)


async def test_the_gripper_ends_cleanly_while_a_motion_is_under_way() -> None:
    async with Session("operator", timeout=2 * LIMIT) as session:
        async with started("gripper", "server.py") as process:
            await line_with(process, b"ready")
            first = await session.call(SetBool, GRIPPER, {"data": True})
            assert first.message == "done"
            pending = session.start(SetBool, GRIPPER, {"data": False})
            await until(lambda: session.pool.statistics().in_flight == 1)
        assert process.returncode == 0
        outcomes = await asyncio.gather(pending, return_exceptions=True)
        assert isinstance(outcomes[0], ServerGone | SetBool.Response)


def test_the_dashboard_of_a_stock_node(stock: ServerProcess) -> None:
    stock.serve_now("/lamp/switch", "std_srvs/srv/SetBool")
    stock.serve_now("/lamp/blink", "std_srvs/srv/Trigger")
    dashboard = pexpect.spawn(
        sys.executable,
        ["dashboard.py", "/stock"],
        cwd=str(EXAMPLES / "dashboard"),
        env=os.environ | {"TERM": "xterm-256color"},
        dimensions=(24, 120),
        timeout=4 * LIMIT,
    )
    try:
        dashboard.expect_exact("/lamp/switch")
        dashboard.send("\x1b[B")  # Down
        answers = [b"'success': True, 'message': 'False'", b"(Timeout|Unavailable): "]
        dashboard.send("\r")
        # Its calls have two seconds, which may be too short for the first on a busy machine.
        while dashboard.expect([*map(re.compile, answers)]):
            dashboard.send("\r")
        dashboard.send("q")
        dashboard.expect(pexpect.EOF)
        dashboard.wait()
        assert dashboard.exitstatus == 0
    finally:
        dashboard.close(force=True)
