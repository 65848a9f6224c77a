"""Runs scenarios: contestants alternate in rounds, and one that hangs is ended and reported."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal

from rich.progress import Progress

from benchmarks.meter import Usage
from benchmarks.pipes import Child, ChildError, Hung
from benchmarks.results import Results, Turn
from benchmarks.work import READY_TIMEOUT, Work

__all__ = ["Runner", "Scenario"]

PATIENCE = 10.0
"""Seconds an answer may take beyond what was asked for."""
HANGS = 2
"""Hangs in one scenario after which a contestant is not tried again in it."""
SOAK_TIMEOUT = 600.0


@dataclass(frozen=True)
class Scenario:
    """One kind of work for some contestants.

    Attributes:
        key: its name in the results. Scenarios with the same `group` alternate with each other.
        callers: how many call at once.
        calls: calls in one turn, or as many as fit into `seconds`.
        action: ``call``; ``rest`` for `seconds`; ``soak``, whose length is the worker's.
        rounds: rounds at most, where turns are long.
        metric: what its ratios are of.
    """

    key: str
    group: str
    contestants: tuple[str, ...]
    work: Work = field(default_factory=Work)
    callers: int = 1
    calls: int = 4000
    seconds: float = 5.0
    action: Literal["call", "rest", "soak"] = "call"
    rounds: int = 1000
    metric: str = "median"

    def to_json(self) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "work": self.work.to_json()}


class Runner:
    """The server and the contestants, each in a process of its own.

    A turn sets a contestant up, lets it call, and takes it down again, with a service nobody else
    uses: while one is measured, the others have neither threads nor clients.
    """

    def __init__(self, rounds: int, pin: bool, results: Results, progress: Progress) -> None:
        self._rounds = rounds
        self._results = results
        self._progress = progress
        self._turns = 0
        self._server: Child | None = None
        self._workers: dict[str, Child] = {}
        self._hung: Counter[tuple[str, str]] = Counter()
        self._server_cores, self._worker_cores = split_cores() if pin else (None, None)

    def __enter__(self) -> Runner:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        for child in [*self._workers.values(), *([self._server] if self._server else [])]:
            child.close() if exc_type is None else child.kill()

    def run(self, scenarios: Sequence[Scenario]) -> None:
        """Runs every scenario, one group after the other."""
        for scenario in scenarios:
            self._results.scenarios[scenario.key] = scenario.to_json()
        groups = dict.fromkeys(scenario.group for scenario in scenarios)
        plans = {
            name: [(s, c) for s in scenarios if s.group == name for c in s.contestants]
            for name in groups
        }
        total = sum(min(self._rounds, s.rounds) for plan in plans.values() for s, _ in plan)
        task = self._progress.add_task("", total=total)
        for plan in plans.values():
            for number in range(self._rounds):
                shift = number % len(plan)
                for scenario, contestant in plan[shift:] + plan[:shift]:
                    if number < scenario.rounds:
                        self._progress.update(task, description=f"{scenario.key}: {contestant}")
                        self._turn(scenario, contestant, number)
                        self._progress.advance(task)

    def _turn(self, scenario: Scenario, contestant: str, number: int) -> None:
        if self._hung[scenario.key, contestant] >= HANGS:
            return
        turn = Turn(scenario.key, contestant, number, "ok")
        try:
            measured = self._measure(scenario, contestant)
        except Hung as exc:
            self._hung[scenario.key, contestant] += 1
            turn = dataclasses.replace(turn, outcome="hung", error=str(exc))
            self._workers.pop(contestant).kill()
            self._end_server()
        except ChildError as exc:
            turn = dataclasses.replace(turn, outcome="failed", error=str(exc))
            self._workers.pop(contestant).close()
            self._end_server()
        else:
            turn = dataclasses.replace(turn, **measured)
        self._results.turns.append(turn)

    def _measure(self, scenario: Scenario, contestant: str) -> dict[str, Any]:
        self._turns += 1
        name = f"/bench/turn_{self._turns}"
        work = dataclasses.replace(scenario.work, srv_name=name).to_json()
        patience = PATIENCE + scenario.seconds
        server, worker = self._serving(), self._worker(contestant, fresh=scenario.action != "call")
        if scenario.work.server != "inside":
            server.ask("serve", work=work, timeout=READY_TIMEOUT)
        worker.ask("setup", work=work, timeout=READY_TIMEOUT + PATIENCE)
        if scenario.action == "call":
            warm_up = {"calls": max(10 * scenario.callers, scenario.calls // 10), "seconds": 1.0}
            worker.ask("call", callers=scenario.callers, timeout=patience, **warm_up)
        before = Usage(**server.ask("usage", timeout=PATIENCE))
        measured = self._act(scenario, worker, patience)
        after = Usage(**server.ask("usage", timeout=PATIENCE))
        worker.ask("close", timeout=PATIENCE)
        if scenario.work.server != "inside":
            server.ask("end", timeout=PATIENCE)
            measured["server"] = after - before
        return measured

    def _act(self, scenario: Scenario, worker: Child, patience: float) -> dict[str, Any]:
        if scenario.action == "soak":
            answer = worker.ask("soak", timeout=SOAK_TIMEOUT)
            answer["memory"] = tuple(answer["memory"])
        elif scenario.action == "rest":
            answer = worker.ask("rest", seconds=scenario.seconds, timeout=patience)
        else:
            wanted = {"calls": scenario.calls, "seconds": scenario.seconds}
            answer = worker.ask("call", callers=scenario.callers, timeout=patience, **wanted)
        return {**answer, "client": Usage(**answer["client"])}

    def _serving(self) -> Child:
        if self._server is None:
            self._server = Child("benchmarks.server", cores=self._server_cores)
        return self._server

    def _worker(self, contestant: str, *, fresh: bool) -> Child:
        if fresh and contestant in self._workers:
            self._workers.pop(contestant).close()
        if contestant not in self._workers:
            self._workers[contestant] = Child(
                "benchmarks.worker", contestant, cores=self._worker_cores
            )
        return self._workers[contestant]

    def _end_server(self) -> None:
        if self._server:
            self._server.close()
            self._server = None


def split_cores() -> tuple[set[int] | None, set[int] | None]:
    """Cores for the server and for the contestants; None where there is only one."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return None, None
    half = len(cores) // 2
    return set(cores[half:]), set(cores[:half])
