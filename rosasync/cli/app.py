"""The commands of ``rosasync``; `rosasync.__main__` starts them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from typing import Annotated

import typer

from rosasync.cli.profile import profile
from rosasync.demo.run import DemoError, run_demo

__all__ = ["app"]

app = typer.Typer(
    name="rosasync",
    help="ROS 2 service calls, native to asyncio.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if not wanted:
        return
    try:
        typer.echo(f"rosasync {version('rosasync')}")
    except PackageNotFoundError:
        typer.echo("rosasync, not installed: run from a source tree")
    raise typer.Exit


app.command()(profile)


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


@app.command()
def demo(
    calls: Annotated[
        int,
        typer.Option(min=1, help="Calls of each contestant one at a time, and again ten at once."),
    ] = 2000,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds to measure at most.")] = 8.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Call a stock rclpy server with rosasync and with client.call, and compare them.

    The server runs in its own process, in a ROS domain that nothing else on this machine uses.
    """
    try:
        run_demo(calls=calls, seconds=seconds, as_json=as_json)
    except DemoError as error:
        typer.echo(f"rosasync demo: {error}", err=True)
        raise typer.Exit(1) from None
