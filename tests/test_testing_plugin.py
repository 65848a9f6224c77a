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

async def test_failed(ros_graph):
    ros_graph.stub(SetBool, "/arm", {})
    assert False, "what is wrong"

@pytest.mark.rosasync(strict=False)
async def test_lenient(ros_graph):
    ros_graph.stub(SetBool, "/arm", {})
"""


LOOP_SCOPES = """
import asyncio
import pytest
from std_srvs.srv import SetBool

loops = set()

async def enable(graph):
    loops.add(asyncio.get_running_loop())
    graph.stub(SetBool, "/arm", {"success": True})
    async with graph.session() as session:
        assert (await session.call(SetBool, "/arm")).success

@pytest.mark.asyncio(loop_scope=SCOPE)
class TestLoops:
    async def test_one(self, ros_graph):
        await enable(ros_graph)

    @pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True)
    async def test_two(self, ros_graph):
        await enable(ros_graph)

    async def test_one_loop(self):
        assert len(loops) == LOOPS

async def test_the_default(ros_graph):
    await enable(ros_graph)
"""

MISSING = """
from std_srvs.srv import SetBool

async def test_missing(ros_graph):
    async with ros_graph.session() as session:
        await session.call(SetBool, "/arm", wait=False)
"""

PLAIN = """
import pytest
from std_srvs.srv import SetBool

@pytest.fixture
def arm(ros_graph):
    return ros_graph.stub(SetBool, "/arm", {})

async def test_arm(arm):
    pass
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
    (configuration,) = re.findall(r"^```ini\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    (project / "pytest.ini").write_text(configuration)
    output = run(project, f"--rosasync-graph={kind}", "-W", "error::pytest.PytestWarning")
    assert "8 passed" in output, output


def test_strictness(project: Path) -> None:
    (project / "test_strict.py").write_text(STRICT)
    output = run(project)
    assert "1 failed, 3 passed, 2 errors" in output
    assert "/arm was never called" in output
    assert "/arm (std_srvs/srv/SetBool) was called, and has no server" in output


@pytest.mark.parametrize("scope", ["function", "class", "session"])
def test_the_graph_is_in_the_loop_of_the_test(project: Path, scope: str) -> None:
    loops = 3 if scope == "function" else 1
    code = LOOP_SCOPES.replace("SCOPE", repr(scope)).replace("== LOOPS", f"== {loops}")
    (project / "test_loops.py").write_text(code)
    assert "5 passed" in (output := run(project)), output


def test_the_graph_is_in_the_loop_that_the_configuration_says(project: Path) -> None:
    code = LOOP_SCOPES.replace("@pytest.mark.asyncio(loop_scope=SCOPE)", "").replace("LOOPS", "1")
    (project / "test_loops.py").write_text(code)
    output = run(project, "-o", "asyncio_default_test_loop_scope=module")
    assert "5 passed" in output, output


@pytest.mark.parametrize("option", ["--tb=auto", "--full-trace"])
def test_a_traceback_ends_in_the_test_if_rosasync_is_installed(project: Path, option: str) -> None:
    (project / "test_arm.py").write_text(MISSING)
    (project / "conftest.py").write_text(
        "from rosasync.testing import plugin\nplugin.INSTALLED = True\n"
    )
    output = run(project, option)
    assert 'await session.call(SetBool, "/arm", wait=False)' in output
    assert "ServiceUnavailable: /arm: no server" in output
    assert ("rosasync/_client" in output) is (option == "--full-trace")


def test_a_plain_fixture_is_told_to_be_async(project: Path) -> None:
    (project / "test_plain.py").write_text(PLAIN)
    output = run(project)
    assert "UsageError: /arm cannot be served by arm" in output, output
    assert "make it async (async def arm)" in output


def test_a_session_of_another_loop_is_told_apart_by_its_scope(project: Path) -> None:
    (project / "test_other.py").write_text(
        "import pytest\nfrom rosasync.testing import Graph\n"
        "@pytest.fixture\nasync def session():\n"
        "    async with Graph() as graph, graph.session() as session:\n        yield session\n"
        "@pytest.mark.asyncio(loop_scope='session')\nasync def test_it(session):\n"
        "    await session.call('std_srvs/srv/Empty', '/x')\n"
    )
    assert "loop_scope of the test" in (output := run(project)), output


def test_a_project_that_does_not_use_it_imports_no_rclpy(project: Path) -> None:
    (project / "test_other.py").write_text(
        "import sys\ndef test_it():\n"
        f"    assert {PLUGIN!r} in sys.modules\n"
        "    assert not [m for m in sys.modules if m.split('.')[0] == 'rclpy']\n"
    )
    assert "1 passed" in run(project)
