"""More calls than a server can answer: how many are answered while their callers still wait."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.callers import KINDS
from benchmarks.figures import brief
from benchmarks.pages import markdown_table
from benchmarks.trials import GOALS, Goal, Trials, check
from benchmarks.work import Work
from tests.support.child import Child

__all__ = [
    "Cell",
    "Plan",
    "draw",
    "goals",
    "heading",
    "measure",
    "plans",
    "plot",
    "row",
    "section",
    "summarize",
]

COMMAND = "overload"
SERVERS = {
    "stock": "stock",
    "rosasync": "rosasync-plain",
    "rosasync-async": "rosasync-one",
    "rosasync-status": "rosasync-status",
}
"""The servers, by their keys in `Work.server`. Each works on one request at a time."""
TIMEOUTS: dict[str, Sequence[float | None]] = {
    "0.1": (0.1,),
    "0.5": (0.5,),
    "1": (1.0,),
    "2": (2.0,),
    "mixed": (0.1, 0.5, 2.0),
    "none": (None,),
}
CALIBRATION = 2.0
"""Seconds for which the capacity of a server is measured."""
KEPT = 8
"""Callers that are kept busy meanwhile: fewer than a stock server queues."""
LEAD = 0.5
"""Seconds from the last match to the common start."""
PATIENCE = 20.0
FLOOD = 500
"""Callers of the flood beside a polite caller."""
POLITE_RATE, POLITE_TIMEOUT = 5.0, 1.0
OVERLOAD, ORDINARY = 4.0, 0.8
"""The loads before and after the end of an overload."""
RECOVERY = 1.0
"""Seconds of ordinary load that count then."""


@dataclass(frozen=True)
class Plan:
    """One cell to measure.

    Attributes:
        kind: ``offered``, callers at random times; ``kept``, callers that call again after each
            answer or timeout; ``polite``, one caller beside a flood of another process;
            ``recovery``, the first second after an overload.
        work: ms for which the server works on a request.
        load: of what the server can do, that is offered; the number of callers of ``kept``.
        timeouts: a key of `TIMEOUTS`.
    """

    kind: str
    client: str
    server: str
    work: float
    exponential: bool
    load: float
    timeouts: str
    processes: int = 1


@dataclass(frozen=True)
class Cell:
    """What one plan measured.

    Attributes:
        capacity: requests per second that this server can do.
        sent: the number of calls.
        answered: those that were answered in time.
        within: those of them that were answered while calls were offered.
        served: requests that the server finished while calls were offered.
        median: of the latencies of the answered in ms, as is `p99`.
        outcomes: how the calls ended.
    """

    kind: str
    client: str
    server: str
    work: float
    exponential: bool
    load: float
    timeouts: str
    processes: int
    seconds: float
    capacity: float
    sent: int
    answered: int
    within: int
    served: int
    median: float | None = None
    p99: float | None = None
    outcomes: Mapping[str, int] = field(default_factory=dict)

    @property
    def goodput(self) -> float:
        """The answers in time while calls were offered, of what the server could have answered."""
        return self.within / (self.capacity * self.seconds)

    @property
    def wanted(self) -> float:
        """The calls that were answered in time, of those that could have been."""
        if self.sent < self.capacity * self.seconds:
            return self.answered / max(1, self.sent)
        return self.goodput

    @property
    def waste(self) -> float:
        """Requests that were served for callers that had left, of all that were served."""
        return max(0, self.served - self.within) / max(1, self.served)


def plans(
    clients: Sequence[str],
    servers: Sequence[str],
    loads: Sequence[float],
    works: Sequence[float],
    spread: Sequence[str],
    timeouts: Sequence[str],
    processes: Sequence[int],
    kept: Sequence[int],
    polite: bool,
    recovery: bool,
) -> list[Plan]:
    """Return the cells to measure, by server.

    Raises:
        ValueError: something that does not exist, or a number that is too small.
    """
    for what, given, known in (
        ("client", clients, KINDS),
        ("server", servers, SERVERS),
        ("timeout", timeouts, TIMEOUTS),
        ("spread", spread, ("constant", "exponential")),
    ):
        if unknown := set(given) - set(known):
            raise ValueError(f"no {what} {', '.join(sorted(unknown))}: one of {', '.join(known)}")
    if min((*loads, *works, *processes, *kept, 1.0)) <= 0:
        raise ValueError("loads, work, processes and callers must be positive")
    found = []
    for server, work, shape in itertools.product(servers, works, spread):
        exponential = shape == "exponential"
        pairs = [(client, server, work, exponential) for client in clients]
        for count, timeout, pair in itertools.product(processes, timeouts, pairs):
            found += [Plan("offered", *pair, load, timeout, count) for load in loads]
        for pair in pairs:
            finite = [timeout for timeout in timeouts if timeout in ("0.1", "0.5", "2")]
            found += [Plan("kept", *pair, n, timeout) for n in kept for timeout in finite]
            if recovery:
                found.append(Plan("recovery", *pair, OVERLOAD, timeouts[0]))
        if polite:
            found.append(Plan("polite", "stock", server, work, exponential, FLOOD, "2"))
    return found


def measure(
    chosen: Sequence[Plan], seconds: float, on_cell: Callable[[Cell], object] = lambda cell: None
) -> list[Cell]:
    """Measure the cells one after the other; the client processes are used again."""
    cells = []
    capacities: dict[tuple[str, float, bool], float] = {}
    numbers = itertools.count(1)
    with Child("benchmarks.server", quiet=True) as server, ExitStack() as stack:
        crew = _Crew(stack)
        for plan in chosen:
            key = plan.server, plan.work, plan.exponential
            if key not in capacities:
                name = f"/bench/capacity_{next(numbers)}"
                capacities[key] = _calibrate(plan, server, crew, name)
            name = f"/bench/overload_{next(numbers)}"
            with _served(plan, server, name) as work:
                cell = _measure(plan, server, crew, work, capacities[key], seconds)
            cells.append(cell)
            on_cell(cell)
    return cells


class _Crew:
    """Client processes, which are started when they are needed first."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._children: dict[tuple[str, int], Child] = {}

    @contextmanager
    def ready(self, kind: str, number: int, work: Mapping[str, Any]) -> Iterator[Child]:
        """Yield a process of this kind, with a client for this work."""
        child = self._children.get((kind, number))
        if child is None:
            child = self._stack.enter_context(Child("benchmarks.callers", kind, quiet=True))
            self._children[kind, number] = child
        child.ask_now("setup", work=work)
        yield child
        child.ask_now("close")


@contextmanager
def _served(plan: Plan, server: Child, name: str) -> Iterator[dict[str, Any]]:
    work = Work(
        handling=plan.work / 1000,
        exponential=plan.exponential,
        server=SERVERS[plan.server],
        srv_name=name,
    ).to_json()
    server.ask_now("serve", work=work)
    try:
        yield work
    finally:
        # A rosasync server finishes what waits, for a few seconds.
        server.ask_now("end")


def _calibrate(plan: Plan, server: Child, crew: _Crew, name: str) -> float:
    """Return how many requests per second a server can do, with few callers that wait."""
    with _served(plan, server, name) as work, crew.ready("stock", 0, work) as caller:
        run = {"callers": KEPT, "seconds": CALIBRATION, "limit": 10.0}
        begin = time.monotonic() + LEAD
        found = caller.ask_now("keep", begin=begin, **run)
        return _answered(found["calls"], CALIBRATION) / CALIBRATION


def _measure(
    plan: Plan,
    server: Child,
    crew: _Crew,
    work: Mapping[str, Any],
    capacity: float,
    seconds: float,
) -> Cell:
    with ExitStack() as stack:

        def ready(kind: str, number: int) -> Child:
            return stack.enter_context(crew.ready(kind, number, work))

        children = [ready(plan.client, number) for number in range(plan.processes)]
        flood = ready("stock", plan.processes) if plan.kind == "polite" else None
        pool = stack.enter_context(ThreadPoolExecutor(len(children) + 1))
        begin = time.monotonic() + LEAD
        patience = LEAD + 2 * seconds + PATIENCE
        if flood is not None:
            kept = {"callers": FLOOD, "seconds": seconds + LEAD, "limit": 2.0, "begin": begin}
            flooding = pool.submit(flood.ask_now, "keep", patience=patience, **kept)
            begin += LEAD
        messages = [
            _message(plan, capacity, seconds, begin, seed) for seed in range(plan.processes)
        ]
        asked = [
            pool.submit(child.ask_now, message.pop("do"), patience=patience, **message)
            for child, message in zip(children, messages, strict=True)
        ]
        found = [future.result() for future in asked]
        if flood is not None:
            flooding.result()
        start, end = _interval(plan, seconds)
        served = server.ask_now("handled", begin=begin + start, end=begin + end)
    return summarize(plan, capacity, seconds, served, found)


def _interval(plan: Plan, seconds: float) -> tuple[float, float]:
    """Return the seconds after the start between which calls and answers are counted."""
    return (seconds, seconds + RECOVERY) if plan.kind == "recovery" else (0.0, seconds)


def _answered(calls: Iterable[tuple[float, float | None]], end: float) -> int:
    """Return how many calls were answered by a time. What follows is not of the load's seconds."""
    return sum(took is not None and began + took <= end for began, took in calls)


def _message(
    plan: Plan, capacity: float, seconds: float, begin: float, seed: int
) -> dict[str, Any]:
    if plan.kind == "kept":
        limit = TIMEOUTS[plan.timeouts][0]
        callers = round(plan.load / plan.processes)
        return {
            "do": "keep",
            "callers": callers,
            "seconds": seconds,
            "limit": limit,
            "begin": begin,
        }
    rate = capacity * plan.load / plan.processes
    phases = {
        "offered": [(rate, seconds)],
        "polite": [(POLITE_RATE, seconds)],
        "recovery": [(rate, seconds), (ORDINARY * capacity / plan.processes, RECOVERY)],
    }[plan.kind]
    timeouts = [POLITE_TIMEOUT] if plan.kind == "polite" else list(TIMEOUTS[plan.timeouts])
    return {"do": "offer", "phases": phases, "timeouts": timeouts, "seed": seed, "begin": begin}


def summarize(
    plan: Plan, capacity: float, seconds: float, served: int, found: Sequence[Mapping[str, Any]]
) -> Cell:
    """Return the cell of a plan from what its client processes have logged."""
    calls = [call for each in found for call in each["calls"]]
    start, end = _interval(plan, seconds)
    calls = [(began, took) for began, took in calls if began >= start]
    samples = [took * 1000 for _, took in calls if took is not None]
    median, p99 = np.percentile(samples, (50, 99)) if samples else (None, None)
    return Cell(
        **dataclasses.asdict(plan),
        seconds=end - start,
        capacity=capacity,
        sent=len(calls),
        answered=len(samples),
        within=_answered(calls, end),
        served=served,
        median=None if median is None else float(median),
        p99=None if p99 is None else float(p99),
        outcomes=dict(sum((Counter(each["outcomes"]) for each in found), Counter())),
    )


# Tables and goals.

heading = [
    *("", "load", "timeout s", "work ms", "processes", "sent", "answered", "goodput"),
    *("of those possible", "waste", "median ms", "99 % ms", "outcomes"),
]


def row(cell: Cell) -> list[str]:
    """Return the cell as a row of the table."""
    load = {
        "offered": f"{cell.load:g}",
        "kept": f"{cell.load:g} callers",
        "polite": f"beside {FLOOD} callers",
        "recovery": f"{ORDINARY:g} after {OVERLOAD:g}",
    }[cell.kind]
    times = ["" if time is None else brief(time) for time in (cell.median, cell.p99)]
    shares = cell.kind in ("offered", "kept")
    return [
        label(cell),
        load,
        cell.timeouts if cell.kind != "polite" else f"{POLITE_TIMEOUT:g}",
        f"{cell.work:g}{' exp.' if cell.exponential else ''}",
        str(cell.processes),
        f"{cell.sent:,}",
        f"{cell.answered:,}",
        f"{cell.goodput:.2f}" if shares else "",
        f"{cell.wanted if shares else cell.answered / max(1, cell.sent):.2f}",
        f"{cell.waste:.0%}" if shares else "",
        *times,
        ", ".join(f"{name} {count:,}" for name, count in sorted(cell.outcomes.items())),
    ]


def label(cell: Cell) -> str:
    client = {"stock": "stock", "rosasync": "rosasync", "afor": "asyncio-for-robotics"}[cell.client]
    if cell.client == "stock" and cell.kind == "kept":
        client = "client.call"
    return f"{client} → {cell.server}"


def goals(cells: Sequence[Cell]) -> list[Goal]:
    """Compare the cells with the goals of the documentation."""
    loaded = [cell for cell in cells if cell.kind in ("offered", "kept") and cell.load >= 1.5]
    own = [cell for cell in loaded if cell.client == cell.server == "rosasync"]
    to_stock = [c for c in loaded if (c.client, c.server) == ("rosasync", "stock")]
    light = [c for c in cells if c.kind == "offered" and c.load <= 0.9 and c.server != "stock"]
    polite = [c for c in cells if c.kind == "polite" and c.server != "stock"]
    recovery = [c for c in cells if c.kind == "recovery" and "rosasync" in (c.client, c.server)]
    return [
        check(
            "rosasync → stock, overloaded: goodput", _least(c.wanted for c in to_stock), ">=", 0.95
        ),
        check("rosasync → stock, overloaded: waste", _most(c.waste for c in to_stock), "<=", 0.05),
        check(
            "stock → rosasync, overloaded: answers/s / a stock server's", _ratio(loaded), ">=", 1.0
        ),
        check(
            "rosasync → rosasync, overloaded: goodput", _least(c.wanted for c in own), ">=", 0.97
        ),
        check(
            "a polite caller beside a flood: answered",
            _least(c.answered / max(1, c.sent) for c in polite),
            ">=",
            1.0,
        ),
        check(
            "a polite caller beside a flood: median / work",
            _most((c.median or np.inf) / c.work for c in polite),
            "<=",
            4.0,
        ),
        check(
            "rosasync servers, up to 0.9 of the load: answered",
            _least(c.answered / max(1, c.sent) for c in light),
            ">=",
            1.0,
        ),
        check(
            "the first second after an overload: answered",
            _least(c.answered / max(1, c.sent) for c in recovery),
            ">=",
            0.95,
        ),
    ]


def _ratio(cells: Iterable[Cell]) -> float | None:
    """Return the fewest answers/s of stock clients from our server, divided by a stock server's.

    Not the goodput, because the capacities were measured at other times.
    """
    by_place: dict[tuple[Any, ...], dict[str, float]] = {}
    for cell in cells:
        if cell.client == "stock":
            place = (
                cell.kind,
                cell.work,
                cell.exponential,
                cell.load,
                cell.timeouts,
                cell.processes,
            )
            by_place.setdefault(place, {})[cell.server] = cell.answered / cell.seconds
    return _least(
        rate / found["stock"]
        for found in by_place.values()
        for server, rate in found.items()
        if server != "stock" and found.get("stock")
    )


def _least(values: Iterable[float]) -> float | None:
    return min(values, default=None)


def _most(values: Iterable[float]) -> float | None:
    return max(values, default=None)


def section(trials: Trials, picture: str) -> str:
    """Return the section of the documentation's page."""
    cells = [Cell(**found) for found in trials.rows]
    return "\n".join(
        (
            f"![goodput over the offered load]({picture})\n",
            f"`python -m benchmarks overload`. {trials.conditions} "
            f"{trials.settings['seconds']:g} s for each row, one run. The load is a share of what "
            "the same server does with eight callers. Goodput: the answers in time, of what the "
            "server could do. Waste: the requests that it served for callers that had left. Both "
            "count what happened while calls were offered; the number answered is that of all.\n",
            markdown_table(GOALS, [goal.row() for goal in goals(cells)]),
            markdown_table(heading[:-1], [row(cell)[:-1] for cell in cells]),
        )
    )


def draw(trials: Trials) -> Figure:
    """Draw the goodput over the offered load, for the first work and timeouts of the run."""
    cells = [Cell(**found) for found in trials.rows]
    cells = [cell for cell in cells if cell.kind == "offered"]
    figure = Figure(figsize=(9, 4.2), layout="tight")
    axes = figure.subplots()
    if cells:
        first = cells[0]
        place = (first.work, first.exponential, first.timeouts, first.processes)
        cells = [c for c in cells if (c.work, c.exponential, c.timeouts, c.processes) == place]
        axes.set_title(
            f"{first.work:g} ms of work, timeout {first.timeouts} s, "
            f"{first.processes} client process{'es' if first.processes > 1 else ''}",
            fontsize=10,
        )
    plot(axes, cells, label)
    if cells:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def plot(axes: Axes, cells: Sequence[Cell], label_of: Callable[[Cell], str]) -> None:
    """Plot the goodput over the offered load, with a line for each label."""
    for name in dict.fromkeys(map(label_of, cells)):
        line = sorted((cell for cell in cells if label_of(cell) == name), key=lambda c: c.load)
        axes.plot([cell.load for cell in line], [cell.goodput for cell in line], "o-", label=name)
    loads = sorted({cell.load for cell in cells})
    axes.set_xscale("log")
    axes.set_xticks(loads, [f"{load:g}" for load in loads])
    axes.minorticks_off()
    axes.set_xlabel("calls offered / what the server can do")
    axes.set_ylabel("answered in time / what the server can do")
    axes.set_ylim(0.0, 1.1)
    axes.grid(alpha=0.3)
