"""Servers that are visible, and from which no data arrives: every error says why."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

import rosasync
from rosasync._ros.profile import SWITCH
from tests.support.command import json_lines
from tests.support.command import rosasync as command
from tests.support.hosts import own_shared_memory
from tests.support.process import ROOT, ended, first_line
from tests.support.program import as_root
from tests.support.times import LIMIT, TICK

pytestmark = pytest.mark.slow

EMPTY = "std_srvs/srv/Empty"
NAME = "/silent/_hidden/server"
NOBODY = 65534
SERVER = f"""
import os, sys
import rclpy
from std_srvs.srv import Empty
type(Empty).__import_type_support__()
if "other user" in sys.argv:
    # The new user may not read the interpreter's files, so everything is imported before.
    # No test is in this domain.
    rclpy.init(domain_id=0)
    rclpy.create_node("before").create_service(Empty, "/x", None)
    rclpy.shutdown()
    os.setuid({NOBODY})
rclpy.init()
node = rclpy.create_node("silent")
service = node.create_service(Empty, "{NAME}", lambda request, response: response)
print("ready", flush=True)
rclpy.spin(node)
"""


@pytest.fixture(scope="class", params=["no common /dev/shm", "other user"])
def silent(request: pytest.FixtureRequest) -> Iterator[str]:
    """A server that hears nothing, or cannot answer; what the errors say about it."""
    other_user = request.param == "other user"
    prefix = () if other_user else own_shared_memory("64m")
    with (
        subprocess.Popen(
            (*prefix, sys.executable, "-c", SERVER, request.param),
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, "ROS_LOG_DIR": "/tmp", SWITCH: "off"},
        ) as process,
        ended(process),
    ):
        assert process.stdout is not None
        assert first_line(process.stdout) == "ready\n"
        yield "user nobody owns /dev/shm/" if other_user else "--ipc=host"


@as_root
class TestSilentServer:
    async def test_a_call(self, silent: str) -> None:
        async with rosasync.Session("caller") as session:
            await session.wait_for_service(EMPTY, NAME, timeout=LIMIT)
            with pytest.raises(rosasync.ResponseTimeout) as raised:
                await session.call(EMPTY, NAME, timeout=30 * TICK)
        assert "visible, but no data arrives" in str(raised.value)
        assert silent in str(raised.value)

    def test_ping(self, silent: str) -> None:
        done = command("ping", NAME, "--timeout", f"{LIMIT:g}")
        assert done.returncode == 1
        assert silent in done.stderr

    @pytest.mark.parametrize(
        ("arguments", "check"),
        [(("why", NAME, "--wait", f"{LIMIT / 4:g}"), "data"), (("doctor",), "other nodes")],
    )
    def test_checks(self, silent: str, arguments: tuple[str, ...], check: str) -> None:
        done = command(*arguments, "--json")
        assert done.returncode == 1
        found = [line for line in json_lines(done.stdout) if line["ok"] is False]
        assert [line["check"] for line in found] == [check]
        assert silent in found[0]["found"]


async def test_a_server_that_is_only_slow(hidden: str) -> None:
    async with rosasync.Session("caller") as session:
        await session.wait_for_service(EMPTY, hidden, timeout=LIMIT)
        with pytest.raises(rosasync.ResponseTimeout) as raised:
            await session.call(EMPTY, hidden, timeout=TICK)
    assert "no data arrives" not in str(raised.value)


def test_why_finds_hidden_names(hidden: str) -> None:
    # Longer than a process takes to announce itself, on a busy machine, too.
    wait = ("--wait", f"{LIMIT / 4:g}")
    done = command("why", hidden, "--json", *wait)
    checks = {line["check"]: line for line in json_lines(done.stdout)}
    assert checks["name"]["ok"] is True
    done = command("why", "/box/_container/laod_node", "--json", *wait)
    assert done.returncode == 3
    assert f"Did you mean {hidden}" in done.stdout


@pytest.fixture
def hidden() -> Iterator[str]:
    """A hidden service of a server that answers late."""
    name = "/box/_container/load_node"
    program = SERVER.replace(NAME, name).replace(
        "response: response", "response: sleep(5) or response"
    )
    program = "from time import sleep\n" + program
    with (
        subprocess.Popen(
            (sys.executable, "-c", program), stdout=subprocess.PIPE, text=True, cwd=ROOT
        ) as process,
        ended(process),
    ):
        assert process.stdout is not None
        assert first_line(process.stdout) == "ready\n"
        yield name
