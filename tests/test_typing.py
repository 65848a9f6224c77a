"""What mypy and pyright infer of a user's program, and which mistakes they flag."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeAlias

import pytest

FOLDER = Path(__file__).parent / "typing"
SOURCES = ("mistakes.py", "program.py")

Flagged: TypeAlias = dict[str, set[int]]
"""The numbers of the lines with errors, for each file that has any."""

MARK = re.compile(r"# E(?: \((?P<checker>\w+)\))?: ")
"""``# E: reason`` for every checker, ``# E (pyright): reason`` for that one alone."""


def mypy() -> Flagged:
    """Run mypy, in strict mode."""
    options = ("--config-file", "mypy.ini", "--cache-dir", "/dev/null", "--no-error-summary")
    output = run("mypy", *options, *SOURCES)
    return flagged(re.findall(r"^(\S+?):(\d+): error:", output, re.MULTILINE))


def pyright() -> Flagged:
    """Run basedpyright with the rules of pyright's default, as Pylance does."""
    output = run(
        "basedpyright", "--project", FOLDER, "--pythonpath", sys.executable, "--outputjson"
    )
    report = json.loads(output)
    assert report["summary"]["filesAnalyzed"] == len(SOURCES), report["summary"]
    return flagged(
        (diagnostic["file"], diagnostic["range"]["start"]["line"] + 1)
        for diagnostic in report["generalDiagnostics"]
        if diagnostic["severity"] == "error"
    )


CHECKERS = (mypy, pyright)


def run(module: str, *arguments: str | Path) -> str:
    command = (sys.executable, "-m", module, *arguments)
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)
    # 1: there are errors. Anything above is a checker that could not do its work.
    assert done.returncode in (0, 1), done.stdout + done.stderr
    return done.stdout


def flagged(errors: Iterable[tuple[str, str | int]]) -> Flagged:
    lines: defaultdict[str, set[int]] = defaultdict(set)
    for file, line in errors:
        lines[Path(file).name].add(int(line))
    return dict(lines)


def marked(checker: str) -> set[int]:
    """Return the numbers of the lines that a checker has to flag."""
    found = set()
    for number, line in enumerate((FOLDER / "mistakes.py").read_text().splitlines(), start=1):
        if (mark := MARK.search(line)) and mark["checker"] in (None, checker):
            found.add(number)
    return found


@pytest.mark.parametrize("checker", CHECKERS)
def test_every_mistake_is_flagged_and_nothing_else(checker: Callable[[], Flagged]) -> None:
    """What ``program.py`` says of a type with ``assert_type`` is what the checker infers."""
    assert checker() == {"mistakes.py": marked(checker.__name__)}
