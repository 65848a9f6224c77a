"""Several client processes on one stock server: how many calls are lost, and who is served."""

from __future__ import annotations

import dataclasses
import itertools
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.contestants import CONTESTANTS
from benchmarks.figures import brief
from benchmarks.pages import markdown_table
from benchmarks.trials import GOALS, Goal, Trials, check
from benchmarks.work import Work
from tests.support.child import ROOT, Child
from tests.support.flood import CALLERS as FLOODERS
from tests.support.flood import flooding

__all__ = [
    "Cell",
    "Plan",
    "draw",
    "goals",
    "heading",
    "jain",
    "measure",
    "older",
    "plans",
    "row",
    "section",
    "spread",
]

COMMAND = "sharing"
USUAL = "direct,direct-retry,semaphore,call,afor-qos"
BEFORE = "before"
"""The name of the contestant that is rosasync from another checkout."""
STOCK_DEPTH = 10
LEAD = 0.5
"""Seconds from the last match to the common start."""
PATIENCE = 15.0
NEVER = 1 << 30


@dataclass(frozen=True)
class Plan:
    """One cell to measure.

    Attributes:
        work: ms for which the server's callback runs.
        flooded: whether a stock process floods the server meanwhile.
    """

    contestant: str
    processes: int
    work: float
    flooded: bool = False


@dataclass(frozen=True)
class Cell:
    """What the processes of one plan measured together.

    Attributes:
        answers: the number of answered calls of each process.
        lost: calls without an answer within their deadline.
        failed: calls that ended with another error; `problem` is the first one.
        median: of the latencies in ms, as is `p99`.
    """

    contestant: str
    processes: int
    work: float
    flooded: bool
    seconds: float
    answers: Sequence[int]
    lost: int
    failed: int
    median: float | None
    p99: float | None
    problem: str = ""

    @property
    def total(self) -> int:
        return sum(self.answers)

    @property
    def missed(self) -> int:
        return self.lost + self.failed

    @property
    def share_lost(self) -> float:
        """In percent of all calls."""
        calls = self.total + self.missed
        return 100 * self.missed / calls if calls else 0.0

    @property
    def rate(self) -> float:
        return self.total / self.seconds

    @property
    def place(self) -> tuple[int, float, bool]:
        """What the cells of different contestants have in common."""
        return self.processes, self.work, self.flooded


def jain(answers: Sequence[int]) -> float:
    """Return Jain's index of fairness: 1 if all have the same, 1/n if one has everything."""
    squares = sum(n * n for n in answers)
    return sum(answers) ** 2 / (len(answers) * squares) if squares else 0.0


def plans(
    contestants: Sequence[str],
    processes: Sequence[int],
    work: Sequence[float],
    mixed: bool,
    before: Path | None = None,
) -> list[Plan]:
    """Return the cells to measure, by contestant; `mixed` adds two processes beside a flooder.

    Raises:
        ValueError: a contestant that does not exist, or not without `before`, or a number that is
            too small.
    """
    if unknown := set(contestants) - {*CONTESTANTS, BEFORE}:
        raise ValueError(f"no contestant {', '.join(sorted(unknown))}")
    if BEFORE in contestants and before is None:
        raise ValueError(f"{BEFORE!r} needs --before")
    if min(processes, default=0) < 1 or min(work, default=-1) < 0:
        raise ValueError("there must be one client process at least, and no negative work")
    found = []
    for contestant in contestants:
        found += [Plan(contestant, n, ms) for ms in work for n in processes]
        if mixed and contestant in ("direct", "direct-retry", BEFORE):
            found.append(Plan(contestant, 2, 1.0, flooded=True))
    return found


@contextmanager
def older(checkout: Path | None) -> Iterator[dict[str, str]]:
    """Yield the environment in which a child imports rosasync from another checkout."""
    if checkout is None:
        yield {}
        return
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rosasync").symlink_to((checkout / "rosasync").resolve())
        yield {"PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join((folder, str(ROOT)))}


def measure(
    chosen: Sequence[Plan],
    callers: int,
    seconds: float,
    before: Path | None = None,
    on_cell: Callable[[Cell], object] = lambda cell: None,
) -> list[Cell]:
    """Measure the cells one after the other; the processes of a contestant are used again."""
    cells = []
    numbers = itertools.count(1)
    with older(before) as environment, Child("benchmarks.server", quiet=True) as server:
        for contestant, group in itertools.groupby(chosen, key=lambda plan: plan.contestant):
            todo = list(group)
            most = max(plan.processes for plan in todo)
            key, variables = ("direct", environment) if contestant == BEFORE else (contestant, {})
            with ExitStack() as stack:
                crew = _crew(stack, key, most, variables)
                for plan in todo:
                    name = f"/bench/sharing_{next(numbers)}"
                    cell = _measure(plan, server, crew[: plan.processes], name, callers, seconds)
                    cells.append(cell)
                    on_cell(cell)
    return cells


def _crew(stack: ExitStack, key: str, size: int, environment: Mapping[str, str]) -> list[Child]:
    return [
        stack.enter_context(Child("benchmarks.worker", key, environment=environment, quiet=True))
        for _ in range(size)
    ]


def _measure(
    plan: Plan, server: Child, crew: Sequence[Child], name: str, callers: int, seconds: float
) -> Cell:
    work = Work(handling=plan.work / 1000, srv_name=name)
    server.ask_now("serve", work=work.to_json())
    with ThreadPoolExecutor(len(crew)) as pool, ExitStack() as stack:

        def ask(do: str, **message: Any) -> list[Any]:
            return list(pool.map(lambda child: child.ask_now(do, **message), crew))

        ask("setup", work=work.to_json())
        if plan.flooded:
            stack.enter_context(flooding(work.names[0], work.srv_type, quiet=True))
        begin = time.monotonic() + LEAD
        wanted = {"callers": callers, "calls": NEVER, "seconds": seconds, "begin": begin}
        tallies = ask("call", patience=LEAD + seconds + PATIENCE, **wanted)
        stack.close()
        ask("close")
    server.ask_now("end")
    return _cell(plan, seconds, tallies)


def _cell(plan: Plan, seconds: float, tallies: Sequence[Mapping[str, Any]]) -> Cell:
    samples = [ns / 1e6 for tally in tallies for ns in tally["samples"]]
    median, p99 = np.percentile(samples, (50, 99)) if samples else (None, None)
    return Cell(
        **dataclasses.asdict(plan),
        seconds=seconds,
        answers=[len(tally["samples"]) for tally in tallies],
        lost=sum(tally["lost"] for tally in tallies),
        failed=sum(tally["failed"] for tally in tallies),
        median=None if median is None else float(median),
        p99=None if p99 is None else float(p99),
        problem=next((tally["problem"] for tally in tallies if tally["problem"]), ""),
    )


# Tables and goals.

heading = [
    *("", "clients", "work ms", "lost", "lost %", "answers/s", "least served", "Jain"),
    *("median ms", "99 % ms", "remarks"),
]


def row(cell: Cell) -> list[str]:
    """Return the cell as a row of the table."""
    clients = f"{cell.processes}{' and a flooder' if cell.flooded else ''}"
    times = ["" if time is None else brief(time) for time in (cell.median, cell.p99)]
    failures = f"failed {cell.failed:,}: {cell.problem}" if cell.failed else ""
    return [
        label(cell.contestant),
        clients,
        f"{cell.work:g}",
        f"{cell.missed:,}",
        brief(cell.share_lost),
        brief(cell.rate),
        f"{min(cell.answers):,}",
        f"{jain(cell.answers):.2f}",
        *times,
        failures,
    ]


def label(contestant: str) -> str:
    return {
        "direct": "rosasync",
        "direct-retry": "rosasync, Retry",
        "semaphore": "call_async, semaphore of ten",
        "call": "client.call, 16 threads",
        "afor-qos": "asyncio-for-robotics",
        BEFORE: "rosasync before",
    }.get(contestant, contestant)


def goals(cells: Sequence[Cell]) -> list[Goal]:
    """Compare the cells with the goals of the documentation."""
    own = [cell for cell in cells if not cell.flooded]
    plain = [cell for cell in own if cell.contestant == "direct"]
    few = [cell for cell in plain if cell.processes <= STOCK_DEPTH]
    many = {cell.contestant: cell for cell in own if (cell.processes, cell.work) == (16, 1.0)}
    beside = {cell.contestant: cell for cell in cells if cell.flooded}
    return [
        check("calls lost, up to ten processes", _sum(cell.missed for cell in few), "<=", 0),
        check(
            "Jain's index, up to ten processes, lowest",
            _least(jain(cell.answers) for cell in few if cell.processes > 1),
            ">=",
            0.95,
        ),
        check(
            "answers/s in all, up to ten processes / the best that loses none, lowest",
            _least(_to_best(cell, own) for cell in few),
            ">=",
            0.95,
        ),
        check("one process, answers/s / before, lowest", _to_before(own), ">=", 0.95),
        check("calls lost with Retry, 16 processes, 1 ms", _missed(many, "direct-retry"), "<=", 0),
        check(
            "calls lost with Retry, two processes beside a flooder",
            _missed(beside, "direct-retry"),
            "<=",
            0,
        ),
    ]


def _missed(cells: Mapping[str, Cell], contestant: str) -> float | None:
    return cells[contestant].missed if contestant in cells else None


def _to_best(cell: Cell, cells: Iterable[Cell]) -> float:
    """Return the rate of a cell, divided by the best at its place that loses none."""
    rivals = [c for c in cells if c.place == cell.place and c.contestant != BEFORE]
    safe = [c.rate for c in rivals if not c.missed]
    return cell.rate / max(safe) if safe else 1.0


def _to_before(cells: Sequence[Cell]) -> float | None:
    before = {c.place: c.rate for c in cells if c.contestant == BEFORE and c.processes == 1}
    return _least(
        cell.rate / before[cell.place]
        for cell in cells
        if cell.contestant == "direct" and before.get(cell.place)
    )


def _sum(values: Iterable[float]) -> float | None:
    found = list(values)
    return sum(found) if found else None


def _least(values: Iterable[float]) -> float | None:
    return min(values, default=None)


def section(trials: Trials, picture: str) -> str:
    """Return the section of the documentation's page."""
    cells = [Cell(**found) for found in trials.rows]
    cells.sort(key=lambda cell: (cell.flooded, cell.work, cell.processes))
    return "\n".join(
        (
            "## Several processes on one server\n",
            f"`python -m benchmarks sharing`. {_sentence(trials, cells)}\n",
            f"{trials.conditions}\n",
            markdown_table(GOALS, [goal.row() for goal in goals(cells)]),
            markdown_table(heading, [row(cell) for cell in cells]),
            f"![several processes on one server]({picture})\n",
        )
    )


def _sentence(trials: Trials, cells: Sequence[Cell]) -> str:
    settings = trials.settings
    seconds = " or ".join(f"{s:g}" for s in sorted({cell.seconds for cell in cells}))
    return (
        "A stock server of depth 10, whose callback sleeps for the given work; "
        f"{settings['callers']} callers in each client process, which all begin at one moment, "
        f"after the last one is matched; {seconds} s for each cell, one run. A call "
        "is lost if it has no answer within 2 s. Jain's index is computed over the processes' "
        f"answers: 1 is fair. The flooder keeps {FLOODERS} requests outstanding."
    )


# The plot.

PANELS: Sequence[tuple[str, Callable[[Cell], float]]] = (
    ("calls lost in %", lambda cell: cell.share_lost),
    ("Jain's index of the answers", lambda cell: jain(cell.answers)),
    ("answers/s of the least-served process", lambda cell: min(cell.answers) / cell.seconds),
)
GAP = 0.06
"""Least distance of two labels, as a share of the axis."""


def draw(trials: Trials, work: float = 1.0) -> Figure:
    """Draw the cells with `work` over the number of processes, labelled at the lines' ends."""
    cells = [Cell(**found) for found in trials.rows]
    cells = [cell for cell in cells if cell.work == work and not cell.flooded]
    cells = [cell for cell in cells if cell.contestant != BEFORE]
    cells.sort(key=lambda cell: cell.processes)
    figure = Figure(figsize=(16, 4.2), layout="tight")
    for axes, (title, of) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        _panel(axes, title, of, cells)
    figure.suptitle(f"Client processes on one stock server, {work:g} ms of work")
    return figure


def _panel(axes: Axes, title: str, of: Callable[[Cell], float], cells: Sequence[Cell]) -> None:
    ends = {}
    for i, contestant in enumerate(dict.fromkeys(cell.contestant for cell in cells)):
        line = [cell for cell in cells if cell.contestant == contestant]
        values = [of(cell) for cell in line]
        axes.plot([cell.processes for cell in line], values, "o-", color=f"C{i}", markersize=4)
        ends[contestant] = (values[-1], line[-1].processes, f"C{i}")
    axes.set_xscale("log", base=2)
    counts = sorted({cell.processes for cell in cells})
    axes.set_xticks(counts, [str(count) for count in counts])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_xlabel("client processes")
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    top = axes.get_ylim()[1]
    places = spread([value / top for value, _, _ in ends.values()], GAP)
    for (contestant, (_, last, color)), place in zip(ends.items(), places, strict=True):
        at = (last * 1.15, place * top)
        axes.annotate(
            label(contestant), at, color=color, fontsize=8, va="center", annotation_clip=False
        )


def spread(values: Sequence[float], gap: float) -> list[float]:
    """Return values in the same order that are at least `gap` apart, and close to the given."""
    order = sorted(range(len(values)), key=values.__getitem__)
    places = [values[i] for i in order]
    for i in range(1, len(places)):
        places[i] = max(places[i], places[i - 1] + gap)
    excess = statistics.fmean(places) - statistics.fmean(values) if values else 0.0
    excess = min(excess, places[0]) if places else 0.0
    found = dict(zip(order, (place - excess for place in places), strict=True))
    return [found[i] for i in range(len(values))]
