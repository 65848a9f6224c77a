"""A middleware that is not installed: an ImportError before rclpy is imported."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from rosasync._ros.interfaces import constants, fields, installed_types, parts
from rosasync._ros.middleware import installed_middlewares
from tests.support.command import rosasync
from tests.support.process import ROOT, own

PROGRAM = """
import asyncio, sys
import rosasync
async def main():
    async with rosasync.Session("x"):
        print("open")
try:
    asyncio.run(main())
except ImportError as error:
    print(error)
    assert "rclpy" not in sys.modules
"""


def open_session_with(middleware: str) -> str:
    done = subprocess.run(
        (sys.executable, "-c", PROGRAM),
        env={**os.environ, "RMW_IMPLEMENTATION": middleware},
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
    )
    return own(done.stdout)


def test_a_missing_middleware_is_an_import_error() -> None:
    message = open_session_with("rmw_nowhere_cpp")
    assert "RMW_IMPLEMENTATION=rmw_nowhere_cpp" in message
    assert f"Installed: {', '.join(installed_middlewares())}" in message


def test_an_installed_middleware_is_used() -> None:
    assert "rmw_fastrtps_cpp" in installed_middlewares()
    assert open_session_with("rmw_fastrtps_cpp") == "open\n"


def test_the_command_line_says_so_in_one_line() -> None:
    done = rosasync("nodes", RMW_IMPLEMENTATION="rmw_nowhere_cpp")
    assert (done.returncode, done.stdout) == (1, "")
    assert "rmw_nowhere_cpp" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_show_prints_fields_defaults_constants_and_nested_messages() -> None:
    done = rosasync("show", "nav_msgs/srv/GetPlan")
    assert (done.returncode, done.stderr) == (0, "")
    assert "geometry_msgs/msg/PoseStamped start  # The start pose for the plan" in done.stdout
    assert "      float64 w = 1.0" in done.stdout
    assert "\n---\nnav_msgs/msg/Path plan" in done.stdout
    assert "  OK = 0\n" in rosasync("show", "diagnostic_msgs/srv/SelfTest").stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "says"),
    [
        pytest.param("no_msgs/srv/Type", "apt install ros-<distribution>-no-msgs", id="package"),
        pytest.param("std_srvs/srv/Nothing", "no such type", id="type"),
        pytest.param("std_srvs/msg/SetBool", "has no msg types", id="kind"),
        pytest.param("SetBool", "expected 'package/srv/Type'", id="name"),
    ],
)
def test_show_of_what_is_not_there(name: str, says: str) -> None:
    done = rosasync("show", name)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


def test_every_installed_type_can_be_described() -> None:
    for kind in ("srv", "msg"):
        for name in installed_types(kind):
            for part in parts(name):
                assert all(field.type.label for field in fields(part.message_type))
                assert isinstance(constants(part.message_type), dict)
