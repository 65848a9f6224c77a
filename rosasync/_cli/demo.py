"""``rosasync demo``: rosasync compared with ``client.call``, or the lamp of the tutorial."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

import typer

from rosasync._cli.errors import CliError, Code
from rosasync._cli.output import note
from rosasync._cli.run import run

__all__ = ["demo"]

LAMP, LAMP_TYPE = "/lamp/switch", "std_srvs/srv/SetBool"


def demo(
    calls: Annotated[
        int,
        typer.Option(min=1, help="Calls of each contestant one at a time, and again ten at once."),
    ] = 2000,
    seconds: Annotated[float, typer.Option(min=0.1, help="Seconds to measure at most.")] = 8.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve what the tutorial calls, until Ctrl-C.")
    ] = False,
) -> None:
    """Compare rosasync with rclpy, or serve the tutorial's lamp.

    Calls a stock rclpy server with rosasync and with client.call. The server runs in its own
    process, in a ROS domain that nothing else on this machine uses. With --serve, it serves the
    tutorial's lamp in your own domain instead.

    \b
    Examples:
      $ rosasync demo --calls 200 --json
      $ rosasync demo --serve
    """
    run(_serve()) if serve else run(_compare(calls, seconds, as_json))


async def _compare(calls: int, seconds: float, as_json: bool) -> None:
    from rosasync._demo.run import DemoError, run_demo

    try:
        await run_demo(calls=calls, seconds=seconds, as_json=as_json)
    except DemoError as error:
        raise CliError(f"demo: {error}", Code.FAILED) from None


async def _serve() -> None:
    import rosasync

    def switch(request: Any, response: Any) -> Any:
        response.success, response.message = True, "on" if request.data else "off"
        print(f"the lamp is {response.message}", flush=True)
        return response

    async with (
        rosasync.Session("lamp", introspection="contents") as session,
        session.serve(LAMP_TYPE, LAMP, switch),
    ):
        note(f"serving {LAMP} [{LAMP_TYPE}]; call it: rosasync call {LAMP} '{{data: true}}'")
        await asyncio.Event().wait()
