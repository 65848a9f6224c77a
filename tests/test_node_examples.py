"""The examples of parameters and lifecycles, run unchanged against their nodes."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest
from rcl_interfaces.srv import GetParameters

from rosasync import Session
from tests.support.process import own
from tests.support.servers import running
from tests.support.times import LIMIT

DOCS = Path(__file__).parent.parent / "docs"
EXAMPLES = DOCS / "examples" / "nodes"

PRINTS = {
    "parameters": (
        "arm",
        """\
0.5
{'home': [0.0, 0.0, 0.5], 'serial': 'A1'}
serial was refused: Trying to set a read-only parameter: serial.
DOUBLE m/s ParameterRange(minimum=0.0, maximum=1.0, step=0.0)
""",
    ),
    "lifecycle": (
        "camera",
        """\
unconfigured ['configure', 'shutdown']
still unconfigured
configured? unknown
inactive
active
finalized
""",
    ),
}


async def started(node: str) -> None:
    """Wait until a node has its services."""
    async with Session("waiting") as session:
        name = f"/{node}/get_parameters"
        await session.wait_for_service(GetParameters, name, timeout=4 * LIMIT)


@pytest.mark.slow
@pytest.mark.parametrize("example", PRINTS)
def test_example(example: str) -> None:
    node, printed = PRINTS[example]
    command = (sys.executable, str(EXAMPLES / f"{example}.py"))
    with running(EXAMPLES / f"{node}.py"):
        # The example waits ten seconds for it, and a busy machine takes longer to start it.
        asyncio.run(started(node))
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=120, check=True)
    assert own(done.stdout) == printed


@pytest.mark.parametrize("example", PRINTS)
def test_the_page_shows_the_programs_and_what_they_print(example: str) -> None:
    node, printed = PRINTS[example]
    page = (DOCS / "how-to" / f"{example}.md").read_text()
    for program in (node, example):
        assert f"```python\n{(EXAMPLES / f'{program}.py').read_text()}```" in page
    assert f"```text\n{printed}```" in page


def test_every_example_is_run() -> None:
    nodes = {node for node, _ in PRINTS.values()}
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*PRINTS, *nodes}
