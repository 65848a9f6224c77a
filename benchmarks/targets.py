"""What the library sets out to reach, as ratios in one run, and whether it did."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from benchmarks.figures import figure, ratio
from benchmarks.results import Results

__all__ = ["TARGETS", "Target", "Verdict", "judge"]

Side = tuple[str, str]
"""A scenario and a contestant."""


@dataclass(frozen=True)
class Target:
    """A figure, or its ratio to another's where there is one, and its bound."""

    name: str
    metric: str
    sense: Literal["<=", ">="]
    bound: float
    of: Side
    to: Side | None = None


@dataclass(frozen=True)
class Verdict:
    """How a target came out; `met` is None where it was not measured."""

    target: Target
    met: bool | None
    text: str


ONE, EIGHT, INSIDE = "one at a time", "8 callers", "server inside"

TARGETS = (
    Target(
        "direct, one at a time, median latency / threaded client.call",
        *("median", "<=", 0.60, (ONE, "direct"), (ONE, "call")),
    ),
    Target(
        "direct on uvloop, one at a time, median latency / the floor",
        *("median", "<=", 1.20, (ONE, "direct-uvloop"), (ONE, "floor")),
    ),
    Target(
        "direct on asyncio, eight at once, calls/s / eight threads of client.call",
        *("rate", ">=", 3.5, (EIGHT, "direct"), (EIGHT, "call")),
    ),
    Target(
        "direct on uvloop, eight at once, calls/s / eight threads of client.call",
        *("rate", ">=", 5.0, (EIGHT, "direct-uvloop"), (EIGHT, "call")),
    ),
    Target(
        "direct on asyncio, eight at once, CPU per call / eight threads of client.call",
        *("client_cpu", "<=", 0.30, (EIGHT, "direct"), (EIGHT, "call")),
    ),
    Target(
        "direct on uvloop, eight at once, CPU per call / eight threads of client.call",
        *("client_cpu", "<=", 0.30, (EIGHT, "direct-uvloop"), (EIGHT, "call")),
    ),
    Target(
        "direct, server in the same process, median latency / client.call there",
        *("median", "<=", 0.25, (INSIDE, "direct"), (INSIDE, "call")),
    ),
    Target(
        "direct, 300 idle clients in the pool, median latency / none",
        *("median", "<=", 1.10, ("300 idle clients", "direct"), ("0 idle clients", "direct")),
    ),
    Target(
        "executor bridge, one at a time, median latency / threaded client.call",
        *("median", "<=", 1.20, (ONE, "executor"), (ONE, "call")),
    ),
    Target(
        "CPU of an idle session with 50 clients / an idle rclpy node",
        *("share", "<=", 1.10, ("idle, 50 clients", "direct"), ("idle, one client", "call")),
    ),
    Target(
        "memory after 100,000 calls above that after 10,000, in MB",
        *("growth", "<=", 1.0, ("memory", "direct")),
    ),
)


def judge(results: Results) -> Iterator[Verdict]:
    """A verdict for each target of which the results have both sides' scenarios."""
    for target in TARGETS:
        sides = [side for side in (target.of, target.to) if side]
        if all(scenario in results.scenarios for scenario, _ in sides):
            yield _judge(target, results)


def _judge(target: Target, results: Results) -> Verdict:
    for side in (target.of, target.to):
        if side and figure(results.of(*side), target.metric) is None:
            return Verdict(target, None, f"not measured: {_reason(results, side)}")
    if target.to:
        found = ratio(results.of(*target.of), results.of(*target.to), target.metric)
        if found is None:
            return Verdict(target, None, "not measured: no round that both ended")
        value, spread = found.median, f", {found.low:.2f} to {found.high:.2f} in {found.rounds}"
    else:
        value = figure(results.of(*target.of), target.metric) or 0.0
        spread = ""
    if value <= target.bound if target.sense == "<=" else value >= target.bound:
        return Verdict(target, True, f"met: {value:.2f}{spread}")
    other = ">" if target.sense == "<=" else "<"
    return Verdict(target, False, f"missed: {value:.2f} {other} {target.bound:.2f}{spread}")


def _reason(results: Results, side: Side) -> str:
    turns = results.of(*side)
    errors = [turn.error or turn.problem for turn in turns if turn.error or turn.problem]
    return f"{side[1]}: {errors[0] if errors else 'not in this run'}"
