"""``rosasync lifecycle``: read and change the state of lifecycle nodes."""

from __future__ import annotations

import enum
from typing import Annotated

import typer

from rosasync._cli.errors import CliError, Code
from rosasync._cli.node_names import NodeName, ask_each, nodes_that_serve, session_for
from rosasync._cli.options import AsJson, Timeout, Wait
from rosasync._cli.output import print_json
from rosasync._cli.run import open_session, run
from rosasync.lifecycle import LifecycleClient, LifecycleState, TransitionTimeout

__all__ = ["Transition", "app"]

app = typer.Typer(
    help="Read and change the state of lifecycle nodes.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


class Transition(enum.StrEnum):
    """The transitions that a user asks for."""

    CONFIGURE = "configure"
    CLEANUP = "cleanup"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    SHUTDOWN = "shutdown"


@app.command()
def nodes(timeout: Timeout = 10.0, wait: Wait = None, as_json: AsJson = False) -> None:
    """List the lifecycle nodes in the graph, and their states.

    The state of one that does not answer is unknown, and an error says why.

    \b
    Examples:
      $ rosasync lifecycle nodes
      $ rosasync lifecycle nodes --json
    """
    run(_nodes(timeout, wait, as_json))


@app.command()
def get(node: NodeName, timeout: Timeout = 10.0, as_json: AsJson = False) -> None:
    """Print the state of a node.

    \b
    Examples:
      $ rosasync lifecycle get /camera
      $ rosasync lifecycle get /camera --json
    """
    run(_get(node, timeout, as_json))


@app.command("list")
def list_transitions(node: NodeName, timeout: Timeout = 10.0, as_json: AsJson = False) -> None:
    """List the transitions that a node can make in its state.

    \b
    Examples:
      $ rosasync lifecycle list /camera
      $ rosasync lifecycle list /camera --json
    """
    run(_list(node, timeout, as_json))


@app.command("set")
def set_state(
    node: NodeName,
    transition: Annotated[Transition, typer.Argument(help="The transition to make.")],
    timeout: Timeout = 10.0,
    as_json: AsJson = False,
) -> None:
    """Make a transition, and print the state it leads to.

    If it is not answered in time, the state is read: the node may have made it all the same.

    \b
    Examples:
      $ rosasync lifecycle set /camera configure
      $ rosasync lifecycle set /camera activate --timeout 30
    """
    run(_set(node, transition, timeout, as_json))


async def _nodes(timeout: float, wait: float | None, as_json: bool) -> int:
    async with open_session(timeout) as session:
        names = await nodes_that_serve(session, "get_state", "lifecycle_msgs/srv/GetState", wait)
        answers = await ask_each(names, lambda name: LifecycleClient(session, name).state())
    for name in names:
        _print_state(name, answers.found.get(name, LifecycleState.UNKNOWN), as_json, alone=False)
    return answers.code


async def _get(node: str, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        _print_state(node, await LifecycleClient(session, node).state(), as_json)


async def _list(node: str, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        found = await LifecycleClient(session, node).transitions()
    for one in found:
        if as_json:
            print_json({"id": one.id, "label": one.label, "start": one.start, "goal": one.goal})
        else:
            print(f"- {one.label} [{one.id}]\n\tStart: {one.start}\n\tGoal: {one.goal}")


async def _set(node: str, transition: Transition, timeout: float, as_json: bool) -> None:
    async with session_for(node, timeout) as session:
        change = getattr(LifecycleClient(session, node), transition)
        try:
            _print_state(node, await change(), as_json)
        except TransitionTimeout as error:
            raise CliError(f"{error} ({error.outcome})", Code.TIMED_OUT) from None


def _print_state(node: str, state: LifecycleState, as_json: bool, *, alone: bool = True) -> None:
    if as_json:
        print_json({"node": node, "state": state, "id": state.id})
    else:
        print(f"{'' if alone else f'{node}: '}{state} [{state.id}]")
