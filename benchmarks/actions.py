"""Goals of actions: rosasync's client and server, and rclpy's, in every combination."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

from benchmarks.action_server import RESULT_TIMEOUT, SLOWLY
from benchmarks.pages import markdown_table
from benchmarks.trials import Goal, Trials, check
from tests.support.child import Child

__all__ = ["COMMAND", "Figure", "goals", "heading", "measure", "row", "section", "total"]

COMMAND = "actions"
OURS, STOCK = "rosasync", "stock"
CLIENTS = SERVERS = (OURS, STOCK)
TIMEOUT = 600.0
OTHERS = 20

ONE, TEN, FIFTY = "goal to result, ms", "10 at once, goals/s", "50 at once, goals/s"
FEEDBACK, BESIDE = "feedback at 1 kHz, CPU %", f"beside {OTHERS} others' feedback, CPU %"
GROWTH = "memory from 1,000 to 10,000 goals, MB"
CALLS = "a call beside 1,000 goals / alone"
WHAT = (ONE, TEN, FIFTY, FEEDBACK, BESIDE, GROWTH, CALLS)


@dataclass(frozen=True)
class Figure:
    """One figure of one round.

    Attributes:
        what: which, with its unit.
        client: whose client, and `server` whose server.
        value: None if the goals did not end; `problem` says why.
        lost: feedback messages that did not come, of those that were published.
    """

    what: str
    client: str
    server: str
    value: float | None
    problem: str = ""
    lost: int = 0


def total(rounds: int) -> int:
    """Return how many figures `measure` finds."""
    # Once, of our client alone: the growth with each server, and the calls with ours.
    once = len(SERVERS) + 1
    return len(CLIENTS) * len(SERVERS) * rounds * (len(WHAT) - 2) + once


def measure(
    rounds: int, scale: float, on_figure: Callable[[Figure], object] = lambda figure: None
) -> list[Figure]:
    """Measure every combination, round by round.

    Args:
        rounds: how often; the medians count.
        scale: 1 for the numbers that the figures are named after; less for a trial.
        on_figure: called with each figure.
    """
    found: list[Figure] = []
    for number in range(rounds):
        for server in SERVERS:
            for client in CLIENTS:
                with (
                    _child("action_server", server) as peer,
                    _child("action_client", client) as child,
                ):
                    peer.ask_now("ready")
                    last = client == OURS and number == rounds - 1
                    for figure in _round(child, client, server, scale, last):
                        found.append(figure)
                        on_figure(figure)
    return found


def _round(child: Child, client: str, server: str, scale: float, last: bool) -> Iterator[Figure]:
    def ask(count: int, at_once: int, order: int = 0) -> dict[str, float]:
        count = max(at_once, round(count * scale))
        answer = child.ask_now("goals", patience=TIMEOUT, count=count, at_once=at_once, order=order)
        return {**answer, "count": float(count)}

    def one() -> float:
        answer = ask(300, 1)
        return 1000.0 * float(answer["seconds"]) / answer["count"]

    def several(at_once: int) -> float:
        answer = ask(1000, at_once)
        return float(answer["count"]) / answer["seconds"]

    def feedback() -> tuple[float, int]:
        order = round(5000 * scale)
        answer = child.ask_now("goals", patience=TIMEOUT, count=1, at_once=1, order=order)
        return 100 * answer["cpu"] / answer["seconds"], order - int(answer["received"])

    def beside() -> float:
        # The others have 100 messages a second each, this client's goal has the same.
        order = SLOWLY + round(500 * scale)
        with _child("action_client", OURS) as others:
            others.ask_now("goals", patience=TIMEOUT, count=1, at_once=1, order=0)
            with _asked(others, count=OTHERS, at_once=OTHERS, order=order + 100):
                answer = child.ask_now("goals", patience=TIMEOUT, count=1, at_once=1, order=order)
        share: float = 100 * answer["cpu"] / answer["seconds"]
        return share

    def growth() -> float:
        ask(1000, 10)
        before = child.ask_now("memory")
        ask(9000, 10)
        grown: float = (child.ask_now("memory") - before) / 1e6
        return grown

    def calls() -> float:
        count = round(1000 * scale)
        # The server still has to forget the goals of the rows before.
        time.sleep(RESULT_TIMEOUT + 2)
        ratio: float = child.ask_now("beside", patience=TIMEOUT, goals=count, calls=count)
        return ratio

    work: dict[str, Callable[[], float | tuple[float, int]]] = {
        ONE: one,
        TEN: lambda: several(10),
        FEEDBACK: feedback,
        BESIDE: beside,
    }
    if last:
        work[GROWTH] = growth
    if last and server == OURS:
        work[CALLS] = calls
    # Last, because rclpy's client may lose goals then, and can measure nothing more.
    work[FIFTY] = lambda: several(50)
    ask(50, 10)
    for what, measured in work.items():
        try:
            value = measured()
        except Exception as error:
            for left in list(work)[list(work).index(what) :]:
                yield Figure(left, client, server, None, str(error))
            return
        figure, lost = value if isinstance(value, tuple) else (value, 0)
        yield Figure(what, client, server, figure, lost=lost)


heading = ["", "client", "server", "", "feedback lost"]


def row(figure: Figure) -> list[str]:
    """Return the row of one figure."""
    value = figure.problem if figure.value is None else f"{figure.value:.3g}"
    lost = str(figure.lost) if figure.what == FEEDBACK else ""
    return [figure.what, figure.client, figure.server, value, lost]


def goals(figures: Sequence[Figure]) -> list[Goal]:
    """Compare the medians with the goals."""
    found = [
        _ratio(figures, ONE, OURS, "<=", 0.6),
        _ratio(figures, ONE, STOCK, "<=", 0.9),
        *(_ratio(figures, what, OURS, ">=", 3.0) for what in (TEN, FIFTY)),
        *(_ratio(figures, what, STOCK, ">=", 1.3) for what in (TEN, FIFTY)),
    ]
    for what in (TEN, FIFTY):
        ours, stock = (_median(figures, what, OURS, server) for server in SERVERS)
        ratio = ours / stock if ours and stock else None
        found.append(check(f"{what}: our server / rclpy's, our client", ratio, ">=", 1.5))
    for what in (FEEDBACK, BESIDE):
        found += [_ratio(figures, what, server, "<=", 0.5) for server in SERVERS]
    for server in SERVERS:
        growth = _median(figures, GROWTH, OURS, server)
        found.append(check(f"{GROWTH}, with the server of {server}", growth, "<=", 1.0))
    found.append(check(CALLS, _median(figures, CALLS, OURS, OURS), "<=", 1.1))
    return found


def section(trials: Trials) -> str:
    """Return the section of the documentation's page."""
    figures = [Figure(**found) for found in trials.rows]
    table = []
    for what in WHAT:
        for server in SERVERS:
            ours, stock = (_median(figures, what, client, server) for client in CLIENTS)
            ratio = f"{ours / stock:.2g}" if ours and stock else "-"
            # These two are measured for rosasync's client alone, and one with its server alone.
            theirs = "-" if what in (GROWTH, CALLS) else _text(stock)
            if what != CALLS or ours is not None:
                table.append([what, server, _text(ours), theirs, ratio])
    return "\n".join(
        (
            "## Actions\n",
            "`python -m benchmarks actions`. Goals of an action of another process: of rosasync's "
            "client, and of rclpy's `ActionClient` with its executor in a thread, with each "
            "server (rclpy's in a `MultiThreadedExecutor`). A goal does nothing, unless it is "
            "about feedback. Medians of the rounds.\n",
            f"{trials.conditions}\n",
            markdown_table(["", "server", "rosasync", "rclpy", "rosasync / rclpy"], table),
        )
    )


def _ratio(figures: Sequence[Figure], what: str, server: str, sense: str, bound: float) -> Goal:
    ours, stock = (_median(figures, what, client, server) for client in CLIENTS)
    ratio = ours / stock if ours is not None and stock else None
    return check(f"{what}: ours / rclpy's, server of {server}", ratio, sense, bound)


def _median(figures: Sequence[Figure], what: str, client: str, server: str) -> float | None:
    wanted = (what, client, server)
    values = [f.value for f in figures if (f.what, f.client, f.server) == wanted]
    measured = [value for value in values if value is not None]
    return statistics.median(measured) if measured else None


def _text(value: float | None) -> str:
    return "never ended" if value is None else f"{value:.3g}"


def _child(module: str, kind: str) -> Child:
    return Child(f"benchmarks.{module}", kind, quiet=True)


@contextmanager
def _asked(child: Child, **message: int) -> Iterator[None]:
    """Let a child work on a message while the block runs."""
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(lambda: child.ask_now("goals", patience=TIMEOUT, **message))
        yield
        future.result()
