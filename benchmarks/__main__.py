"""The command line: ``python -m benchmarks``."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import Progress

from benchmarks.allocations import measure_allocations
from benchmarks.commands import add_commands, save
from benchmarks.machine import describe_machine
from benchmarks.results import Results
from benchmarks.runner import Runner
from benchmarks.suites import SUITES, make_suite
from benchmarks.tables import goal_table, make_console, scenario_table
from benchmarks.targets import judge
from rosasync._ros.domain import isolate

ROUNDS, QUICK_ROUNDS, ALLOCATION_ROUNDS = 9, 5, 3
PINNED_CORES = 4

Quick = Annotated[bool, typer.Option("--quick", help="Fewer calls and rounds.")]
Rounds = Annotated[int | None, typer.Option(min=1, help=f"{ROUNDS}, or {QUICK_ROUNDS} if quick.")]
Json = Annotated[Path | None, typer.Option("--json", help="Write the raw samples to this file.")]
Pin = Annotated[
    bool | None,
    typer.Option(help="Reserve half of the cores for the server; default with four or more cores."),
]
Chosen = Annotated[str, typer.Option("--contestants", help="Only these contestants: a,b,c.")]

SUITE_COMMANDS = {
    "headline": "What the README shows: one call and eight at once, to two servers.",
    "latency": "The time of a call, calls at once, idle clients, idle CPU and memory.",
    "throughput": "The calls per second of 1, 8, 64 and 512 callers.",
    "scale": "Many services, idle clients, large responses and slow servers.",
    "hosts": "A server on another host, which is a network namespace; needs root.",
    "targets": "The fewest measurements that show whether the targets are met.",
    "ticks": "Ticks of behaviour trees: their cost, and how fast they send and see responses.",
    "flood": "Calls that a busy client loses while another process floods its server.",
    "servers": "A rosasync server compared with a stock server, with the same client.",
    "idle": "The CPU use of a client that makes no calls.",
    "memory": "The growth of memory from 10,000 to 100,000 calls.",
}

app = typer.Typer(help=__doc__, no_args_is_help=True, pretty_exceptions_enable=False)


def add_command(name: str, text: str, suites: list[str], *, and_allocations: bool = False) -> None:
    """Add a command that measures suites."""

    @app.command(name, help=text)
    def command(
        quick: Quick = False,
        rounds: Rounds = None,
        json: Json = None,
        contestants: Chosen = "",
        pin: Pin = None,
    ) -> None:
        measure(suites, quick, rounds, json, contestants, pin, and_allocations=and_allocations)


for _suite, _text in SUITE_COMMANDS.items():
    add_command(_suite, _text, [_suite])


@app.command()
def allocations(quick: Quick = False, rounds: Rounds = None, json: Json = None) -> None:
    """The Python objects and bytes of a call and of a request, and how many stay allocated."""
    isolate()
    rounds = rounds or (1 if quick else ALLOCATION_ROUNDS)
    settings = {"suites": ["allocations"], "quick": quick, "rounds": rounds, "pin": False}
    results = Results(settings)
    look_at_allocations(results, quick, rounds)
    finish(results, json)


add_command(
    "all",
    "All measurements.",
    [name for name in SUITES if name not in ("headline", "targets")],
    and_allocations=True,
)


add_commands(app)


@app.command()
def profile(
    calls: Annotated[
        int, typer.Option(min=250, help="Calls with timestamps, and as many without.")
    ] = (20_000),
    update: Annotated[
        Path | None, typer.Option(exists=True, help="Write the table into this page.")
    ] = None,
) -> None:
    """How the time of one call is spent, between await and the response."""
    from benchmarks import profile

    isolate()
    found = profile.profile(calls)
    make_console().print(profile.table(found))
    if update:
        update.write_text(profile.updated(update.read_text(), found, describe_machine()))


@app.command()
def window(
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds between two events.")] = 2.0,
    plot: Annotated[Path, typer.Option(help="Where to draw it.")] = Path(
        "docs/benchmarks/window.svg"
    ),
) -> None:
    """The window of one session while clients come and go, and the server is killed."""
    from benchmarks import window

    isolate()
    story = asyncio.run(window.follow(seconds))
    save(window.draw(story), plot)


@app.command()
def report(
    files: Annotated[list[Path], typer.Argument(exists=True, help="Results saved with --json.")],
    out: Annotated[Path, typer.Option(help="The documentation's folder.")] = Path("docs"),
) -> None:
    """Write docs/benchmarks.md and its plots from saved results."""
    from benchmarks.report import write_report

    typer.echo(write_report(Results.read(files), out))


def measure(
    suites: list[str],
    quick: bool,
    rounds: int | None,
    json: Path | None,
    contestants: str,
    pin: bool | None,
    *,
    and_allocations: bool = False,
) -> None:
    chosen = [key.strip() for key in contestants.split(",") if key.strip()]
    try:
        found = [make_suite(name, quick=quick, contestants=chosen) for name in suites]
    except ValueError as exc:
        raise typer.BadParameter(str(exc)) from None
    scenarios = {scenario.key: scenario for suite in found for scenario in suite}
    isolate()
    rounds = rounds or (QUICK_ROUNDS if quick else ROUNDS)
    pin = len(os.sched_getaffinity(0)) >= PINNED_CORES if pin is None else pin
    settings = {"suites": suites, "quick": quick, "rounds": rounds, "pin": pin}
    results = Results(settings)
    console = make_console()
    try:
        with (
            Progress(console=console) as progress,
            Runner(rounds, pin, results, progress) as runner,
        ):
            runner.run(list(scenarios.values()))
        if and_allocations:
            look_at_allocations(results, quick, 1 if quick else ALLOCATION_ROUNDS)
    except KeyboardInterrupt:
        console.print("interrupted: these are the completed rounds")
    finish(results, json)


def look_at_allocations(results: Results, quick: bool, rounds: int) -> None:
    with Progress(console=make_console()) as progress:
        measure_allocations(results, quick=quick, rounds=rounds, progress=progress)


def finish(results: Results, json: Path | None) -> None:
    show(make_console(), results)
    if json:
        results.save(json)


def show(console: Console, results: Results) -> None:
    for scenario in results.scenarios:
        if results.contestants(scenario):
            console.print(scenario_table(results, scenario))
    if found := goal_table(judge(results)):
        console.print(found)


if __name__ == "__main__":
    app()
