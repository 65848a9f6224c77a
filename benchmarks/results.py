"""The turns of suites, with their raw samples."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.meter import Usage
from benchmarks.trials import SUITES, Trials

__all__ = ["Results", "Turn"]


@dataclass(frozen=True)
class Turn:
    """One contestant in one round of one scenario; times in ns.

    Attributes:
        outcome: ``hung`` and ``failed`` turns have no samples; `error` says why.
        problem: the error of the first failed call of an otherwise good turn.
        server: the usage of the server process during the turn; None if it was not measured.
        memory: resident bytes, if the scenario measures them.
        added: what else the scenario counts, such as threads, descriptors and allocated blocks.
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
    added: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Turn:
        for name in ("client", "server"):
            if data.get(name):
                data = {**data, name: Usage(**data[name])}
        return cls(**{**data, "memory": tuple(data.get("memory", ()))})

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


class Results(Trials):
    """The turns of one or more suites."""

    def __init__(self, settings: dict[str, Any], **options: Any) -> None:
        super().__init__(SUITES, settings, **options)
        self.turns = [Turn.from_json(row) for row in self.rows]

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
        self.rows = [turn.to_json() for turn in self.turns]
        super().save(path)

    @classmethod
    def read(cls, paths: Iterable[Path]) -> Results:
        """Read one or more files and merge them; the machine is that of the first file.

        Raises:
            ValueError: there is no file, or a file has another format or is of another command.
        """
        found = Trials.load(paths)
        if [trials.command for trials in found] != [SUITES]:
            raise ValueError("these are not the results of suites; use `publish` for the others")
        data = dict(found[0].__dict__)
        del data["command"]
        return cls(**data)
