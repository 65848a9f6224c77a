"""``rosasync action``: list actions, send and cancel goals, and serve a stub."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any
from uuid import UUID

import typer

from rosasync._cli.action_send import Order, send_goal, show_goal
from rosasync._cli.action_serve import Behaviour, serve_action
from rosasync._cli.actions import (
    ActionName,
    ActionType,
    OptionalActionType,
    actions_of,
    endpoints_of,
    meant_instead,
    no_server,
    wait_for_types,
)
from rosasync._cli.errors import CliError, Code
from rosasync._cli.graph import is_hidden, resolve, settle
from rosasync._cli.options import AsJson, Hidden, Wait
from rosasync._cli.output import note, print_json
from rosasync._cli.requests import split_type
from rosasync._cli.run import open_session, run

if TYPE_CHECKING:
    from rosasync._ros.inspect import Endpoint

__all__ = ["app"]

app = typer.Typer(
    help="List actions, send and cancel goals, and serve a stub.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

OptionalGoal = Annotated[
    str | None,
    typer.Argument(
        metavar="YAML",
        help="The goal, '{order: 5}'; @file to read a file, - to read standard input.",
        show_default=False,
    ),
]

CANCEL_REFUSALS = {
    1: "the server refuses to cancel",
    2: "the server knows no goal of this id",
    3: "the goal has ended, or is being cancelled already",
}
"""What the return codes of ``action_msgs/srv/CancelGoal`` mean."""


@app.command("list")
def list_actions(
    types: Annotated[bool, typer.Option("--types", "-t", help="Print the types too.")] = False,
    hidden: Hidden = False,
    as_json: AsJson = False,
    wait: Wait = None,
) -> None:
    """List the actions that have a server.

    \b
    Examples:
      $ rosasync action list -t
      $ rosasync action list --json
    """
    run(_list(types, hidden, as_json, wait))


async def _list(types: bool, hidden: bool, as_json: bool, wait: float | None) -> None:
    async with open_session() as session:
        await settle(session, wait)
        found = actions_of(session)
    for name in sorted(found):
        if is_hidden(name) and not hidden:
            continue
        if as_json:
            print_json({"name": name, "types": found[name]})
        else:
            print(f"{name} [{', '.join(found[name])}]" if types else name)


@app.command("type")
def type_of(
    name: ActionName,
    as_json: AsJson = False,
    timeout: Annotated[float, typer.Option(min=0.0, help="Seconds to wait for a server.")] = 5.0,
) -> None:
    """Print the type of an action.

    \b
    Examples:
      $ rosasync action type /drive
      $ rosasync action type /drive --json
    """
    run(_type_of(name, as_json, timeout))


async def _type_of(name: str, as_json: bool, timeout: float) -> None:
    async with open_session() as session:
        types = await wait_for_types(session, name, timeout)
        if not types:
            raise no_server(session, name, timeout)
    if as_json:
        print_json({"name": name, "types": types})
    else:
        print("\n".join(types))


@app.command()
def info(name: ActionName, as_json: AsJson = False, wait: Wait = None) -> None:
    """Show the servers and clients of an action, each with its node and type.

    \b
    Examples:
      $ rosasync action info /drive
      $ rosasync action info /drive --json
    """
    run(_info(name, as_json, wait))


async def _info(name: str, as_json: bool, wait: float | None) -> int:
    async with open_session() as session:
        resolved = resolve(session, name, "action")
        await settle(session, wait)
        servers, clients = endpoints_of(session, resolved)
        if not servers:
            note(f"{name}: no server of this name{meant_instead(session, name)}")
    if as_json:
        for role, endpoints in (("server", servers), ("client", clients)):
            for endpoint in endpoints:
                print_json({"role": role, "node": endpoint.node or None, "type": endpoint.srv_type})
    else:
        print(resolved)
        _print_endpoints("servers", servers)
        _print_endpoints("clients", clients)
        if len(servers) > 1:
            print(f"clash: {len(servers)} servers: each goal is run by every one of its type")
    return Code.ANSWERED if servers else Code.NO_SERVER


def _print_endpoints(role: str, endpoints: list[Endpoint]) -> None:
    print(f"{role}: {len(endpoints)}")
    for endpoint in endpoints:
        print(f"  {endpoint.node or '(node not known)'} [{endpoint.srv_type}]")


@app.command()
def send(
    name: ActionName,
    action_type: OptionalActionType = None,
    goal: OptionalGoal = None,
    feedback: Annotated[
        bool, typer.Option("--feedback", "-f", help="Print the feedback as it comes.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            help="Seconds for the whole goal, which is then cancelled; no limit if left out.",
            show_default=False,
        ),
    ] = None,
    accept_timeout: Annotated[
        float, typer.Option(min=0.0, help="Seconds until the goal is accepted, discovery included.")
    ] = 10.0,
    show_template: Annotated[
        bool, typer.Option("--template", help="Print the goal to edit, and send nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Send a goal, and print its result.

    Ctrl-C cancels the goal, and says what became of it.

    \b
    Examples:
      $ rosasync action send /drive '{order: 5}' --feedback
      $ rosasync action send /drive test_msgs/action/Fibonacci '{order: 5}' --timeout 30 --json
    """
    action_type, goal = split_type(action_type, goal)
    order = Order(name, action_type, goal, feedback, timeout, accept_timeout, as_json)
    run(show_goal(order) if show_template else send_goal(order))


@app.command()
def cancel(
    name: ActionName,
    goal_id: Annotated[
        str | None, typer.Option("--id", help="The id of one goal.", show_default=False)
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Cancel all goals of the server.")] = False,
    timeout: Annotated[
        float, typer.Option(min=0.0, help="Seconds for the answer, discovery included.")
    ] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Cancel one goal of an action, or all, and print the ids of those that are cancelled.

    \b
    Examples:
      $ rosasync action cancel /drive --all
      $ rosasync action cancel /drive --id 5bb1f2a0-6a5c-4a04-9f3c-8f2c4f3e2d10
    """
    run(_cancel(name, goal_id, every, timeout, as_json))


def _parsed_id(goal_id: str | None, every: bool) -> UUID:
    """Return the id of the goal to cancel; zero for all."""
    if (goal_id is None) is not every:
        raise CliError("give either --id ID, for one goal, or --all")
    if goal_id is None:
        return UUID(int=0)
    try:
        found = UUID(goal_id)
    except ValueError:
        raise CliError(
            f"--id {goal_id}: not the id of a goal, which has 32 hexadecimal digits"
        ) from None
    if not found.int:
        raise CliError("--id has only zeros, which stands for all goals: use --all to cancel them")
    return found


async def _cancel(
    name: str, goal_id: str | None, every: bool, timeout: float, as_json: bool
) -> int:
    request = {"goal_info": {"goal_id": {"uuid": _parsed_id(goal_id, every).bytes}}}
    async with open_session(timeout) as session:
        # Its absence is reported by the action's name.
        if not await wait_for_types(session, name, timeout):
            raise no_server(session, name, timeout)
        response: Any = await session.call(
            "action_msgs/srv/CancelGoal", f"{name}/_action/cancel_goal", request
        )
    if response.return_code:
        raise CliError(f"{name}: {CANCEL_REFUSALS[response.return_code]}", Code.FAILED)
    if not response.goals_canceling:
        note(f"{name}: there is no goal to cancel")
    for each in response.goals_canceling:
        canceled = str(UUID(bytes=bytes(each.goal_id.uuid)))
        print_json({"goal_id": canceled}) if as_json else print(canceled)
    return Code.ANSWERED


@app.command()
def serve(
    name: ActionName,
    action_type: ActionType,
    result: Annotated[
        str | None,
        typer.Option(help="The result, '{sequence: [0, 1]}', or @file.", show_default=False),
    ] = None,
    feedback: Annotated[
        list[str] | None,
        typer.Option(help="A feedback message; may be given several times.", show_default=False),
    ] = None,
    delay: Annotated[
        float, typer.Option(min=0.0, help="Seconds before each feedback, and before the result.")
    ] = 0.0,
    reject_rate: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="The share of goals that are rejected.")
    ] = 0.0,
    abort_rate: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="The share of goals that are aborted.")
    ] = 0.0,
    on_busy: Annotated[
        str,
        typer.Option(help="What becomes of a goal while another runs: queue, reject or replace."),
    ] = "queue",
    handler: Annotated[
        str | None,
        typer.Option(
            metavar="MODULE:FUNCTION",
            help="Run goals with this async handler(goal).",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Serve an action until Ctrl-C, and print its goals and how they end.

    \b
    Examples:
      $ rosasync action serve /drive test_msgs/action/Fibonacci --delay 1 --feedback 'sequence: [0]'
      $ rosasync action serve /drive test_msgs/action/Fibonacci --abort-rate 0.2 --json
    """
    behaviour = Behaviour(result, tuple(feedback or ()), delay, reject_rate, abort_rate)
    run(serve_action(name, action_type, behaviour, on_busy, handler, as_json))
