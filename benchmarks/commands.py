"""The commands about many programs and faults, such as ``sharing``, and ``publish``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, TypeVar

import matplotlib
import typer
from matplotlib.figure import Figure
from rich.progress import Progress

from benchmarks import actions, cold, crash, faults, goodput, overload, sharing, status
from benchmarks.names import check_names
from benchmarks.pages import replace_section
from benchmarks.tables import goal_table, make_console, make_table
from benchmarks.trials import Goal, Trials
from rosasync._ros.domain import isolate
from tests.support.hosts import NoHosts

__all__ = ["add_commands", "save"]

T = TypeVar("T")

PAGES = {
    overload.COMMAND: "explanation/overload.md",
    status.COMMAND: "explanation/status.md",
    goodput.COMMAND: "explanation/status.md",
}
"""The pages of commands whose figures are explained elsewhere than in docs/benchmarks.md."""

Json = Annotated[Path | None, typer.Option("--json", help="Write the rows to this file.")]
Before = Annotated[
    Path | None,
    typer.Option(exists=True, help="A checkout whose rosasync is measured as `before`."),
]
Contestants = Annotated[str, typer.Option(help="These contestants: a,b,c.")]


def add_commands(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("sharing")(share)
    app.command("overload")(overload_server)
    app.command("faults")(fail)
    app.command("cold")(start)
    app.command("actions")(act)
    app.command("status")(report_failures)
    app.command("goodput")(give_up)
    app.command("publish")(publish)


def share(
    contestants: Contestants = sharing.USUAL,
    processes: Annotated[str, typer.Option(help="Numbers of client processes.")] = "1,2,4,8,16",
    work: Annotated[str, typer.Option(help="The server's work in ms.")] = "0,1,5",
    callers: Annotated[int, typer.Option(min=1, help="Callers in each process.")] = 16,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds for each cell.")] = 10.0,
    mixed: Annotated[bool, typer.Option(help="Also measure beside a stock flooder.")] = True,
    before: Before = None,
    json: Json = None,
) -> None:
    """Several client processes on one stock server: calls lost, fairness and latency."""
    with checked():
        chosen = sharing.plans(
            split(contestants), split(processes, int), split(work, float), mixed, before
        )
    isolate()
    trials = Trials(sharing.COMMAND, {"callers": callers, "seconds": seconds})
    with collected(trials, sharing.heading, sharing.row, len(chosen), json) as add:
        cells = sharing.measure(chosen, callers, seconds, before, add)
    show_goals(sharing.goals(cells))


def report_failures(
    calls: Annotated[int, typer.Option(min=10, help="Calls of each kind.")] = 500,
    json: Json = None,
) -> None:
    """How soon a caller learns that the handler has raised, beside an ordinary answer."""
    isolate()
    trials = Trials(status.COMMAND, {"calls": calls})
    with collected(trials, None, None, 2, json) as add:
        found = status.measure(calls, add)
    make_console().print(make_table("status=True", status.heading, list(status.rows(found))))
    show_goals(status.goals(found))


def give_up(
    loads: Annotated[
        str, typer.Option(help="Calls offered, as shares of what the server can do.")
    ] = goodput.LOADS,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds for each row.")] = 7.0,
    json: Json = None,
) -> None:
    """Callers that give up after a second: the answers in time, with and without status."""
    with checked():
        chosen = goodput.plans(split(loads, float))
    isolate()
    trials = Trials(goodput.COMMAND, {"seconds": seconds})
    with collected(trials, goodput.heading, goodput.row, len(chosen), json) as add:
        cells = goodput.measure(chosen, seconds, add)
    show_goals(goodput.goals(cells))


def overload_server(
    clients: Annotated[str, typer.Option(help="Clients: stock,rosasync,afor.")] = "stock,rosasync",
    servers: Annotated[
        str, typer.Option(help="Servers: stock,rosasync,rosasync-async.")
    ] = "stock,rosasync",
    loads: Annotated[
        str, typer.Option(help="Calls offered, as shares of what the server can do.")
    ] = "0.5,0.9,1.5,2,4,10",
    work: Annotated[str, typer.Option(help="The server's work in ms.")] = "10",
    spread: Annotated[str, typer.Option(help="constant, exponential or both.")] = "constant",
    timeouts: Annotated[str, typer.Option(help="0.1, 0.5, 2, mixed, none.")] = "0.5",
    processes: Annotated[str, typer.Option(help="Numbers of client processes.")] = "1",
    kept: Annotated[
        str, typer.Option(help="Numbers of callers that call again after each answer or timeout.")
    ] = "50",
    polite: Annotated[bool, typer.Option(help="Also a polite caller beside a flood.")] = True,
    recovery: Annotated[bool, typer.Option(help="Also the end of an overload.")] = True,
    everything: Annotated[
        bool,
        typer.Option(
            "--all", help="All clients, servers, work, timeouts and processes: takes hours."
        ),
    ] = False,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds for each row.")] = 4.0,
    json: Json = None,
) -> None:
    """More calls than a server can answer: how many are answered in time, and what is wasted."""
    if everything:
        clients, servers = "stock,rosasync,afor", "stock,rosasync,rosasync-async"
        work, spread, timeouts = "10,1,100", "constant,exponential", "0.5,0.1,2,mixed,none"
        processes, kept = "1,4", "50,100,200"
    with checked():
        chosen = overload.plans(
            split(clients),
            split(servers),
            split(loads, float),
            split(work, float),
            split(spread),
            split(timeouts),
            split(processes, int),
            split(kept, int),
            polite,
            recovery,
        )
    isolate()
    trials = Trials(overload.COMMAND, {"seconds": seconds})
    with collected(trials, overload.heading, overload.row, len(chosen), json) as add:
        cells = overload.measure(chosen, seconds, add)
    show_goals(overload.goals(cells))


def fail(
    situations: Annotated[str, typer.Option(help="These situations.")] = (
        ",".join(faults.SITUATIONS)
    ),
    contestants: Contestants = f"{faults.STOCK},{faults.OURS},{faults.RETRY}",
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds for each row.")] = 20.0,
    before: Before = None,
    json: Json = None,
) -> None:
    """Calls while packets are lost, or the server is killed, restarted or slow; may need root."""
    with checked():
        chosen = faults.plans(split(situations), split(contestants), before)
    isolate()
    trials = Trials(faults.COMMAND, {"seconds": seconds})
    with collected(trials, faults.heading, faults.row, len(chosen), json) as add:
        found = faults.measure(chosen, seconds, before, add)
    show_goals(faults.goals(found))


def start(
    programs: Annotated[
        str, typer.Option(help=f"These programs, instead of {', '.join(cold.PROGRAMS)}.")
    ] = "",
    processes: Annotated[int, typer.Option(min=1, help="Processes of each program.")] = 50,
    after_crash: Annotated[
        bool,
        typer.Option(
            "--after-crash",
            help="Kill and replace clients, and servers, instead. The programs are "
            f"{', '.join(crash.CONTESTANTS)}.",
        ),
    ] = False,
    places: Annotated[
        str, typer.Option(help=f"Where they are killed: {', '.join(crash.PLACES)}.")
    ] = crash.LOCALHOST,
    before: Before = None,
    json: Json = None,
) -> None:
    """From the start of a process to its first answer."""
    if after_crash:
        replace(split(programs) or crash.CONTESTANTS, split(places), processes, before, json)
        return
    with checked():
        chosen = split(programs) or [*cold.PROGRAMS]
        check_names("program", chosen, cold.PROGRAMS)
    isolate()
    trials = Trials(cold.COMMAND, {"processes": processes})
    total = processes * len(chosen)
    with collected(trials, None, None, total, json) as add:
        starts = cold.measure(chosen, processes, add)
    make_console().print(make_table("", cold.heading, cold.rows(starts)))


def replace(
    programs: Sequence[str],
    places: Sequence[str],
    restarts: int,
    before: Path | None,
    json: Path | None,
) -> None:
    """Measure processes that replace killed ones."""
    with checked():
        chosen = crash.check_contestants(programs, before)
        check_names("place", places, crash.PLACES)
    isolate()
    trials = Trials(crash.COMMAND, {"restarts": restarts})
    total = len(places) * len(crash.SIDES) * restarts * len(chosen)
    found = []
    with collected(trials, None, None, total, json) as add:
        for name in places:
            try:
                with crash.placed(name) as place:
                    found += crash.measure(chosen, restarts, place, before, add)
            except NoHosts as reason:
                trials.skipped[name] = str(reason)
                typer.echo(f"{name}: {reason}")
    make_console().print(make_table("", crash.heading, crash.rows(found)))


def act(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds; the medians count.")] = 3,
    scale: Annotated[
        float, typer.Option(min=0.001, max=1.0, help="Less than 1 for fewer goals.")
    ] = 1.0,
    json: Json = None,
) -> None:
    """Goals of actions: latency, goals at once, feedback and memory, beside rclpy's."""
    isolate()
    trials = Trials(actions.COMMAND, {"rounds": rounds, "scale": scale})
    total = actions.total(rounds)
    with collected(trials, actions.heading, actions.row, total, json) as add:
        figures = actions.measure(rounds, scale, add)
    show_goals(actions.goals(figures))


def publish(
    files: Annotated[list[Path], typer.Argument(exists=True, help="Trials saved with --json.")],
    out: Annotated[Path, typer.Option(help="The documentation's folder.")] = Path("docs"),
) -> None:
    """Write saved trials and their plots into the documentation, between their marks.

    Those of ``overload`` go into docs/explanation/overload.md, those of ``status`` and ``goodput``
    into docs/explanation/status.md, all others into docs/benchmarks.md.
    """
    for trials in Trials.load(files):
        page = out / PAGES.get(trials.command, "benchmarks.md")
        with checked():
            text = section(trials, out)
            page.write_text(replace_section(page.read_text(), trials.command, text))
        typer.echo(f"{page}: {trials.command}")


def section(trials: Trials, out: Path) -> str:
    """Return the section of these trials, after drawing its plot."""
    if trials.command == faults.COMMAND:
        return faults.section(trials)
    if trials.command == actions.COMMAND:
        return actions.section(trials)
    if trials.command == crash.COMMAND:
        return crash.section(trials)
    if trials.command == status.COMMAND:
        return status.section(trials)
    picture = f"benchmarks/{trials.command}.svg"
    if trials.command == overload.COMMAND:
        save(overload.draw(trials), out / picture)
        return overload.section(trials, f"../{picture}")
    if trials.command == goodput.COMMAND:
        save(goodput.draw(trials), out / picture)
        return goodput.section(trials, f"../{picture}")
    if trials.command == sharing.COMMAND:
        save(sharing.draw(trials), out / picture)
        return sharing.section(trials, picture)
    save(cold.draw(trials), out / picture)
    return cold.section(trials, picture)


def save(figure: Figure, path: Path) -> None:
    """Write a plot as SVG, the same bytes for the same plot."""
    matplotlib.rcParams["svg.hashsalt"] = "rosasync"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


@contextmanager
def checked() -> Iterator[None]:
    """Report a wrong argument as the command line does."""
    try:
        yield
    except ValueError as exc:
        raise typer.BadParameter(str(exc)) from None


@contextmanager
def collected(
    trials: Trials,
    heading: list[str] | None,
    row: Callable[[Any], list[str]] | None,
    total: int,
    json: Path | None,
) -> Iterator[Callable[[Any], None]]:
    """Yield a function that takes each result; show and save what there is, also after Ctrl-C."""
    console = make_console()
    body = []
    try:
        with Progress(console=console) as progress:
            task = progress.add_task("", total=total)

            def add(result: Any) -> None:
                trials.rows.append(dataclasses.asdict(result))
                if row is not None:
                    body.append(row(result))
                progress.advance(task)

            yield add
    except NoHosts as exc:
        console.print(f"skipped: {exc}", highlight=False)
    finally:
        if heading is not None:
            console.print(make_table(trials.command, heading, body))
        if json:
            trials.save(json)


def show_goals(goals: Iterable[Goal]) -> None:
    if found := goal_table(goals):
        make_console().print(found)


def split(text: str, kind: Callable[[str], T] = str) -> list[T]:  # type: ignore[assignment]
    """Return the parts of a list such as ``a,b,c``."""
    return [kind(part.strip()) for part in text.split(",") if part.strip()]
