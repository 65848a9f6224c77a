"""The results of the commands about many programs and faults: one row for each trial."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.machine import describe_machine

__all__ = ["Goal", "Trials", "check"]

FORMAT = 1


@dataclass(frozen=True)
class Goal:
    """A goal, and whether it is met; `met` is None if it was not measured."""

    name: str
    met: bool | None
    text: str

    def row(self) -> list[str]:
        verdict = {True: "met", False: "missed", None: "not measured"}[self.met]
        return [self.name, f"{verdict}: {self.text}" if self.text else verdict]


@dataclass
class Trials:
    """The rows of one command, with the machine, the date and the settings of their run."""

    command: str
    settings: dict[str, Any]
    machine: dict[str, Any] = field(default_factory=describe_machine)
    date: str = field(default_factory=lambda: datetime.date.today().isoformat())
    rows: list[dict[str, Any]] = field(default_factory=list)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"trials": FORMAT, **self.__dict__}, separators=(",", ":")))

    @classmethod
    def load(cls, paths: Iterable[Path]) -> list[Trials]:
        """Read files and merge those of one command; the settings are those of its first file.

        Raises:
            ValueError: a file has another format.
        """
        merged: dict[str, Trials] = {}
        for path in paths:
            data = json.loads(path.read_text())
            if data.pop("trials", None) != FORMAT:
                raise ValueError(f"{path}: not the trials of these benchmarks")
            trials = cls(**data)
            merged.setdefault(trials.command, cls(**{**data, "rows": []})).rows += trials.rows
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


def check(name: str, of: float | None, sense: str, bound: float) -> Goal:
    """Compare a figure with its bound; None was not measured."""
    if of is None:
        return Goal(f"{name} {sense} {bound:g}", None, "")
    met = of <= bound if sense == "<=" else of >= bound
    return Goal(f"{name} {sense} {bound:g}", met, f"{of:.3g}")
