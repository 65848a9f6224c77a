"""The measurements: turns with their raw samples, and the file that stores them."""

from __future__ import annotations

import dataclasses
import json
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.meter import Usage

__all__ = ["Results", "Turn"]

FORMAT = 1


@dataclass(frozen=True)
class Turn:
    """One contestant in one round of one scenario; times in ns.

    Attributes:
        outcome: ``hung`` and ``failed`` turns have no samples; `error` says why.
        problem: the error of the first failed call of an otherwise good turn.
        server: the usage of the server process during the turn; None if it was not measured.
        memory: resident bytes, if the scenario measures them.
        added: threads and descriptors, if the scenario counts them.
    """

    scenario: str
    contestant: str
    round: int
    outcome: Literal["ok", "hung", "failed"]
    error: str = ""
    samples: list[int] = field(default_factory=list, repr=False)
    elapsed: int = 0
    lost: int = 0
    failed: int = 0
    problem: str = ""
    client: Usage = field(default_factory=Usage)
    server: Usage | None = None
    memory: tuple[int, ...] = ()
    added: dict[str, int] = field(default_factory=dict)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Turn:
        server = data.pop("server")
        return cls(
            **{
                **data,
                "client": Usage(**data["client"]),
                "server": server and Usage(**server),
                "memory": tuple(data["memory"]),
            }
        )

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@dataclass
class Results:
    """All measurements of one run.

    Attributes:
        scenarios: the title, group and work of each scenario, in the order of the run.
        skipped: for each skipped scenario, why it could not run on this machine.
        settings: the settings of the run.
        allocations: for each round, what each kind of ``clients`` and ``servers`` needed.
    """

    machine: dict[str, Any]
    settings: dict[str, Any]
    scenarios: dict[str, dict[str, Any]] = field(default_factory=dict)
    turns: list[Turn] = field(default_factory=list)
    skipped: dict[str, str] = field(default_factory=dict)
    allocations: list[dict[str, dict[str, dict[str, float]]]] = field(default_factory=list)

    def of(self, scenario: str, contestant: str) -> list[Turn]:
        return [t for t in self.turns if (t.scenario, t.contestant) == (scenario, contestant)]

    def contestants(self, scenario: str) -> dict[str, list[Turn]]:
        """The turns of each contestant, in the order of their first turn."""
        turns: defaultdict[str, list[Turn]] = defaultdict(list)
        for turn in self.turns:
            if turn.scenario == scenario:
                turns[turn.contestant].append(turn)
        return dict(turns)

    def save(self, path: Path) -> None:
        data = {
            "format": FORMAT,
            "machine": self.machine,
            "settings": self.settings,
            "scenarios": self.scenarios,
            "turns": [turn.to_json() for turn in self.turns],
            "skipped": self.skipped,
            "allocations": self.allocations,
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, separators=(",", ":")))

    @classmethod
    def load(cls, paths: Iterable[Path]) -> Results:
        """Read one or more files and merge them; the machine is that of the first file.

        Raises:
            ValueError: there is no file, or a file has another format.
        """
        merged: Results | None = None
        for path in paths:
            data = json.loads(path.read_text())
            if data.get("format") != FORMAT:
                raise ValueError(f"{path}: not a result of these benchmarks")
            turns = [Turn.from_json(turn) for turn in data["turns"]]
            if merged is None:
                merged = cls(data["machine"], data["settings"])
            merged.scenarios |= data["scenarios"]
            merged.turns += turns
            merged.skipped |= data.get("skipped", {})
            merged.allocations += data.get("allocations", [])
        if merged is None:
            raise ValueError("no results to read")
        return merged
