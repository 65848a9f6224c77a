"""Computes figures from turns: percentiles, rates, costs, and ratios with their spread."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from benchmarks.results import Turn

__all__ = ["METRICS", "Metric", "Ratio", "brief", "figure", "pooled_percentile", "ratio"]


@dataclass(frozen=True)
class Metric:
    """A figure of one turn, with its column heading; None if the turn does not have it."""

    label: str
    of: Callable[[Turn], float | None]
    over: Callable[[list[float]], float] = statistics.median
    """Combines the figures of all rounds into one."""


def _percentile(q: float) -> Callable[[Turn], float | None]:
    return lambda turn: float(np.percentile(turn.samples, q)) / 1e3 if turn.samples else None


def _per_call(turn: Turn, amount: float) -> float | None:
    return amount / len(turn.samples) if turn.samples else None


def _rate(turn: Turn) -> float | None:
    return len(turn.samples) / turn.elapsed * 1e9 if turn.elapsed else None


def _lost(turn: Turn) -> float | None:
    missed = turn.lost + turn.failed
    calls = missed + len(turn.samples)
    return missed / calls * 100 if calls else None


def _server_cpu(turn: Turn) -> float | None:
    return None if turn.server is None else _per_call(turn, turn.server.cpu / 1e3)


METRICS = {
    "median": Metric("median µs", _percentile(50)),
    "p99": Metric("99 % µs", _percentile(99)),
    "p99.9": Metric("99.9 % µs", _percentile(99.9)),
    "rate": Metric("calls/s", _rate),
    "client_cpu": Metric("CPU µs", lambda t: _per_call(t, t.client.cpu / 1e3)),
    "server_cpu": Metric("server µs", _server_cpu),
    "switches": Metric(
        "switches", lambda t: _per_call(t, t.client.voluntary + t.client.involuntary)
    ),
    "lost": Metric("lost %", _lost, max),
    "threads": Metric("threads", lambda t: t.added.get("threads")),
    "descriptors": Metric("descriptors", lambda t: t.added.get("descriptors")),
    "share": Metric("CPU %", lambda t: t.client.cpu / t.elapsed * 100 if t.elapsed else None),
    "growth": Metric(
        "growth MB", lambda t: (t.memory[-1] - t.memory[0]) / 1e6 if t.memory else None
    ),
    "blocks": Metric("blocks held by an outstanding call", lambda t: t.added.get("blocks")),
    "bytes": Metric("bytes held by it", lambda t: t.added.get("bytes")),
    "peak": Metric("bytes at the peak", lambda t: t.added.get("peak")),
    "kept": Metric("blocks kept", lambda t: t.added.get("kept_blocks")),
    "grown": Metric("growth MB", lambda t: t.added.get("growth")),
    "pending": Metric("pending", lambda t: t.added.get("pending")),
}


@dataclass(frozen=True)
class Ratio:
    """The median of the rounds' ratios, and their spread."""

    median: float
    low: float
    high: float
    rounds: int

    def __str__(self) -> str:
        return f"{brief(self.median)} ({brief(self.low)} to {brief(self.high)})"


def brief(value: float) -> str:
    """Format a number with about three significant digits."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def figure(turns: Iterable[Turn], metric: str) -> float | None:
    """Return the median over the rounds; for losses, the maximum."""
    found = METRICS[metric]
    values = [
        value for turn in turns if turn.outcome == "ok" and (value := found.of(turn)) is not None
    ]
    return found.over(values) if values else None


def pooled_percentile(turns: Iterable[Turn], q: float) -> float | None:
    """Return a percentile in µs of all rounds' samples together, as high percentiles need."""
    samples = [sample for turn in turns for sample in turn.samples]
    return float(np.percentile(samples, q)) / 1e3 if samples else None


def ratio(turns: Iterable[Turn], others: Iterable[Turn], metric: str) -> Ratio | None:
    """Return the ratio over the rounds in which both have the figure; None without such rounds."""
    of = METRICS[metric].of
    below = {turn.round: of(turn) for turn in others if turn.outcome == "ok"}
    ratios = [
        value / other
        for turn in turns
        if turn.outcome == "ok"
        and (value := of(turn)) is not None
        and (other := below.get(turn.round))
    ]
    if not ratios:
        return None
    return Ratio(statistics.median(ratios), min(ratios), max(ratios), len(ratios))
