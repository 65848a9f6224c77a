"""``rosasync serve``: a stub of a service, or a handler of the user's own."""

from __future__ import annotations

import asyncio
import copy
import functools
import importlib
import os
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer

import rosasync
from rosasync._cli.documents import plain
from rosasync._cli.errors import CliError
from rosasync._cli.graph import srv_class
from rosasync._cli.options import AsJson, Name, Type
from rosasync._cli.output import note, print_value
from rosasync._cli.requests import message_from
from rosasync._cli.run import open_session, run
from rosasync._cli.streams import OutputError
from rosasync._ros.message_fields import field_types
from rosasync._status.wire import Outcome

__all__ = ["load_handler", "serve"]

CLOSE_TIMEOUT = 0.5
"""Seconds for which Ctrl-C lets handlers finish."""


def serve(
    name: Name,
    srv_type: Type,
    response: Annotated[
        str | None,
        typer.Option(help="The response, '{success: true}', or @file.", show_default=False),
    ] = None,
    delay: Annotated[float, typer.Option(min=0.0, help="Seconds before each response.")] = 0.0,
    fail_rate: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="The share of responses with 'success: false'."),
    ] = 0.0,
    drop_rate: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="The share of requests without a response.")
    ] = 0.0,
    echo: Annotated[
        bool,
        typer.Option("--echo", help="Fill the response from request fields of the same type."),
    ] = False,
    handler: Annotated[
        str | None,
        typer.Option(
            metavar="MODULE:FUNCTION",
            help="Answer with this handler(request, response) or handler(call), plain or async.",
            show_default=False,
        ),
    ] = None,
    status: Annotated[
        bool,
        typer.Option("--status", help="Report failures to rosasync callers, as status=True does."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Serve a service until Ctrl-C, and print what it is asked.

    \b
    Examples:
      $ rosasync serve /door/open std_srvs/srv/SetBool --response '{success: true}' --delay 0.2
      $ rosasync serve /door/lock std_srvs/srv/SetBool --echo --fail-rate 0.5 --drop-rate 0.1 --json
    """
    behaviour = _Behaviour(response, delay, fail_rate, drop_rate, echo)
    run(_serve(name, srv_type, behaviour, handler, status, as_json))


@dataclass(frozen=True)
class _Behaviour:
    """How a stub answers."""

    response: str | None
    delay: float
    fail_rate: float
    drop_rate: float
    echo: bool


async def _serve(
    name: str,
    srv_type: str,
    behaviour: _Behaviour,
    handler: str | None,
    status: bool,
    as_json: bool,
) -> None:
    found = srv_class(srv_type)
    if handler is None:
        answer = _Stub(found, behaviour).answer
    elif behaviour == _Behaviour(None, 0.0, 0.0, 0.0, False):
        answer = load_handler(handler)
    else:
        raise CliError("--handler answers itself: leave out the options of the stub")
    failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    async with open_session(introspection="contents") as session:
        server = _start(session, found, name, _printing(answer, as_json, failure), status)
        note(f"serving {name} [{srv_type}]; Ctrl-C ends it")
        try:
            await failure
        finally:
            await server.aclose(CLOSE_TIMEOUT)
            counts = server.statistics()
            note(f"requests: {counts.taken}, responses: {counts.responded}")


def _start(
    session: rosasync.Session,
    srv_class: Any,
    name: str,
    handler: Callable[..., Any],
    status: bool,
) -> rosasync.ServiceServer[Any, Any]:
    try:
        return session.serve(srv_class, name, handler, status=status)
    except TypeError as error:
        raise CliError(f"--handler: {error}") from None


def _printing(
    handler: Callable[..., Any], as_json: bool, failure: asyncio.Future[None]
) -> Callable[..., Any]:
    """Return a handler that prints each request first; an error of the output is ``failure``."""
    printed = 0

    @functools.wraps(handler)
    def printing(*arguments: Any) -> Any:
        nonlocal printed
        request = getattr(arguments[0], "request", arguments[0])
        try:
            print_value(plain(request), as_json=as_json, separate=printed > 0)
        except OutputError as error:
            if not failure.done():
                failure.set_exception(error)
        printed += 1
        return handler(*arguments)

    return printing


def load_handler(handler: str) -> Any:
    """Import ``module:function``, from the working directory too.

    Raises:
        CliError: there is no such function.
    """
    module, colon, function = handler.partition(":")
    if not colon:
        # Before the import, which runs the module.
        raise CliError(f"--handler {handler}: Expected MODULE:FUNCTION, such as drives:drive")
    sys.path.insert(0, os.getcwd())
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise CliError(
            f"--handler {handler}: {error}. Expected MODULE:FUNCTION, of a module here or installed"
        ) from None
    return found


class _Stub:
    """Answers as the options say."""

    def __init__(self, srv_class: type[Any], behaviour: _Behaviour) -> None:
        self._behaviour = behaviour
        self._response = message_from(srv_class.Response, behaviour.response)
        self._types = field_types(srv_class.Response)
        self._echoes = _pair_fields(srv_class) if behaviour.echo else {}
        if behaviour.fail_rate and getattr(self._types.get("success"), "kind", None) != "bool":
            raise CliError(
                "--fail-rate sets 'success' to false, and this response has no such field: use "
                "--drop-rate"
            )
        if behaviour.echo and not self._echoes:
            raise CliError("--echo: no field of the response has the type of a request's field")

    async def answer(self, call: rosasync.ServiceCall[Any, Any]) -> Any:
        """Answer one request, late or never if the options say so."""
        try:
            await asyncio.sleep(self._behaviour.delay)
        except asyncio.CancelledError:
            call.give_up("dropped: the server ended", Outcome.CLOSED)
            return None
        if random.random() < self._behaviour.drop_rate:
            call.give_up("dropped: --drop-rate")
            return None
        response = copy.copy(self._response)
        for name, source in self._echoes.items():
            setattr(response, name, getattr(call.request, source))
        if "success" in self._types and self._behaviour.fail_rate:
            response.success = random.random() >= self._behaviour.fail_rate
        return response


def _pair_fields(srv_class: type[Any]) -> dict[str, str]:
    """Return the request field to copy to each response field: of the same name, or the next one.

    Both have the same type.
    """
    left = dict(field_types(srv_class.Request))
    pairs: dict[str, str] = {}
    for name, kind in field_types(srv_class.Response).items():
        same = [other for other, its_kind in left.items() if its_kind == kind]
        if same:
            pairs[name] = name if name in same else same[0]
            del left[pairs[name]]
    return pairs
