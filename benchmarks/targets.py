"""The targets of the library, as ratios within one run, and whether they are met."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from benchmarks.contestants import CONTESTANTS
from benchmarks.figures import brief, figure, ratio
from benchmarks.results import Results
from benchmarks.trials import Goal, check

__all__ = ["PEERS", "TARGETS", "Side", "Target", "judge"]

Side = tuple[str, str]
"""A scenario and a contestant, or one of `PEERS`."""

ANY_PEER, SLEEPING_PEER = "the best peer", "the best peer that does not burn a core"
PEERS = {
    ANY_PEER: tuple(key for key, entry in CONTESTANTS.items() if entry.kind == "peer"),
    SLEEPING_PEER: tuple(
        key for key, entry in CONTESTANTS.items() if entry.kind == "peer" and not entry.spins
    ),
}
"""Each name stands for the contestant with the best result."""
LATENCIES = ("median", "p99", "p99.9")
"""The metrics of which the lowest value is the best."""


@dataclass(frozen=True)
class Target:
    """A figure or a ratio of two figures, and its bound.

    Attributes:
        of: the side with the figure.
        to: the side whose figure is the divisor.
        beside: a side whose figure is shown for comparison.
    """

    name: str
    metric: str
    sense: Literal["<=", ">="]
    bound: float
    of: Side
    to: Side | None = None
    beside: Side | None = None

    @property
    def sides(self) -> list[Side]:
        """Every side that has to be measured."""
        return [side for side in (self.of, self.to, self.beside) if side]


ONE, EIGHT, INSIDE = "one at a time", "8 callers", "server inside"
MANY, SLOW, FLOOD = "512 callers", "answer after 10 ms", "flood"

ONE_LEAF, DECISION = "tick, 1 pending", "decision to request sent"
LEAVES, PROCESSES, IN_USE = "50 leaves", "50 leaves, processes", "1000 leaves in use"

TARGETS = (
    Target(
        "direct, one at a time, median latency / threaded client.call",
        *("median", "<=", 0.60, (ONE, "direct"), (ONE, "call")),
    ),
    Target(
        "direct, one at a time, median latency / the fastest peer that does not burn a core",
        *("median", "<=", 0.60, (ONE, "direct"), (ONE, SLEEPING_PEER)),
    ),
    Target(
        "direct on uvloop, one at a time, median latency / the floor",
        *("median", "<=", 1.15, (ONE, "direct-uvloop"), (ONE, "floor")),
    ),
    Target(
        "direct with busy poll, one at a time, median latency / the busy-poll limit",
        *("median", "<=", 1.25, (ONE, "direct-busy"), (ONE, "busy")),
    ),
    Target(
        "direct with busy poll, one at a time, median latency / threaded client.call",
        *("median", "<=", 0.30, (ONE, "direct-busy"), (ONE, "call")),
    ),
    Target(
        "direct with busy poll, an answer after 10 ms, CPU per call / without busy poll",
        *("client_cpu", "<=", 1.10, (SLOW, "direct-busy"), (SLOW, "direct")),
    ),
    Target(
        "direct on asyncio, eight at once, calls/s / the fastest peer",
        *("rate", ">=", 2.5, (EIGHT, "direct"), (EIGHT, ANY_PEER)),
    ),
    Target(
        "direct on uvloop, eight at once, calls/s / the fastest peer",
        *("rate", ">=", 3.5, (EIGHT, "direct-uvloop"), (EIGHT, ANY_PEER)),
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
        "direct, 512 callers, calls/s / 8 callers",
        *("rate", ">=", 0.9, (MANY, "direct"), (EIGHT, "direct")),
    ),
    Target(
        "direct, 512 callers, calls lost in %",
        *("lost", "<=", 0.0, (MANY, "direct")),
    ),
    Target(
        "direct, eight callers, 500 services in use, calls/s / 1 service",
        *("rate", ">=", 0.7, ("500 services", "direct"), ("1 service", "direct")),
    ),
    Target(
        "direct, 1 MB payload, median latency / the floor",
        *("median", "<=", 1.10, ("1 MB", "direct"), ("1 MB", "floor")),
    ),
    Target(
        "direct with Retry, busy beside a flood from another process, calls lost in %",
        *("lost", "<=", 0.0, (FLOOD, "direct-retry"), None, (FLOOD, "spin-until")),
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
    Target(
        "one tick of a pending CallService / of py_trees' own Running",
        *("median", "<=", 1.3, (ONE_LEAF, "tick-py-trees"), (ONE_LEAF, "tick-running")),
    ),
    Target(
        "AsyncServiceProxy.get_state() of a pending call, in µs",
        *("median", "<=", 1.0, ("state of a pending call", "tick-loop")),
    ),
    Target(
        "decision to request sent, ticked in the loop / a thread for each call",
        *("median", "<=", 0.3, (DECISION, "tick-loop"), (DECISION, "tick-threads")),
    ),
    Target(
        "decision to request sent, ticked in a thread / a thread for each call",
        *("median", "<=", 1.0, (DECISION, "tick-thread"), (DECISION, "tick-threads")),
    ),
    Target(
        "50 leaves ticked in the loop, calls/s / a thread for each call",
        *("rate", ">=", 5.0, (LEAVES, "tick-loop"), (LEAVES, "tick-threads")),
    ),
    Target(
        "50 leaves ticked in a thread, calls/s / a thread for each call",
        *("rate", ">=", 5.0, (LEAVES, "tick-thread"), (LEAVES, "tick-threads")),
    ),
    Target(
        "50 leaves ticked in a thread, calls/s / a process for each call",
        *("rate", ">=", 100, (LEAVES, "tick-thread"), (PROCESSES, "tick-processes")),
    ),
    Target(
        "threads added by 1,000 leaves with calls pending",
        *("threads", "<=", 0, (IN_USE, "tick-thread")),
    ),
    Target(
        "descriptors added by 1,000 leaves with calls pending",
        *("descriptors", "<=", 0, (IN_USE, "tick-thread")),
    ),
    Target(
        "server, async handler, eight at once, calls/s / a stock server's",
        *("rate", ">=", 1.6, ("rosasync, eight", "direct-uvloop")),
        ("stock-async, eight", "direct-uvloop"),
    ),
    Target(
        "server, async handler, one at a time, median latency / a stock server's",
        *("median", "<=", 1.15, ("rosasync, one", "floor"), ("stock-async, one", "floor")),
    ),
    Target(
        "server, async handler, eight at once, CPU of the server / a stock server's",
        *("server_cpu", "<=", 0.70, ("rosasync, eight", "direct-uvloop")),
        ("stock-async, eight", "direct-uvloop"),
    ),
    Target(
        "server, async handler, one at a time, CPU of the server / a stock server's",
        *("server_cpu", "<=", 0.70, ("rosasync, one", "floor"), ("stock-async, one", "floor")),
    ),
)


def judge(results: Results) -> Iterator[Goal]:
    """Compare each target whose scenarios are all in the results."""
    for target in TARGETS:
        if all(results.contestants(scenario) for scenario, _ in target.sides):
            value, note = _measured(target, results)
            yield check(target.name, value, target.sense, target.bound, note)


def _measured(target: Target, results: Results) -> tuple[float | None, str]:
    """Return the figure of a target with its spread, or why there is none."""
    better = min if target.metric in LATENCIES else max
    sides = {side: _best(results, side, target.metric, better) for side in target.sides}
    for side in sides.values():
        if figure(results.of(*side), target.metric) is None:
            return None, _reason(results, side)
    of = sides[target.of]
    value, note = figure(results.of(*of), target.metric), ""
    if target.to:
        to = sides[target.to]
        found = ratio(results.of(*of), results.of(*to), target.metric)
        if found is None:
            return None, "no round that both completed"
        value, note = found.median, f"{found.low:.2f} to {found.high:.2f} in {found.rounds}"
        note += f"; {to[1]}" if to != target.to else ""
    if target.beside:
        beside = sides[target.beside]
        shown = brief(figure(results.of(*beside), target.metric) or 0.0)
        note = "; ".join(filter(None, (note, f"{beside[1]}: {shown}")))
    return value, note


def _best(results: Results, side: Side, metric: str, better: Callable[..., str]) -> Side:
    """Resolve a side: a name in `PEERS` is its contestant with the best result."""
    scenario, contestant = side
    figures = {
        key: value
        for key in PEERS.get(contestant, ())
        if (value := figure(results.of(scenario, key), metric)) is not None
    }
    return (scenario, better(figures, key=figures.__getitem__)) if figures else side


def _reason(results: Results, side: Side) -> str:
    turns = results.of(*side)
    errors = [turn.error or turn.problem for turn in turns if turn.error or turn.problem]
    return f"{side[1]}: {errors[0] if errors else 'not in this run'}"
