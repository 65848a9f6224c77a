"""The programs of the documentation, run unchanged against its lamp."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.servers import running

EXAMPLES = Path(__file__).parent.parent / "docs" / "examples"

PRINTS = {
    "at_once": "on: 50 off: 50\n",
    "borrowed_node": "the lamp is on\nthe executor's task returned /mine\n",
    "by_name": "the lamp is off\n",
    "exclusive": "the lamp is on\nthe lamp is off\n1 client, 2 calls\n",
    "first_call": "the lamp is on\n",
    "serve": "the lamp is off\n",
}


@pytest.fixture(scope="module")
def lamp() -> Iterator[None]:
    with running(EXAMPLES / "lamp.py"):
        yield


def output_of(example: str) -> str:
    command = (sys.executable, str(EXAMPLES / f"{example}.py"))
    return subprocess.run(
        command, stdout=subprocess.PIPE, text=True, timeout=120, check=True
    ).stdout


@pytest.mark.usefixtures("lamp")
@pytest.mark.parametrize("example", PRINTS)
def test_example(example: str) -> None:
    assert output_of(example) == PRINTS[example]


@pytest.mark.usefixtures("lamp")
def test_errors_example() -> None:
    wrong_type, no_server = output_of("errors").splitlines()
    assert "std_srvs/srv/SetBool" in wrong_type
    assert no_server.startswith("ServiceUnavailable /lamp/dim")


def test_the_readme_shows_the_first_example() -> None:
    readme = (EXAMPLES.parent.parent / "README.md").read_text()
    assert f"```python\n{(EXAMPLES / 'first_call.py').read_text()}```" in readme


def test_every_example_is_run() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*PRINTS, "errors", "lamp"}
