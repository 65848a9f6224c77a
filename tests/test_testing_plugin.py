"""The pytest plugin, as a user's project has it, and the examples of its page."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.process import ROOT
from tests.support.project import PLUGIN, python_path

STRICT = """
import pytest
from std_srvs.srv import SetBool
from rosasync import ServiceUnavailable

async def test_uncalled(ros_graph):
    ros_graph.stub(SetBool, "/arm", {})

async def test_unserved(ros_graph):
    async with ros_graph.session() as session:
        with pytest.raises(ServiceUnavailable):
            await session.call(SetBool, "/arm", wait=False)

@pytest.mark.rosasync(strict=False)
async def test_lenient(ros_graph):
    ros_graph.stub(SetBool, "/arm", {})
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "pytest.ini").write_text("[pytest]\nasyncio_mode = auto\naddopts = -ra\n")
    return tmp_path


def run(project: Path, *arguments: str) -> str:
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
        cwd=project,
        env=os.environ | {"PYTHONPATH": python_path(project / "site")},
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    ).stdout


@pytest.mark.parametrize("kind", ["memory", "real"])
def test_the_examples_of_the_page(project: Path, kind: str) -> None:
    page = (ROOT / "docs" / "how-to" / "testing.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (project / "test_page.py").write_text("\n".join(blocks))
    assert re.search(r"= 6 passed", output := run(project, f"--rosasync-graph={kind}")), output


def test_strictness(project: Path) -> None:
    (project / "test_strict.py").write_text(STRICT)
    output = run(project)
    assert "3 passed, 2 errors" in output
    assert "/arm was never called" in output
    assert "/arm (std_srvs/srv/SetBool) was called, and has no server" in output


def test_a_project_that_does_not_use_it_imports_no_rclpy(project: Path) -> None:
    (project / "test_other.py").write_text(
        "import sys\ndef test_it():\n"
        f"    assert {PLUGIN!r} in sys.modules\n"
        "    assert not [m for m in sys.modules if m.split('.')[0] == 'rclpy']\n"
    )
    assert "1 passed" in run(project)
