"""benchmarks.network: which cells there are, and what is made of their figures."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from benchmarks.network import Cell, NetworkResults, chosen, every, write_network

FIGURES = {"answered": 400.0, "failed": 3.0}
PLAIN = Cell("direct", 3.0, "both", 10, 0.02, 0.0)


def test_the_chosen_cells_are_some_of_all() -> None:
    cells = every()
    assert len(set(cells)) == len(cells) == 960
    assert set(chosen()) < set(cells)
    assert PLAIN in chosen()


def test_results_continue_an_interrupted_run(tmp_path: Path) -> None:
    first = NetworkResults(tmp_path / "network.json")
    first.add(PLAIN, FIGURES)
    second = NetworkResults(first.path)
    assert second.of(PLAIN) == FIGURES
    assert second.machine == first.machine
    assert second.of(dataclasses.replace(PLAIN, flood=True)) is None


def test_the_page_gets_a_table_and_a_plot(tmp_path: Path) -> None:
    results = NetworkResults(tmp_path / "network.json")
    results.add(PLAIN, FIGURES)
    results.add(dataclasses.replace(PLAIN, contestant="call"), {})
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- network -->\nold\n<!-- /network -->\nafter\n")
    write_network(results, page, tmp_path)
    text = page.read_text()
    assert text.startswith("before\n<!-- network -->\n| heartbeat |")
    assert text.endswith("<!-- /network -->\nafter\n")
    assert "old" not in text
    assert "| 3000 ms |  | 10 | 0 ms |  |  |  | ended | 100/s, 3 failed |" in text
    assert (tmp_path / "network.svg").exists()
