"""``rosasync profile``: print the Fast DDS profile for the environment of other nodes."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from rosasync._ros.profile import ANNOUNCEMENT, is_old, profile_text, profile_variable

__all__ = ["Distribution", "profile"]


class Distribution(StrEnum):
    """The distributions, of which each reads its own profile format."""

    JAZZY = "jazzy"
    KILTED = "kilted"


def profile(
    distribution: Annotated[
        Distribution | None,
        typer.Option(help="The nodes' distribution; by default the installed one."),
    ] = None,
) -> None:
    """Print a Fast DDS profile for the environment of stock nodes.

    With it, a lost request or response is repaired within about 20 ms instead of 3 s, and a new
    process is found within about 0.2 s.

    \b
    Examples:
      $ rosasync profile
      $ rosasync profile --distribution kilted
    """
    old = is_old() if distribution is None else distribution is Distribution.JAZZY
    typer.echo(profile_text(old, announcement=ANNOUNCEMENT), nl=False)
    typer.echo(
        f"rosasync profile > profile.xml; export {profile_variable(old)}=$PWD/profile.xml",
        err=True,
    )
