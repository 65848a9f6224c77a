"""From the start of a process to its first answer."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from benchmarks.pages import markdown_table
from benchmarks.server import WorkServer
from benchmarks.trials import Trials
from benchmarks.work import Work
from tests.support.child import ROOT

__all__ = ["PROGRAMS", "Start", "draw", "heading", "measure", "rows", "section"]

COMMAND = "cold"
WORK = Work(srv_name="/bench/cold")
NAME, TYPE = WORK.names[0], WORK.srv_type

ANSWER = b"{}\n"
"""The empty response, as `rosasync call` prints it."""

STOCK = f"""\
import rclpy
from std_srvs.srv import Empty
rclpy.init()
node = rclpy.create_node("cold")
client = node.create_client(Empty, "{NAME}")
client.wait_for_service()
future = client.call_async(Empty.Request())
rclpy.spin_until_future_complete(node, future)
print("{{}}", flush=True)
node.destroy_node()
rclpy.shutdown()
"""
ROSASYNC = f"""\
import asyncio
import rosasync
from std_srvs.srv import Empty
async def main():
    async with rosasync.Session("cold", timeout=30.0) as session:
        await session.call(Empty, "{NAME}")
        print("{{}}", flush=True)
asyncio.run(main())
"""

PROGRAMS = {
    "stock rclpy script": (sys.executable, "-c", STOCK),
    "rosasync script": (sys.executable, "-c", ROSASYNC),
    "rosasync call": (sys.executable, "-m", "rosasync", "call", NAME, TYPE, "{}"),
}
"""The command of each program, which prints `ANSWER` once it has an answer."""


@dataclass(frozen=True)
class Start:
    """One process: the seconds from its start to its answer, None if it had none."""

    program: str
    seconds: float | None


def measure(
    programs: Sequence[str],
    processes: int,
    on_start: Callable[[Start], object] = lambda start: None,
) -> list[Start]:
    """Start processes in sequence; the programs alternate."""
    starts = []
    with WorkServer(WORK):
        for _ in range(processes):
            for program in programs:
                starts.append(Start(program, _run(PROGRAMS[program])))
                on_start(starts[-1])
    return starts


def _run(command: Sequence[str]) -> float | None:
    """Run a process to its end; return the seconds until its answer, None if it had none."""
    begin = time.monotonic()
    with subprocess.Popen(
        command, cwd=ROOT, env=os.environ, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        # Past what the middleware logs.
        answered = ANSWER in iter(process.stdout.readline, b"")
        seconds = time.monotonic() - begin
        process.stdout.read()
    return seconds if answered and process.returncode == 0 else None


heading = ["", "processes", "p50 s", "p95 s", "longest s", "no answer"]


def rows(starts: Sequence[Start]) -> list[list[str]]:
    """Return a row for each program."""
    return [_row(program, starts) for program in dict.fromkeys(s.program for s in starts)]


def _row(program: str, starts: Sequence[Start]) -> list[str]:
    own = [start for start in starts if start.program == program]
    times = _times(program, starts)
    figures = np.percentile(times, (50, 95, 100)) if times else ()
    cells = [f"{seconds:.2f}" for seconds in figures] or ["", "", ""]
    return [program, str(len(own)), *cells, str(len(own) - len(times))]


def _times(program: str, starts: Sequence[Start]) -> list[float]:
    return sorted(s.seconds for s in starts if s.program == program and s.seconds is not None)


def section(trials: Trials, picture: str) -> str:
    """Return the section of the documentation's page."""
    starts = [Start(**found) for found in trials.rows]
    return "\n".join(
        (
            "## The first call of a process\n",
            "`python -m benchmarks cold`. From the start of a process to its first answer, "
            "Python's start and the imports included. The processes run one after the other, and "
            "the programs alternate. The server is stock and runs all the time.\n",
            f"{trials.conditions}\n",
            markdown_table(heading, rows(starts)),
            f"![the first call of a process]({picture})\n",
        )
    )


def draw(trials: Trials) -> Figure:
    """Draw the share of processes that had an answer by a time."""
    starts = [Start(**found) for found in trials.rows]
    figure = Figure(figsize=(8, 4), layout="tight")
    axes = figure.subplots()
    for i, program in enumerate(dict.fromkeys(start.program for start in starts)):
        times = _times(program, starts)
        if not times:
            continue
        shares = [(n + 1) / len(times) for n in range(len(times))]
        axes.step([0.0, *times], [0.0, *shares], where="post", color=f"C{i}")
        middle = len(times) * (i + 1) // 4
        at = (times[middle], shares[middle])
        axes.annotate(f" {program}", at, color=f"C{i}", va="top")
    axes.set_xlabel("seconds since the start of the process")
    axes.set_ylabel("share of processes with an answer")
    axes.set_xlim(left=0)
    axes.set_ylim(0, 1)
    axes.grid(alpha=0.3)
    figure.suptitle("From the start of a process to its first answer")
    return figure
