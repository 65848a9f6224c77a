"""One row of figures for each fault, and the table at the end of the run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import pytest

from tests.support.times import LIMIT

__all__ = ["MARGIN", "PROPERTY", "Row", "pytest_terminal_summary", "render"]

MARGIN = LIMIT / 4
"""Seconds by which a call may overrun its deadline. The table shows how much of it was used."""

PROPERTY = "fault"
"""The user property of a test's report that carries a row."""


@dataclass
class Row:
    """What became of the calls that were made under one fault.

    Attributes:
        fault: the fault.
        bridge: the bridge that carried the calls, or ``stock`` for rclpy's own client.
        made: calls made.
        answered: calls that returned the response to their own request.
        wrong: calls that returned anything else.
        failed: calls that raised, by the name of the error.
        hung: calls that had not ended long after their deadline.
        late: seconds by which the slowest call overran its deadline.
        leaked: what was left afterwards, by kind.
        notes: further figures, shown below the table.
    """

    fault: str
    bridge: str
    made: int = 0
    answered: int = 0
    wrong: int = 0
    failed: dict[str, int] = field(default_factory=dict)
    hung: int = 0
    late: float = 0.0
    leaked: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        return cls(**json.loads(text))

    def check(self) -> None:
        """Check the figures that every fault must show."""
        ended = self.answered + self.wrong + sum(self.failed.values())
        assert self.made == ended + self.hung, self
        assert (self.wrong, self.hung) == (0, 0), self
        assert not any(self.leaked.values()), self

    @property
    def cells(self) -> list[str]:
        failed = [f"{count:,} {kind}" for kind, count in sorted(self.failed.items())]
        leaked = [f"{count:g} {kind}" for kind, count in self.leaked.items() if count]
        return [
            self.fault,
            self.bridge,
            f"{self.made:,}",
            f"{self.answered:,}",
            f"{self.wrong:,}",
            ", ".join(failed) or "0",
            f"{self.hung:,}",
            f"{self.late:.2f}",
            ", ".join(leaked) or "0",
        ]


HEADINGS = ["fault", "bridge", "calls", "answered", "wrong", "failed", "hung", "late, s", "leaked"]
TEXT = (0, 1, 5, 8)
"""The columns that are not numbers."""


def render(rows: Iterable[Row]) -> Iterator[str]:
    """Yield the lines of a Markdown table, with a total, and then the notes."""
    rows = sorted(rows, key=lambda row: (row.fault, row.bridge))
    lines = [HEADINGS, *(row.cells for row in rows), _total(rows).cells]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADINGS))]
    yield _line(HEADINGS, widths)
    rules = [
        "-" * width if n in TEXT else "-" * (width - 1) + ":" for n, width in enumerate(widths)
    ]
    yield _line(rules, widths)
    for line in lines[1:]:
        yield _line(line, widths)
    for row in rows:
        yield from (f"\n{row.fault}, {row.bridge}: {note}" for note in row.notes)


def _total(rows: Sequence[Row]) -> Row:
    kinds = {kind for row in rows for kind in row.leaked}
    return Row(
        "**all**",
        "",
        sum(row.made for row in rows),
        sum(row.answered for row in rows),
        sum(row.wrong for row in rows),
        {"calls": sum(sum(row.failed.values()) for row in rows)},
        sum(row.hung for row in rows),
        max((row.late for row in rows), default=0.0),
        {kind: sum(row.leaked.get(kind, 0) for row in rows) for kind in sorted(kinds)},
    )


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [
        cell.ljust(width) if number in TEXT else cell.rjust(width)
        for number, (cell, width) in enumerate(zip(cells, widths, strict=True))
    ]
    return "| " + " | ".join(padded) + " |"


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Print the rows of all tests; with several processes, the one that collects the reports."""
    rows = {
        (report.nodeid, value): Row.from_json(str(value))
        for reports in terminalreporter.stats.values()
        for report in reports
        if isinstance(report, pytest.TestReport)
        for name, value in report.user_properties
        if name == PROPERTY
    }
    if rows:
        terminalreporter.section("faults")
        for line in render(rows.values()):
            terminalreporter.write_line(line)
