"""Standard output and error: what is printed where, and whether it is a terminal."""

from __future__ import annotations

import asyncio
import re
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any

from rosasync._cli.documents import dump_json
from rosasync._cli.emitter import dump_yaml
from rosasync._cli.errors import CliError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

__all__ = ["console", "note", "pick", "print_json", "print_value", "progress"]

REDRAW = 0.25
"""Seconds between two drawings of progress."""


def print_json(value: object) -> None:
    """Print a value as one line of JSON."""
    print(dump_json(value), flush=True)


def print_value(value: object, *, as_json: bool, separate: bool = False) -> None:
    """Print a value as YAML or JSON, and a single text or number as it is.

    Args:
        value: what a message consists of.
        as_json: print a line of JSON.
        separate: print the mark between two YAML documents first.
    """
    if as_json:
        print_json(value)
        return
    if separate:
        print("---")
    print(value if isinstance(value, str) else dump_yaml(value), flush=True)


def note(text: str) -> None:
    """Print a remark to standard error."""
    # A remark that cannot be shown must not end what it is about.
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def console() -> Console:
    """Return the console of standard output; it obeys NO_COLOR, COLUMNS and pipes."""
    from rich.console import Console

    return Console(highlight=False, markup=False, soft_wrap=not sys.stdout.isatty())


@asynccontextmanager
async def progress(render: Callable[[], RenderableType]) -> AsyncIterator[None]:
    """Show what ``render`` returns while the block runs, on standard error if it is a terminal.

    It is drawn four times a second, by the loop and not by a thread, and removed at the end.
    """
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.live import Live

    screen = Console(stderr=True, highlight=False, markup=False)
    # What is printed to the same terminal has to go around the live lines; a pipe gets it as it is.
    same = sys.stdout.isatty()
    with Live(
        render(), console=screen, auto_refresh=False, transient=True, redirect_stdout=same
    ) as live:

        async def draw() -> None:
            while True:
                live.update(render(), refresh=True)
                await asyncio.sleep(REDRAW)

        task = asyncio.create_task(draw())
        try:
            yield
        finally:
            task.cancel()


def pick(fields: dict[str, Any], path: str) -> Any:
    """Return the value at a path, ``pose.position.x`` or ``values[0].name``.

    Raises:
        CliError: there is no such value; the message says what there is.
    """
    value: Any = fields
    for name, index in re.findall(r"([^.\[\]]+)|\[(-?\d+)\]", path):
        try:
            value = value[int(index)] if index else value[name]
        except (KeyError, IndexError, TypeError):
            there = ", ".join(value) if isinstance(value, dict) else f"{value!r}"
            raise CliError(f"--field {path}: no {name or index} here; there is {there}") from None
    return value
