"""``rosasync param``: read and set the parameters of nodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from rosasync._cli.errors import CliError, Code
from rosasync._cli.node_names import NodeName, ask_each, nodes_that_serve, session_for
from rosasync._cli.options import AsJson, Timeout, Wait
from rosasync._cli.output import print_json, print_value
from rosasync._cli.param_values import read_value
from rosasync._cli.run import run
from rosasync.parameters import ParameterClient, ParameterError, ParameterType

__all__ = ["app"]

app = typer.Typer(
    help="Read and set the parameters of nodes.", no_args_is_help=True, rich_markup_mode=None
)

ParameterName = Annotated[str, typer.Argument(metavar="NAME", help="The parameter's name, speed.")]

ParameterNames = Annotated[
    list[str], typer.Argument(metavar="NAME...", help="The parameters' names.")
]


@app.command("list")
def list_names(
    node: Annotated[
        str | None,
        typer.Argument(metavar="[NODE]", help="The node's name; all nodes if it is left out."),
    ] = None,
    timeout: Timeout = 10.0,
    wait: Wait = None,
    as_json: AsJson = False,
) -> None:
    """List the names of a node's parameters, or of all nodes'.

    \b
    Examples:
      $ rosasync param list /arm
      $ rosasync param list --json
    """
    run(_list(node, timeout, wait, as_json))


@app.command()
def get(
    node: NodeName, names: ParameterNames, timeout: Timeout = 10.0, as_json: AsJson = False
) -> None:
    """Print the value of a parameter, or of several.

    \b
    Examples:
      $ rosasync param get /arm speed
      $ rosasync param get /arm speed home --json
    """
    run(_get(node, names, timeout, as_json))


# A value may look like an option: -3.
@app.command("set", context_settings={"ignore_unknown_options": True})
def set_value(
    node: NodeName,
    name: ParameterName,
    value: Annotated[
        str, typer.Argument(metavar="VALUE", help="The value, as in a parameter file.")
    ],
    timeout: Timeout = 10.0,
    as_json: AsJson = False,
) -> None:
    """Set a parameter. The value is read as in a parameter file.

    The parameter's type decides, if it has one that cannot change: 1 is 1.0 for a double.

    \b
    Examples:
      $ rosasync param set /arm speed 0.5
      $ rosasync param set /arm home '[0.0, 0.0, 0.5]'
    """
    run(_set(node, name, value, timeout, as_json))


@app.command()
def delete(
    node: NodeName, name: ParameterName, timeout: Timeout = 10.0, as_json: AsJson = False
) -> None:
    """Undeclare a parameter, if the node allows that.

    \b
    Examples:
      $ rosasync param delete /arm payload
      $ rosasync param delete /arm payload --timeout 2
    """
    run(_delete(node, name, timeout, as_json))


@app.command()
def describe(
    node: NodeName, names: ParameterNames, timeout: Timeout = 10.0, as_json: AsJson = False
) -> None:
    """Print the type, description and range of a parameter, or of several.

    \b
    Examples:
      $ rosasync param describe /arm speed
      $ rosasync param describe /arm speed home --json
    """
    run(_describe(node, names, timeout, as_json))


@app.command()
def dump(node: NodeName, timeout: Timeout = 10.0, as_json: AsJson = False) -> None:
    """Print a node's parameters as a YAML file. With --json, all of them as one object.

    \b
    Examples:
      $ rosasync param dump /arm
      $ rosasync param dump /arm > arm.yaml
    """
    run(_dump(node, timeout, as_json))


@app.command()
def load(
    node: NodeName,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A YAML file.")],
    use_wildcard: Annotated[
        bool, typer.Option("--use-wildcard", help="Use the entries for /** and the like too.")
    ] = False,
    timeout: Timeout = 10.0,
    as_json: AsJson = False,
) -> None:
    """Set the parameters that a YAML file has for a node, and print them.

    \b
    Examples:
      $ rosasync param load /arm arm.yaml
      $ rosasync param load /arm all.yaml --use-wildcard
    """
    run(_load(node, file, use_wildcard, timeout, as_json))


async def _list(node: str | None, timeout: float, wait: float | None, as_json: bool) -> int:
    async with session_for(node, timeout) as session:
        if node is not None:
            _print_names(node, await ParameterClient(session, node).list(), as_json, alone=True)
            return Code.ANSWERED
        nodes = await nodes_that_serve(
            session, "list_parameters", "rcl_interfaces/srv/ListParameters", wait
        )
        answers = await ask_each(nodes, lambda name: ParameterClient(session, name).list())
    for name, names in answers.found.items():
        _print_names(name, names, as_json, alone=False)
    return answers.code


def _print_names(node: str, names: list[str], as_json: bool, *, alone: bool) -> None:
    if as_json:
        print_value({"node": node, "parameters": names}, as_json=True)
        return
    if not alone:
        print(f"{node}:")
    for name in names:
        print(name if alone else f"  {name}")


async def _get(node: str, names: list[str], timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        values = _plain(await ParameterClient(session, node).get(names))
    one = len(names) == 1 and not as_json
    print_value(values[names[0]] if one else values, as_json=as_json)


async def _set(node: str, name: str, text: str, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        client = ParameterClient(session, node)
        kind = await _static_type(client, name)
        with _usage_errors():
            value = read_value(text, kind)
            await client.set(name, value)
    print_value(_plain({name: value}), as_json=as_json)


async def _static_type(client: ParameterClient, name: str) -> ParameterType:
    """Return the type of a parameter, NOT_SET if it is not declared or its type may change."""
    try:
        kind = await client.types(name)
        descriptor = await client.describe(name)
    except ParameterError:
        return ParameterType.NOT_SET
    return ParameterType.NOT_SET if descriptor.dynamic_typing else kind


async def _delete(node: str, name: str, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        await ParameterClient(session, node).set(name, None)
    if as_json:
        print_json({"node": node, "deleted": name})


async def _describe(node: str, names: list[str], timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        found = await ParameterClient(session, node).describe(names)
    for position, descriptor in enumerate(found.values()):
        fields = asdict(descriptor) | {"type": descriptor.type.name.lower()}
        print_value(fields, as_json=as_json, separate=position > 0)


async def _dump(node: str, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        client = ParameterClient(session, node)
        if not as_json:
            print(await client.dump(), end="")
            return
        values = await client.get_all()
    print_json({"node": node, "parameters": _plain(values)})


async def _load(node: str, file: Path, use_wildcard: bool, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        with _usage_errors():
            values = await ParameterClient(session, node).load(file, use_wildcard=use_wildcard)
    print_value(_plain(values), as_json=as_json)


@contextmanager
def _usage_errors() -> Iterator[None]:
    """Turn the errors of a value or a file into those of a command."""
    try:
        yield
    except (OSError, TypeError, ValueError) as error:
        raise CliError(str(error)) from None


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return the values as YAML and JSON have them: bytes become numbers."""
    return {
        name: list(value) if isinstance(value, bytes) else value for name, value in values.items()
    }
