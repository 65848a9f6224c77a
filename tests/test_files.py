"""The files of the repository: what must not be in any of them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from tests.support.process import ROOT

CONFLICT = re.compile(rb"^(<{7}|\|{7}|>{7}) ", re.MULTILINE)
"""The lines that git leaves around a conflict, but ``=======``, which may underline a heading."""

NOT_OURS = {".git", ".venv", "build", "dist", "site"}


def files(folder: Path) -> Iterator[Path]:
    """Return the files of the repository, without what git or a tool has put there."""
    for root, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name not in NOT_OURS and "cache" not in name]
        yield from (Path(root, name) for name in names)


def with_conflicts(folder: Path) -> list[Path]:
    """Return the files that have markers of a conflict."""
    return [path for path in files(folder) if CONFLICT.search(path.read_bytes())]


def test_no_file_has_the_markers_of_a_conflict() -> None:
    assert with_conflicts(ROOT) == []


def test_the_markers_of_a_conflict_are_found(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(f"one\n{'<' * 7} HEAD\ntwo\n{'=' * 7}\n{'>' * 7} other\n")
    (tmp_path / "plain.md").write_text(f"Title\n{'=' * 7}\n\n> quoted\n")
    assert with_conflicts(tmp_path) == [tmp_path / "page.md"]
