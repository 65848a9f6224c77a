"""Each test that ``docs/explanation/seeds.md`` names exists."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).parent
SEEDS = TESTS.parent / "docs" / "explanation" / "seeds.md"


def test_every_test_it_names_exists() -> None:
    files = {path.stem: path.read_text() for path in TESTS.glob("test_*.py")}
    everything = "\n".join(files.values())
    named = re.findall(r"`(test_\w+)(?:::(\w+))?`", SEEDS.read_text())
    assert len(named) > 80
    for name, inside in named:
        text = files.get(name) if inside else everything
        wanted = inside or name
        assert text is not None, name
        if inside or name not in files:
            assert re.search(rf"(def|class) {wanted}\b", text), f"{name}::{inside}"
