"""Percentiles and histograms of latencies, for `bench` and `demo`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["histogram", "percentile"]

BINS = 12


def percentile(ordered: list[float], percent: int) -> float | None:
    """Return a percentile of sorted values, None if there are none."""
    if not ordered:
        return None
    return ordered[max(0, math.ceil(percent / 100 * len(ordered)) - 1)]


def histogram(columns: Mapping[str, list[float]], width: int) -> Table:
    """Return a histogram with a column of counts and bars for each set of latencies.

    The bins are logarithmic, from the shortest latency of all to the 99th percentile of all. The
    last bin has no upper edge.

    Args:
        columns: seconds, by the heading of their column.
        width: characters for the bars of a column.
    """
    from rich.bar import Bar
    from rich.table import Table

    edges = _edges(sorted(seconds for column in columns.values() for seconds in column))
    ends = [*edges[1:], math.inf]
    counts = [
        [sum(low <= s < high for s in column) for low, high in zip(edges, ends, strict=True)]
        for column in columns.values()
    ]
    # Each column is scaled by its own number of calls, which differs if the time ran out.
    shares = [
        [count / len(column) for count in of]
        for of, column in zip(counts, columns.values(), strict=True)
    ]
    longest = max(map(max, shares))
    table = Table(box=None, show_header=any(columns))
    table.add_column(justify="right")
    for heading in columns:
        table.add_column(justify="right")
        table.add_column(heading, width=width)
    for row, edge in enumerate(edges):
        cells: list[str | Bar] = []
        for of, share in zip(counts, shares, strict=True):
            cells += [f"{of[row]}", Bar(longest, 0, share[row], width=width)]
        table.add_row(f"from {1e3 * edge:.3f} ms", *cells)
    return table


def _edges(ordered: list[float]) -> list[float]:
    low, high = ordered[0], percentile(ordered, 99) or ordered[0]
    return [low * (high / low) ** (n / BINS) for n in range(BINS)] if high > low else [low]
