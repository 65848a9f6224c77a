"""Writes saved results to ``docs/benchmarks.md``, with plots of the distributions."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.contestants import CONTESTANTS
from benchmarks.figures import METRICS, figure
from benchmarks.headline import conclusions, draw_headline, headline_rows
from benchmarks.pages import markdown_table, marked_sections
from benchmarks.results import Results, Turn
from benchmarks.tables import describe, rows
from benchmarks.targets import judge
from benchmarks.trials import GOALS

__all__ = ["write_plots", "write_report"]

POINTS = 400
"""Points of a curve: accurate enough, and the plots stay small."""

FEATURED = ("direct", "direct-uvloop", "executor", "call", "call-multi", "to-thread", "floor")
"""The contestants of a plot that would show more than these. The tables have all of them."""

METHOD = """\
## Method

`python -m benchmarks report` writes this page from saved results. Contestants alternate in rounds
within one run. Each runs in its own process, which is set up before a turn and cleaned up after it.
Latencies are measured around each call, with the caller's clock. The 99th and 99.9th percentiles
are those of all rounds' calls together. Every other figure is the median over the rounds. CPU time
and context switches are those of the whole process, including the middleware's threads. A ratio is
computed in each round; the tables have its median over the rounds, and the lowest and highest
value. The times are valid for the machine below. The ratios are more portable.
"""


TARGETS = """\
`direct` and `executor` are the two bridges of rosasync. An outcome is the median of the
rounds, with the lowest and the highest.
"""


def write_report(results: Results, out: Path) -> Path:
    """Write the page and its plots to `out`, and return the path of the page."""
    page = out / "benchmarks.md"
    out.mkdir(parents=True, exist_ok=True)
    sections = ["# Benchmarks\n", *_opening(results, out), *_targets(results)]
    plots = write_plots(results, out / "benchmarks")
    for scenario in results.scenarios:
        what = describe(results.scenarios[scenario])
        if reason := results.skipped.get(scenario):
            sections.append(f"## {_title(scenario)}\n\n{_sentence(what)}\nSkipped: {reason}.\n")
        if not results.contestants(scenario):
            continue
        heading, body = rows(results, scenario)
        sections += [f"## {_title(scenario)}\n\n{_sentence(what)}\n", markdown_table(heading, body)]
        if scenario in plots:
            picture = plots[scenario].relative_to(out)
            sections.append(f"![{scenario}]({picture})\n")
    sections += marked_sections(page.read_text()) if page.exists() else []
    sections += [METHOD, *_machine(results)]
    page.write_text("\n".join(sections))
    return page


def write_plots(results: Results, folder: Path) -> dict[str, Path]:
    """Draw the turns of each scenario as SVG; return the file of each with turns."""
    matplotlib.use("agg")
    matplotlib.rcParams["svg.hashsalt"] = "rosasync"
    folder.mkdir(parents=True, exist_ok=True)
    plots = {}
    for scenario, settings in results.scenarios.items():
        contestants = {
            key: [turn for turn in turns if turn.outcome == "ok"]
            for key, turns in results.contestants(scenario).items()
        }
        contestants = {key: turns for key, turns in contestants.items() if turns}
        if not contestants or settings["action"] == "allocate":
            continue
        drawing = _draw(scenario, settings["metric"], _shown(contestants, settings["metric"]))
        path = folder / (re.sub(r"\W+", "-", scenario) + ".svg")
        drawing.savefig(path, metadata={"Date": None})
        plots[scenario] = path
    return plots


def _shown(contestants: dict[str, list[Turn]], metric: str) -> dict[str, list[Turn]]:
    """Choose few contestants for a plot, and sort them by the metric, the smallest first."""
    if len(contestants) > len(FEATURED):
        contestants = {key: turns for key, turns in contestants.items() if key in FEATURED}
    return dict(sorted(contestants.items(), key=lambda item: figure(item[1], metric) or 0.0))


def _draw(scenario: str, metric: str, contestants: dict[str, list[Turn]]) -> Figure:
    height = 1.6 + 0.34 * len(contestants)
    sampled = any(turn.samples for turns in contestants.values() for turn in turns)
    drawing = Figure(figsize=(11, height if not sampled else max(height, 4.5)), layout="tight")
    if metric == "median" or not sampled:
        axes = list(drawing.subplots(1, 2 if sampled else 1, squeeze=False)[0])
    else:
        axes = list(drawing.subplots(1, 3)[:])
        _rounds(axes.pop(), metric, contestants)
    if sampled:
        _spread(axes[0], contestants)
        _exceeding(axes[1], contestants)
    else:
        _rounds(axes[0], metric, contestants)
    drawing.suptitle(_title(scenario))
    return drawing


def _spread(axes: Axes, contestants: dict[str, list[Turn]]) -> None:
    """Draw quartiles, median, and the 1st to the 99th percentile of each distribution."""
    samples = [_pooled(turns) for turns in contestants.values()]
    boxes = axes.boxplot(
        samples,
        orientation="horizontal",
        whis=(1, 99),
        showfliers=False,
        widths=0.6,
        patch_artist=True,
        medianprops={"color": "black"},
    )
    for i, box in enumerate(boxes["boxes"]):
        box.set_facecolor(_color(i))
    _name_rows(axes, contestants)
    axes.set_xscale("log")
    axes.set_xlabel("latency in µs: quartiles, 1 % to 99 %")


def _exceeding(axes: Axes, contestants: dict[str, list[Turn]]) -> None:
    """Draw the share of calls that took longer than a time, which shows the tail."""
    for i, turns in enumerate(contestants.values()):
        samples = np.sort(_pooled(turns))
        if not len(samples):
            continue
        longer = np.unique(np.geomspace(1, len(samples), POINTS).astype(int))
        axes.plot(samples[-longer], longer / len(samples), color=_color(i), linewidth=1.2)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("latency in µs")
    axes.set_ylabel("share of calls that took longer")
    axes.grid(alpha=0.3)


def _rounds(axes: Axes, metric: str, contestants: dict[str, list[Turn]]) -> None:
    """Draw one dot for each round."""
    shown = METRICS[metric]
    for i, turns in enumerate(contestants.values()):
        values = [value for turn in turns if (value := shown.of(turn)) is not None]
        axes.plot(values, [i + 1] * len(values), "o", alpha=0.7, color=_color(i))
    _name_rows(axes, contestants)
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel(f"{shown.label}, a dot for each round")


def _name_rows(axes: Axes, contestants: Iterable[str]) -> None:
    """Label the rows in the colours of the curves beside them, which then need no legend."""
    names = list(contestants)
    axes.set_yticks(range(1, len(names) + 1), names)
    for i, label in enumerate(axes.get_yticklabels()):
        label.set_color(_color(i))
    axes.set_ylim(len(names) + 0.5, 0.5)
    axes.grid(axis="x", alpha=0.3)


def _color(i: int) -> Any:
    """Return one of ten strong colours, then one of the same ten in a lighter shade."""
    return matplotlib.colormaps["tab20"](2 * i % 20 + i // 10 % 2)


def _pooled(turns: Iterable[Turn]) -> list[float]:
    return [sample / 1e3 for turn in turns for sample in turn.samples]


def _opening(results: Results, out: Path) -> Iterator[str]:
    if sentences := list(conclusions(results)):
        yield "\n".join(f"- {sentence}" for sentence in sentences) + "\n"
        (out / "diagrams").mkdir(exist_ok=True)
        draw_headline(results, out / "diagrams" / "benchmark.svg")
        yield "![Latency and throughput with two servers](diagrams/benchmark.svg)\n"
        yield markdown_table(*headline_rows(results))
    goals = list(judge(results))
    if missed := [goal.name for goal in goals if goal.met is False]:
        yield f"{len(goals) - len(missed)} of {len(goals)} targets are met. Missed:\n"
        yield "\n".join(f"- {name}" for name in missed) + "\n"


def _machine(results: Results) -> Iterator[str]:
    machine, settings = results.machine, results.settings
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    yield "## Machine\n"
    yield (
        f"{machine['cpu']}, {machine['cores']} cores, load {machine['load']:.1f} before the run, "
        f"Linux {machine['kernel']}, Python {machine['python']}, {machine['middleware']}; "
        f"{versions}. {settings['rounds']} rounds{', quick' if settings['quick'] else ''}"
        f"{', the server on its own cores' if settings['pin'] else ''}.\n"
    )
    yield "## Contestants\n"
    used = {turn.contestant for turn in results.turns}
    body = [
        [f"`{key}`", entry.label, entry.kind, "yes" if entry.spins else ""]
        for key, entry in CONTESTANTS.items()
        if key in used
    ]
    yield markdown_table(["", "", "kind", "keeps a core busy"], body)


def _targets(results: Results) -> Iterator[str]:
    if body := [goal.row() for goal in judge(results)]:
        yield "## Targets\n"
        yield TARGETS
        yield markdown_table(GOALS, body)


def _title(scenario: str) -> str:
    return scenario[0].upper() + scenario[1:]


def _sentence(text: str) -> str:
    return f"{_title(text)}."
