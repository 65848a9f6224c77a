"""Shows results as tables, in the terminal and in Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from benchmarks.figures import METRICS, brief, figure, pooled_percentile, ratio
from benchmarks.results import Results, Turn
from benchmarks.ticks import describe_ticks
from benchmarks.trials import GOALS, Goal
from benchmarks.work import SERVERS

__all__ = ["describe", "goal_table", "make_console", "make_table", "rows", "scenario_table"]

WIDTH = 180

COLUMNS = {
    "median": ("median", "p99", "p99.9", "rate", "client_cpu", "server_cpu", "switches"),
    "rate": ("rate", "median", "p99", "p99.9", "client_cpu", "server_cpu", "switches"),
    "lost": ("lost", "rate", "median", "p99"),
    "threads": ("threads", "descriptors"),
    "share": ("share",),
    "growth": ("growth",),
    "peak": ("blocks", "bytes", "peak", "kept", "grown", "pending"),
}
POOLED = {"p99": 99.0, "p99.9": 99.9}
BASELINES = {"call": "÷ call", "floor": "÷ floor"}


def describe(scenario: dict[str, Any]) -> str:
    """Describe a scenario in one line."""
    work = scenario["work"]
    if scenario["action"] == "tick":
        return describe_ticks(scenario["measure"], scenario["callers"])
    if scenario["action"] == "rest":
        return f"{work['idle_clients'] or 'one'} client(s), no calls, {scenario['seconds']:g} s"
    if scenario["action"] == "soak":
        return "of the calls, a third is answered, a third times out, and a third is cancelled"
    if scenario["action"] == "allocate":
        return "memory of a call or a request, and what stays allocated after many"
    place = ", on another host" if scenario["host"] == "other" else ""
    server = {
        "inside": "in the same process",
        "stock": "stock rclpy",
        "stock-async": "stock rclpy, async handler",
        "lean": "bare loop",
        **{name: f"rosasync, {kind}" for name, kind in SERVERS.items()},
    }
    parts = [f"server: {server[work['server']]}{place}", f"callers: {scenario['callers']}"]
    if scenario["flood"]:
        parts.append(f"another process keeps {scenario['flood']} requests outstanding")
    parts += [f"the caller is busy for {work['busy'] * 1e3:g} ms at a time"] * (work["busy"] > 0)
    parts += [f"services: {work['services']}"] * (work["services"] > 1)
    parts += [f"idle clients: {work['idle_clients']}"] * (work["idle_clients"] > 0)
    parts += [f"payload: {work['payload']} bytes"] * (work["payload"] > 0)
    parts += [f"answers after {work['delays'][0] * 1e3:g} ms"] * (work["delays"][0] > 0)
    parts += [f"depth {work['depth']}"] if work["depth"] else []
    return ", ".join(parts)


def rows(results: Results, scenario: str) -> tuple[list[str], list[list[str]]]:
    """Return the heading and the rows of one scenario, with a row for each contestant."""
    metric = results.scenarios[scenario]["metric"]
    contestants = results.contestants(scenario)
    baselines = {key: label for key, label in BASELINES.items() if key in contestants}
    columns = [c for c in COLUMNS[metric] if any(_cell(t, c) for t in contestants.values())]
    heading = [METRICS[name].label for name in columns]
    table = []
    for key, turns in contestants.items():
        ratios = [ratio(turns, contestants[base], metric) for base in baselines]
        table.append(
            [
                key,
                *(_cell(turns, column) for column in columns),
                *(str(found) if found else "" for found in ratios),
                _remarks(turns),
            ]
        )
    return ["", *heading, *baselines.values(), "remarks"], table


def make_console() -> Console:
    """Return a console for the terminal, or one that is wide enough for a table."""
    console = Console()
    return console if console.is_terminal else Console(width=WIDTH)


def scenario_table(results: Results, scenario: str) -> Table:
    heading, body = rows(results, scenario)
    what = describe(results.scenarios[scenario])
    return make_table(f"[bold]{scenario}[/]: {what}", heading, body)


def make_table(title: str, heading: list[str], body: list[list[str]]) -> Table:
    """Return a table for the terminal; the first and the last column are words."""
    table = Table(title=title, title_justify="left", box=SIMPLE)
    for i, column in enumerate(heading):
        words = i in (0, len(heading) - 1)
        table.add_column(column, justify="left" if words else "right", no_wrap=not words or i == 0)
    for row in body:
        table.add_row(*row)
    return table


def goal_table(goals: Iterable[Goal]) -> Table | None:
    """Return the table of goals, or None if none was measured."""
    rows = [goal.row() for goal in goals if goal.met is not None or goal.note]
    return make_table("goals", GOALS, rows) if rows else None


def _cell(turns: Iterable[Turn], metric: str) -> str:
    pooled = POOLED.get(metric)
    value = pooled_percentile(turns, pooled) if pooled else figure(turns, metric)
    if value is None:
        return ""
    return brief(value)


def _remarks(turns: list[Turn]) -> str:
    outcomes = Counter(turn.outcome for turn in turns)
    lost, failed = sum(turn.lost for turn in turns), sum(turn.failed for turn in turns)
    calls = lost + failed + sum(len(turn.samples) for turn in turns)
    remarks = [
        f"{outcome} {outcomes[outcome]} of {len(turns)} rounds"
        for outcome in ("hung", "failed")
        if outcomes[outcome]
    ]
    remarks += [f"lost {lost:,} of {calls:,}"] if lost else []
    remarks += [f"failed {failed:,} of {calls:,}"] if failed else []
    problems = dict.fromkeys(text for turn in turns for text in (turn.error, turn.problem) if text)
    return "; ".join(remarks + list(problems)[:1])
