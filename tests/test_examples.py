"""The examples of behaviour trees, run unchanged against their robot."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.servers import running

ROBOT = Path(__file__).parent.parent / "docs" / "examples" / "robot"

TREES = (
    "coroutine_ticks",
    "polled_tasks",
    "proxies",
    "py_trees_in_loop",
    "py_trees_in_thread",
)
PARTS = ("mission", "nodes", "robot")

FIRST = [
    "the arm is enabled",
    "the arm is home",
    "the door is locked",
    "somebody opened the door",
]
AT_ONCE = ["the camera runs", "the gripper is open", "the lamp is on"]
LAST = ["the map is saved", "success"]


@pytest.fixture(scope="module")
def robot() -> Iterator[None]:
    with running(ROBOT / "robot.py"):
        yield


@pytest.mark.usefixtures("robot")
@pytest.mark.parametrize("tree", TREES)
def test_tree(tree: str) -> None:
    command = (sys.executable, "-W", "error::ResourceWarning", str(ROBOT / f"{tree}.py"))
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=120, check=True)
    lines = run.stdout.splitlines()
    first, at_once, last = lines[:4], lines[4:7], lines[7:]
    assert (first, sorted(at_once), last) == (FIRST, AT_ONCE, LAST)


def test_every_example_is_run() -> None:
    assert {path.stem for path in ROBOT.glob("*.py")} == {*TREES, *PARTS}


def test_the_robot_has_a_dozen_services() -> None:
    names = [line for line in (ROBOT / "robot.py").read_text().splitlines() if '": (' in line]
    assert len(names) == 12
