"""The commands of ``rosasync``, and how the process ends; `rosasync.__main__` starts it."""

from __future__ import annotations

import signal
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

import typer

from rosasync._cli import action, lifecycle, param
from rosasync._cli.bench import bench
from rosasync._cli.call import call
from rosasync._cli.demo import demo
from rosasync._cli.doctor import doctor
from rosasync._cli.errors import Code, join
from rosasync._cli.fresh import run_fresh
from rosasync._cli.listing import find, info, list_services, nodes, type_of
from rosasync._cli.ping import ping
from rosasync._cli.profile import profile
from rosasync._cli.run import fail, interrupted
from rosasync._cli.serve import serve
from rosasync._cli.show import show
from rosasync._cli.signals import handle_signals
from rosasync._cli.streams import OutputError, prepare_streams, silence_stdout
from rosasync._cli.watch import watch
from rosasync._cli.why import why

__all__ = ["app", "main"]

# typer has its own copy of click in its newer versions, so the class cannot be imported.
_UsageError: Any = typer.BadParameter.__mro__[1]

app = typer.Typer(
    name="rosasync",
    help="ROS 2 services and actions from the command line.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.command()(call)
app.command("list")(list_services)
app.command("type")(type_of)
app.command()(find)
app.command()(show)
app.command()(info)
app.command()(nodes)
app.command()(serve)
app.command()(watch)
app.command()(bench)
app.command()(ping)
app.command()(why)
app.command()(doctor)
app.command()(profile)
app.command("run", context_settings={"allow_interspersed_args": False})(run_fresh)
app.command()(demo)
app.add_typer(action.app, name="action")
app.add_typer(param.app, name="param")
app.add_typer(lifecycle.app, name="lifecycle")


def main() -> int:
    """Run the command line and return the exit code."""
    handle_signals()
    prepare_streams()
    try:
        arguments = sys.argv[1:] or ["--help"]
        code = app(arguments, prog_name="rosasync", standalone_mode=False) or 0
        sys.stdout.flush()
    except _UsageError as error:
        fail(_line_of(error))
        code = Code.USAGE
    except (KeyboardInterrupt, typer.Abort):
        code = interrupted()
    except OutputError as error:
        silence_stdout()
        code = error.code
        if code is not Code.PIPE_CLOSED:
            fail(error)
    # The interpreter takes some milliseconds to end: a Ctrl-C then prints no traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return int(code)


def _line_of(error: Any) -> str:
    command = error.ctx.command_path if error.ctx else "rosasync"
    # Newer versions of click say so of a value that is not one of the choices.
    text = " ".join(error.format_message().split()).replace("Value error, ", "")
    takes_yaml = error.ctx and any(p.metavar == "YAML" for p in error.ctx.command.params)
    if takes_yaml and "unexpected extra argument" in text:
        return join(text, "YAML with spaces needs quotes: '{data: true}'")
    return join(text, f"Try: {command} --help")


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
    try:
        typer.echo(f"rosasync {version('rosasync')}")
    except PackageNotFoundError:
        typer.echo("rosasync, not installed: run from a source tree")
    raise typer.Exit


@app.callback()
def _main(
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass
