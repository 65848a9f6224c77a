"""The arguments and options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

from rosasync._cli.completion import complete_names, complete_types

__all__ = [
    "AnyType",
    "AsJson",
    "Hidden",
    "Name",
    "OptionalType",
    "OptionalYaml",
    "Timeout",
    "Type",
    "Wait",
]

Name = Annotated[
    str,
    typer.Argument(
        metavar="NAME", help="The service's name, /lamp/switch.", autocompletion=complete_names
    ),
]

Type = Annotated[
    str,
    typer.Argument(
        metavar="TYPE",
        help="The service type, std_srvs/srv/SetBool.",
        autocompletion=complete_types,
    ),
]

AnyType = Annotated[
    str,
    typer.Argument(
        metavar="TYPE",
        help="A type, std_srvs/srv/SetBool or geometry_msgs/msg/Pose.",
        autocompletion=complete_types,
    ),
]

OptionalType = Annotated[
    str | None,
    typer.Argument(
        metavar="TYPE",
        help="The service type; may be left out if a server is in the graph.",
        autocompletion=complete_types,
        show_default=False,
    ),
]

OptionalYaml = Annotated[
    str | None,
    typer.Argument(
        metavar="YAML",
        help="The request, '{data: true}'; @file to read a file, - to read standard input.",
        show_default=False,
    ),
]

AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON object a line and nothing else.")
]

Timeout = Annotated[
    float, typer.Option("--timeout", min=0.0, help="Seconds for each call, discovery included.")
]

Wait = Annotated[
    float | None,
    typer.Option(
        "--wait",
        min=0.0,
        help="Look at the graph for this many seconds, instead of until it seems complete.",
        show_default=False,
    ),
]

Hidden = Annotated[
    bool, typer.Option("--hidden", help="Include names with a part that starts with '_'.")
]
