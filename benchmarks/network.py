"""Calls across a network that loses packets: heartbeats and depth against loss and delay."""

from __future__ import annotations

import dataclasses
import itertools
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.lossy import LossyHosts
from benchmarks.machine import describe_machine
from benchmarks.pipes import Child, ChildError
from benchmarks.work import READY_TIMEOUT, Work
from rosasync._ros.profile import SWITCH, is_old, profile_text, profile_variable

__all__ = ["Cell", "NetworkResults", "chosen", "every", "measure_network", "write_network"]

CONTESTANTS = {"call": "stock", "direct": "rosasync"}
HEARTBEATS = (3.0, 0.1, 0.02, 0.005)
DEPTHS = (10, 100, 1000)
LOSSES = (0.0, 0.02, 0.05, 0.2)
DELAYS = (0.0, 0.02)
SIDES = ("both", "client", "server")
CALLERS, FLOODERS = 10, 8
SECONDS = 4.0
PATIENCE = 30.0


@dataclass(frozen=True)
class Cell:
    """One measurement.

    Attributes:
        heartbeat: seconds; 3, the default of Fast DDS, stands for no profile at all.
        side: which side has the profile.
        depth: of the client; the server is a stock one with its depth of 10.
        flood: whether another process floods the same server.
    """

    contestant: str
    heartbeat: float
    side: str
    depth: int
    loss: float
    delay: float
    flood: bool = False

    @property
    def key(self) -> str:
        return "/".join(str(value) for value in dataclasses.astuple(self))

    @property
    def processes(self) -> tuple[float, str]:
        """What the environment of the processes depends on."""
        return self.heartbeat, self.side


def every() -> list[Cell]:
    """Return all cells. Without a profile there is no side to choose."""
    return [
        Cell(contestant, heartbeat, side, depth, loss, delay, flood)
        for heartbeat, side, flood, delay, loss, depth, contestant in itertools.product(
            HEARTBEATS, SIDES, (False, True), DELAYS, LOSSES, DEPTHS, CONTESTANTS
        )
        if heartbeat != HEARTBEATS[0] or side == "both"
    ]


def chosen() -> list[Cell]:
    """Return a part of the cells: both sides without a flood, and the others at a few points."""
    return sorted((cell for cell in every() if _is_chosen(cell)), key=_rank)


def _rank(cell: Cell) -> tuple[bool, ...]:
    """Order the cells so that an interrupted run has the most telling ones."""
    return (
        cell.delay > 0,
        cell.heartbeat not in (3.0, 0.02),
        cell.loss == 0.05,
        cell.side == "server",
        cell.flood,
    )


def _is_chosen(cell: Cell) -> bool:
    if cell.side == "both" and not cell.flood:
        return True
    usual = cell.heartbeat in (3.0, 0.02) and not cell.delay
    if cell.flood:
        return usual and cell.side != "server" and cell.loss in (0.0, 0.02)
    return usual and cell.loss in (0.0, 0.02, 0.2)


class NetworkResults:
    """The figures of each measured cell, in a file that is written after each of them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.figures: dict[str, dict[str, float]] = {}
        self.machine: dict[str, Any] = {}
        with suppress(FileNotFoundError):
            data = json.loads(path.read_text())
            self.figures, self.machine = data["cells"], data["machine"]

    def add(self, cell: Cell, figures: dict[str, float]) -> None:
        self.figures[cell.key] = figures
        self.machine = self.machine or describe_machine()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        data = {"machine": self.machine, "seconds": SECONDS, "cells": self.figures}
        self.path.write_text(json.dumps(data, indent=1))

    def of(self, cell: Cell) -> dict[str, float] | None:
        """Return a cell's figures: None if it was not measured, empty if a process ended."""
        return self.figures.get(cell.key)


def measure_network(
    results: NetworkResults, cells: Iterable[Cell], minutes: float, show: Callable[[str], None]
) -> None:
    """Measure the cells that are missing, until the time is up.

    Raises:
        NoHosts: network namespaces cannot be made here.
    """
    end = time.monotonic() + 60 * minutes
    missing = [cell for cell in cells if results.of(cell) is None]
    with LossyHosts("server", "client", seed=1) as hosts:
        for (heartbeat, side), group in itertools.groupby(missing, lambda cell: cell.processes):
            if time.monotonic() > end:
                return
            with _Processes(hosts, heartbeat, side, show) as processes:
                for cell in group:
                    if time.monotonic() > end:
                        return
                    figures = processes.measure(cell)
                    results.add(cell, figures)
                    show(f"{cell.key}: {figures}")


class _Processes(ExitStack):
    """The server on one host, the contestants and the flood on the other one."""

    def __init__(
        self, hosts: LossyHosts, heartbeat: float, side: str, show: Callable[[str], None]
    ) -> None:
        super().__init__()
        self._show = show
        self._hosts = hosts
        self._turns = 0
        folder = Path(self.enter_context(tempfile.TemporaryDirectory()))
        file = folder / "profile.xml"
        file.write_text(profile_text(is_old(), heartbeat=heartbeat))
        # On its other side, the profile that rosasync ships is off too.
        plain = {**hosts.environment, SWITCH: "off"}
        with_profile = {**plain, profile_variable(is_old()): str(file)}
        used = heartbeat != HEARTBEATS[0]
        self._environments = {
            name: with_profile if used and side in (name, "both") else plain
            for name in ("client", "server")
        }
        self._children: dict[str, Child] = {}

    def measure(self, cell: Cell) -> dict[str, float]:
        self._turns += 1
        work = Work(srv_name=f"/network/turn_{self._turns}")
        try:
            return self._measure(cell, work)
        except ChildError as exc:
            for child in self._children.values():
                child.kill()
            self._children.clear()
            self._show(f"{cell.key}: {exc}")
            return {}
        finally:
            self._hosts.set(loss=0.0, delay=0.0)

    def _measure(self, cell: Cell, work: Work) -> dict[str, float]:
        server = self._child("server", "benchmarks.server")
        worker = self._child("client", "benchmarks.worker", cell.contestant)
        server.ask("serve", work=work.to_json(), timeout=READY_TIMEOUT)
        deep = dataclasses.replace(work, depth=cell.depth).to_json()
        worker.ask("setup", work=deep, timeout=READY_TIMEOUT)
        if cell.flood:
            flood = self._child("client", "benchmarks.flood")
            flood.ask("start", work=work.to_json(), callers=FLOODERS, timeout=READY_TIMEOUT)
        self._hosts.set(loss=cell.loss, delay=cell.delay)
        frames, used = self._hosts.counts(), server.ask("usage", timeout=PATIENCE)
        call = {"callers": CALLERS, "calls": 1 << 30, "seconds": SECONDS}
        found = worker.ask("call", timeout=PATIENCE, **call)
        after, server_used = self._hosts.counts(), server.ask("usage", timeout=PATIENCE)
        self._hosts.set(loss=0.0, delay=0.0)
        if cell.flood:
            flood.ask("stop", timeout=PATIENCE)
        worker.ask("close", timeout=PATIENCE)
        server.ask("end", timeout=PATIENCE)
        return {
            "answered": len(found["samples"]),
            "failed": found["lost"] + found["failed"],
            "median": _median(found["samples"]) / 1e3,
            "seconds": found["elapsed"] / 1e9,
            "client_cpu": found["client"]["cpu"] / 1e9,
            "server_cpu": (server_used["cpu"] - used["cpu"]) / 1e9,
            "packets": after["frames"] - frames["frames"],
        }

    def _child(self, host: str, module: str, *args: str) -> Child:
        key = " ".join((module, *args))
        if key not in self._children:
            child = Child(
                module, *args, prefix=self._hosts.on(host), environment=self._environments[host]
            )
            self.callback(child.kill)
            self._children[key] = child
        return self._children[key]


def write_network(results: NetworkResults, page: Path, plots: Path) -> None:
    """Write the table into the page, between its markers, and the plot."""
    text = page.read_text()
    begin, end = "<!-- network -->\n", "<!-- /network -->"
    before, rest = text.split(begin)
    _, after = rest.split(end)
    page.write_text(before + begin + "\n".join(_table(results)) + "\n" + end + after)
    _plot(results, plots)


def _table(results: NetworkResults) -> Iterator[str]:
    titles = ("heartbeat", "side", "depth", "delay", "flood")
    heads = [f"{name}, {loss:.0%}" for loss in LOSSES for name in CONTESTANTS.values()]
    yield "| " + " | ".join((*titles, *heads)) + " |"
    yield "|" + "---|" * (len(titles) + len(heads))
    rows = dict.fromkeys(
        (c.heartbeat, c.side, c.depth, c.delay, c.flood)
        for c in every()
        if results.of(c) is not None
    )
    for heartbeat, side, depth, delay, flood in rows:
        cells = (
            Cell(contestant, heartbeat, side, depth, loss, delay, flood)
            for loss in LOSSES
            for contestant in CONTESTANTS
        )
        label = f"{heartbeat * 1e3:g} ms", side if heartbeat < 3 else "", str(depth)
        where = f"{delay * 1e3:g} ms", "yes" if flood else ""
        yield "| " + " | ".join((*label, *where, *(_entry(results.of(c)) for c in cells))) + " |"


def _entry(figures: dict[str, float] | None) -> str:
    if figures is None:
        return ""
    if "answered" not in figures:
        return "ended"
    failed = f", {figures['failed']:,.0f} failed" if figures["failed"] else ""
    return f"{figures['answered'] / SECONDS:,.0f}/s{failed}"


def _plot(results: NetworkResults, folder: Path) -> None:
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot

    figure, rows = pyplot.subplots(
        len(DELAYS), len(CONTESTANTS), figsize=(9, 6), sharex=True, sharey="row", squeeze=False
    )
    colors = matplotlib.colormaps["viridis"]
    for axes, (delay, contestant) in zip(
        itertools.chain(*rows), itertools.product(DELAYS, CONTESTANTS), strict=True
    ):
        for i, (heartbeat, depth) in enumerate(itertools.product(HEARTBEATS, DEPTHS)):
            points = [
                (loss * 100, found["answered"] / SECONDS)
                for loss in LOSSES
                if (found := results.of(Cell(contestant, heartbeat, "both", depth, loss, delay)))
                and "answered" in found
            ]
            axes.plot(
                [p[0] for p in points],
                [max(p[1], 0.3) for p in points],
                ("-", "--", ":")[i % len(DEPTHS)],
                color=colors(i // len(DEPTHS) / len(HEARTBEATS)),
                marker=".",
                label=f"{heartbeat * 1e3:g} ms, depth {depth}",
            )
        axes.set_yscale("log")
        axes.set_title(f"{CONTESTANTS[contestant]}, {delay * 1e3:g} ms of delay", fontsize=9)
        axes.grid(alpha=0.3)
    for axes in rows[-1]:
        axes.set_xlabel("packets lost, %")
    for row in rows:
        row[0].set_ylabel("answers/s")
    rows[0][-1].legend(fontsize=6, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(folder / "network.svg", bbox_inches="tight")
    pyplot.close(figure)


def _median(samples: list[int]) -> float:
    return float(sorted(samples)[len(samples) // 2]) if samples else 0.0
