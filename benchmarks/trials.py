"""What every command has measured, with the goals it is compared with, and the format of files."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.machine import describe_machine

__all__ = ["GOALS", "SUITES", "Goal", "Trials", "check"]

FORMAT = 1
SUITES = "suites"
"""The command of all suites in a file: `report` merges them."""
GOALS = ["goal", "outcome"]
"""The heading of a table of goals."""


@dataclass(frozen=True)
class Goal:
    """A figure and its bound.

    Attributes:
        value: None was not measured.
        note: what is said behind the figure, or why it was not measured.
    """

    of: str
    value: float | None
    sense: str
    bound: float
    note: str = ""

    @property
    def name(self) -> str:
        return f"{self.of} {self.sense} {self.bound:g}"

    @property
    def met(self) -> bool | None:
        """None if it was not measured."""
        if self.value is None:
            return None
        return self.value <= self.bound if self.sense == "<=" else self.value >= self.bound

    @property
    def text(self) -> str:
        if self.value is None:
            return self.note
        value = f"{self.value:.3g}" if abs(self.value) < 1000 else f"{self.value:,.0f}"
        return f"{value}, {self.note}" if self.note else value

    def row(self) -> list[str]:
        """Return the row of a table below `GOALS`."""
        verdict = {True: "met", False: "missed", None: "not measured"}[self.met]
        return [self.name, f"{verdict}: {self.text}" if self.text else verdict]


@dataclass
class Trials:
    """The rows of one command, with the machine, the date and the settings of their run.

    Attributes:
        scenarios: the settings of each scenario, for a command that has some.
        skipped: for each skipped scenario, why it could not run on this machine.
    """

    command: str
    settings: dict[str, Any]
    machine: dict[str, Any] = field(default_factory=describe_machine)
    date: str = field(default_factory=lambda: datetime.date.today().isoformat())
    rows: list[dict[str, Any]] = field(default_factory=list)
    scenarios: dict[str, dict[str, Any]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        data = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        path.write_text(json.dumps({"trials": FORMAT, **data}, separators=(",", ":")))

    @classmethod
    def load(cls, paths: Iterable[Path]) -> list[Trials]:
        """Read files and merge those of one command; the settings are those of its first file.

        Raises:
            ValueError: a file has another format.
        """
        merged: dict[str, Trials] = {}
        for path in paths:
            data = _converted(json.loads(path.read_text()))
            if data.pop("trials", None) != FORMAT:
                raise ValueError(f"{path}: not the trials of these benchmarks")
            trials = cls(**data)
            first = merged.setdefault(trials.command, trials)
            if first is not trials:
                first.rows += trials.rows
                first.scenarios |= trials.scenarios
                first.skipped |= trials.skipped
        return list(merged.values())

    @property
    def conditions(self) -> str:
        """The date, the machine and the versions in one line."""
        machine = self.machine
        versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
        return (
            f"{self.date}: {machine['cpu']}, {machine['cores']} cores, Linux {machine['kernel']}, "
            f"Python {machine['python']}; {versions}."
        )


def _converted(data: dict[str, Any]) -> dict[str, Any]:
    """Return the contents of a file; those of suites had a format of their own in former times."""
    if data.get("format") != 1:
        return data
    rows = [*data.pop("turns")]
    for number, parts in enumerate(data.pop("allocations", [])):
        for part, kinds in parts.items():
            scenario = {"metric": "peak", "action": "allocate", "work": {}}
            data["scenarios"][f"allocations, {part}"] = scenario
            for kind, added in kinds.items():
                turn = {"scenario": f"allocations, {part}", "contestant": kind, "round": number}
                rows.append({**turn, "outcome": "ok", "added": added})
    del data["format"]
    return {**data, "trials": FORMAT, "command": SUITES, "date": "", "rows": rows}


def check(name: str, of: float | None, sense: str, bound: float, note: str = "") -> Goal:
    """Compare a figure with its bound; None was not measured."""
    return Goal(name, of, sense, bound, note)
