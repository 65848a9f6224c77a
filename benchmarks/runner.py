"""Runs scenarios: contestants alternate in rounds; one that hangs is killed and reported."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, Literal

from rich.progress import Progress

from benchmarks.meter import Usage
from benchmarks.results import Results, Turn
from benchmarks.work import Work
from tests.support.child import Child, ChildError, Unanswered
from tests.support.flood import flooding
from tests.support.hosts import Hosts, NoHosts

__all__ = ["Runner", "Scenario"]

PATIENCE = 10.0
"""Seconds that an answer may take beyond the requested duration."""
HANGS = 2
"""Number of hangs in one scenario after which the contestant is not tried again there."""
SOAK_TIMEOUT = 600.0


@dataclass(frozen=True)
class Scenario:
    """One kind of work for a set of contestants.

    Attributes:
        key: the name in the results. Scenarios of the same `group` alternate with each other.
        callers: number of concurrent callers.
        calls: number of calls in one turn, or fewer if `seconds` run out.
        action: ``call``; ``rest`` for `seconds`; ``soak``, whose length the worker decides;
            ``tick``, with as many leaves as callers. What ``allocate`` measures is in
            `benchmarks.allocations`.
        host: the server's host: the contestants' machine, or another one, which is a network
            namespace.
        flood: number of outstanding requests of another process to the same service.
        rounds: maximum number of rounds, for long turns.
        metric: the metric of the ratios.
        measure: the measure of the ticks; see `benchmarks.ticking.Ticked`.
    """

    key: str
    group: str
    contestants: tuple[str, ...]
    work: Work = field(default_factory=Work)
    callers: int = 1
    calls: int = 4000
    seconds: float = 5.0
    action: Literal["call", "rest", "soak", "tick", "allocate"] = "call"
    host: Literal["same", "other"] = "same"
    flood: int = 0
    rounds: int = 1000
    metric: str = "median"
    measure: str = ""

    def to_json(self) -> dict[str, Any]:
        return {**dataclasses.asdict(self), "work": self.work.to_json()}


class Runner:
    """Runs the server and the contestants, each in its own process.

    A turn sets a contestant up, lets it call a service of its own, and takes it down again. So
    while one contestant is measured, the others have no threads and no clients.
    """

    def __init__(self, rounds: int, pin: bool, results: Results, progress: Progress) -> None:
        self._rounds = rounds
        self._results = results
        self._progress = progress
        self._turns = 0
        self._children: dict[tuple[str, str], Child] = {}
        self._hosts: Hosts | None = None
        self._hung: Counter[tuple[str, str]] = Counter()
        self._server_cores, self._worker_cores = split_cores() if pin else (None, None)
        self._stack = ExitStack()

    def __enter__(self) -> Runner:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        tb: TracebackType | None,
    ) -> None:
        with self._stack:
            for child in self._children.values():
                child.close() if exc_type is None else child.kill()

    def run(self, scenarios: Sequence[Scenario]) -> None:
        """Run every scenario that can run on this machine, one group after the other."""
        for scenario in scenarios:
            self._results.scenarios[scenario.key] = scenario.to_json()
        scenarios = [scenario for scenario in scenarios if self._can_run(scenario)]
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

    def _can_run(self, scenario: Scenario) -> bool:
        if scenario.host == "other" and self._hosts is None:
            try:
                self._hosts = self._stack.enter_context(Hosts())
            except NoHosts as exc:
                self._results.skipped[scenario.key] = str(exc)
                self._progress.console.print(f"{scenario.key}: skipped, {exc}", highlight=False)
                return False
        return True

    def _turn(self, scenario: Scenario, contestant: str, number: int) -> None:
        if self._hung[scenario.key, contestant] >= HANGS:
            return
        turn = Turn(scenario.key, contestant, number, "ok")
        try:
            measured = self._measure(scenario, contestant)
        except Unanswered as exc:
            self._hung[scenario.key, contestant] += 1
            turn = dataclasses.replace(turn, outcome="hung", error=str(exc))
            self._end(scenario.host, contestant)
        except ChildError as exc:
            turn = dataclasses.replace(turn, outcome="failed", error=str(exc))
            self._end(scenario.host, contestant)
        else:
            turn = dataclasses.replace(turn, **measured)
        self._results.turns.append(turn)

    def _measure(self, scenario: Scenario, contestant: str) -> dict[str, Any]:
        self._turns += 1
        name = f"/bench/turn_{self._turns}"
        work = dataclasses.replace(scenario.work, srv_name=name)
        patience = PATIENCE + scenario.seconds
        server, worker = self._server(scenario.host), self._worker(scenario, contestant)
        if work.server != "inside":
            server.ask_now("serve", work=work.to_json())
        worker.ask_now("setup", work=work.to_json())
        with ExitStack() as stack:
            if scenario.flood:
                options = self._options(scenario.host, on_server=False)
                flood = flooding(work.names[0], work.srv_type, scenario.flood, **options)
                stack.enter_context(flood)
            elif scenario.action == "call":
                calls = max(10 * scenario.callers, scenario.calls // 10)
                self._act(dataclasses.replace(scenario, calls=calls, seconds=1.0), worker, patience)
            before = Usage(**server.ask_now("usage", patience=PATIENCE))
            measured = self._act(scenario, worker, patience)
            after = Usage(**server.ask_now("usage", patience=PATIENCE))
        worker.ask_now("close", patience=PATIENCE)
        if work.server != "inside":
            server.ask_now("end", patience=PATIENCE)
            measured["server"] = after - before
        return measured

    def _act(self, scenario: Scenario, worker: Child, patience: float) -> dict[str, Any]:
        wanted: dict[str, Any] = {"calls": scenario.calls, "seconds": scenario.seconds}
        if scenario.action == "soak":
            wanted, patience = {}, SOAK_TIMEOUT
        elif scenario.action == "rest":
            del wanted["calls"]
        elif scenario.action == "tick":
            wanted |= {"measure": scenario.measure, "leaves": scenario.callers}
        else:
            wanted["callers"] = scenario.callers
        answer = worker.ask_now(scenario.action, patience=patience, **wanted)
        return {**answer, "client": Usage(**answer["client"])}

    def _server(self, host: str) -> Child:
        return self._child(host, "benchmarks.server")

    def _worker(self, scenario: Scenario, contestant: str) -> Child:
        used = self._children.get((scenario.host, contestant))
        if used and scenario.action != "call":
            del self._children[scenario.host, contestant]
            used.close()
        return self._child(scenario.host, "benchmarks.worker", contestant)

    def _child(self, host: str, module: str, *args: str) -> Child:
        key = (host, args[0] if args else module)
        if key not in self._children:
            options = self._options(host, on_server=module == "benchmarks.server")
            self._children[key] = Child(module, *args, **options)
        return self._children[key]

    def _options(self, host: str, *, on_server: bool) -> dict[str, Any]:
        options: dict[str, Any] = {"quiet": True}
        options["cores"] = self._server_cores if on_server else self._worker_cores
        if host == "other":
            assert self._hosts is not None
            options["prefix"] = self._hosts.on_server if on_server else self._hosts.on_client
            options["environment"] = self._hosts.environment
        return options

    def _end(self, host: str, contestant: str) -> None:
        """End the processes of a failed turn; one that hung is dead already."""
        for name in (contestant, "benchmarks.server"):
            if (child := self._children.pop((host, name), None)) is not None:
                with child:
                    pass


def split_cores() -> tuple[set[int] | None, set[int] | None]:
    """Return the cores for the server and for the contestants; None if there is only one core."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return None, None
    half = len(cores) // 2
    return set(cores[half:]), set(cores[:half])
