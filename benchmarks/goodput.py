"""Callers that give up after a second, which their client does not know before they leave.

The calls and servers are those of `overload`, in which clients know the deadlines of their callers.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from matplotlib.figure import Figure

from benchmarks.figures import brief
from benchmarks.overload import Cell, Plan, measure, plot
from benchmarks.pages import markdown_table
from benchmarks.trials import GOALS, Goal, Trials, check

__all__ = [
    "COMMAND",
    "LOADS",
    "PAIRS",
    "draw",
    "goals",
    "heading",
    "measure",
    "plans",
    "row",
    "section",
]

COMMAND = "goodput"
LOADS = "0.5,1,2,4"
PAIRS = {
    ("rosasync-leaving", "rosasync-status"): "rosasync with status",
    ("rosasync-leaving", "rosasync-async"): "rosasync without status",
    ("stock", "stock"): "stock",
}
"""The label of each pair of client and server."""
WORK = 10.0
"""Milliseconds for which a server works on a request."""
LIMIT = "1"
"""Seconds after which a caller gives up: a key of `overload.TIMEOUTS`."""
TARGET = 0.9
"""The goodput with status at twice the load, at least."""


def plans(loads: Sequence[float]) -> list[Plan]:
    """Return the cells to measure, by server.

    Raises:
        ValueError: a load is not positive.
    """
    if min((*loads, 1.0)) <= 0:
        raise ValueError("loads must be positive")
    return [
        Plan("offered", *pair, WORK, False, load, LIMIT)
        for pair, load in itertools.product(PAIRS, loads)
    ]


heading = ["", "load", "sent", "answered", "goodput", "waste", "median ms", "99 % ms"]


def row(cell: Cell) -> list[str]:
    """Return the cell as a row of the table."""
    times = ["" if time is None else brief(time) for time in (cell.median, cell.p99)]
    return [
        _label(cell),
        f"{cell.load:g}",
        f"{cell.sent:,}",
        f"{cell.answered:,}",
        f"{cell.goodput:.2f}",
        f"{cell.waste:.0%}",
        *times,
    ]


def goals(cells: Sequence[Cell]) -> list[Goal]:
    """Compare the cells with the goal of the documentation."""
    reached = [
        cell.goodput for cell in cells if cell.load == 2 and cell.server == "rosasync-status"
    ]
    found = min(reached, default=None)
    return [check("with status, at twice the load: goodput", found, ">=", TARGET)]


def section(trials: Trials, picture: str) -> str:
    """Return the section of the documentation's page."""
    cells = [Cell(**found) for found in trials.rows]
    return "\n".join(
        (
            f"![goodput over the offered load, with and without status]({picture})\n",
            f"`python -m benchmarks goodput`. {trials.conditions} "
            f"{trials.settings['seconds']:g} s for each row, one run. One client process calls at "
            f"random times. The server works on one request at a time, for {WORK:g} ms. The load "
            "is a share of what the same server does with eight callers. Goodput: the answers in "
            "time, of what the server could do. Waste: the requests that it served for callers "
            "that had left.\n",
            markdown_table(GOALS, [goal.row() for goal in goals(cells)]),
            markdown_table(heading, [row(cell) for cell in cells]),
        )
    )


def draw(trials: Trials) -> Figure:
    """Draw the goodput over the offered load."""
    cells = [Cell(**found) for found in trials.rows]
    figure = Figure(figsize=(8, 4.2), layout="tight")
    axes = figure.subplots()
    plot(axes, cells, _label)
    axes.set_title(f"{WORK:g} ms of work, callers that give up after {LIMIT} s", fontsize=10)
    axes.legend(fontsize=8)
    return figure


def _label(cell: Cell) -> str:
    return PAIRS[cell.client, cell.server]
