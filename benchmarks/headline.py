"""The headline: what the README and the front page show of the results."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.contestants import CONTESTANTS
from benchmarks.figures import brief, figure, ratio
from benchmarks.results import Results

__all__ = ["conclusions", "draw_headline", "headline_rows"]

PANELS = {
    "one at a time": ("a stock server, one at a time", "median", "median µs"),
    "8 callers, stock server": ("a stock server, eight at once", "rate", "calls/s"),
    "1 caller, lean server": ("a bare loop, one at a time", "median", "median µs"),
    "8 callers": ("a bare loop, eight at once", "rate", "calls/s"),
}
"""The scenarios, with the server and the figure that each shows."""
OURS = ("direct-uvloop", "direct")
SHOWN = (*OURS, "call", "to-thread", "call-multi")
PEER = "call"


def conclusions(results: Results) -> Iterator[str]:
    """Say in a sentence for each scenario what rosasync and ``client.call`` reach."""
    for scenario, (server, metric, unit) in PANELS.items():
        peer = figure(results.of(scenario, PEER), metric)
        found = {key: figure(results.of(scenario, key), metric) for key in reversed(OURS)}
        said = [
            f"{value:,.0f} on {'uvloop' if 'uvloop' in key else 'asyncio'}"
            for key, value in found.items()
            if value is not None
        ]
        if said and peer is not None:
            yield f"With {server}, {unit}: {' and '.join(said)}; `client.call` {peer:,.0f}."


def headline_rows(results: Results) -> tuple[list[str], list[list[str]]]:
    """Return the heading and the rows of the README's table, with ratios to ``client.call``."""
    heading = ["", *(f"{server}, {unit}" for server, _, unit in PANELS.values())]
    body = [
        [
            CONTESTANTS[key].label,
            *(_cell(results, scenario, key, metric) for scenario, (_, metric, _) in PANELS.items()),
        ]
        for key in SHOWN
    ]
    return heading, body


def draw_headline(results: Results, path: Path) -> None:
    """Draw a panel of bars for each scenario, as SVG."""
    drawing = Figure(figsize=(10, 4.6), layout="tight")
    for axes, (scenario, (server, metric, unit)) in zip(
        drawing.subplots(2, 2).flat, PANELS.items(), strict=True
    ):
        values = [figure(results.of(scenario, key), metric) or 0.0 for key in SHOWN]
        colors = ["#2f6db3" if key in OURS else "#a9b4c0" for key in SHOWN]
        bars = axes.barh([CONTESTANTS[key].label for key in SHOWN], values, color=colors)
        axes.bar_label(bars, [f"{value:,.0f}" for value in values], padding=3)
        axes.invert_yaxis()
        axes.margins(x=0.2)
        axes.set_title(f"{server}: {unit}", fontsize=10)
        axes.tick_params(labelsize=8)
    drawing.savefig(path, metadata={"Date": None})


def _cell(results: Results, scenario: str, key: str, metric: str) -> str:
    value = figure(results.of(scenario, key), metric)
    found = ratio(results.of(scenario, key), results.of(scenario, PEER), metric)
    if value is None or found is None:
        return ""
    return f"{value:,.0f} ({brief(found.median)})"
