"""``rosasync call``: call a service, once or many times."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Annotated, Any

import typer

import rosasync
from rosasync._cli.documents import plain
from rosasync._cli.errors import Code
from rosasync._cli.graph import find_type, srv_class
from rosasync._cli.load import Tally, make_calls
from rosasync._cli.options import AsJson, Name, OptionalType, OptionalYaml, Timeout
from rosasync._cli.output import note, pick, print_json, print_value, progress
from rosasync._cli.requests import requests_from, rounds_of, split_type, template
from rosasync._cli.run import fail, open_session, run

__all__ = ["call"]


def call(
    name: Name,
    srv_type: OptionalType = None,
    request: OptionalYaml = None,
    timeout: Timeout = 10.0,
    retry: Annotated[
        int,
        typer.Option(
            min=1,
            help="Send an unanswered request up to this many times in all. Only for services that "
            "may run twice.",
        ),
    ] = 1,
    count: Annotated[int, typer.Option(min=1, help="Make the call this many times.")] = 1,
    rate: Annotated[
        float | None,
        typer.Option(min=0.001, help="Calls per second at most.", show_default=False),
    ] = None,
    concurrency: Annotated[
        int, typer.Option(min=1, help="Calls that run at the same time at most.")
    ] = 1,
    as_json: AsJson = False,
    field: Annotated[
        str | None,
        typer.Option(help="Print one value of the response: pose.position.x, values[0]."),
    ] = None,
    show_template: Annotated[
        bool, typer.Option("--template", help="Print the request with its defaults, to edit.")
    ] = False,
) -> None:
    """Call a service and print its response.

    The type may be left out if the graph knows it. A stream of YAML documents on standard input
    makes a call for each. Several calls end with a summary; with --count the responses themselves
    are printed only if --json or --field asks for them.

    \b
    Examples:
      $ rosasync call /lamp/switch '{data: true}'
      $ rosasync call /lamp/switch std_srvs/srv/SetBool '{data: true}' --count 100 --concurrency 10
    """
    srv_type, request = split_type(srv_type, request)
    order = _Order(name, request, timeout, retry, count, rate, concurrency, as_json, field)
    run(_template(order, srv_type) if show_template else _call(order, srv_type))


@dataclass(frozen=True)
class _Order:
    """What to call, and how often. ``text`` says where the requests come from."""

    name: str
    text: str | None
    timeout: float
    retry: int
    count: int
    rate: float | None
    concurrency: int
    as_json: bool
    field: str | None

    @property
    def several(self) -> bool:
        return self.count > 1 or self.text == "-" or (self.text or "").startswith("@")

    @property
    def prints_responses(self) -> bool:
        return self.count == 1 or self.as_json or self.field is not None

    async def requests(self, srv_class: Any) -> AsyncIterator[Any]:
        """Yield the requests; those of an argument or a file as often as ``count`` says."""
        if self.text == "-" or self.count == 1:
            async for request in requests_from(srv_class.Request, self.text):
                yield request
            return
        rounds = rounds_of(srv_class.Request, self.text)
        for messages in itertools.islice(rounds, self.count):
            for message in messages:
                yield message


async def _template(order: _Order, srv_type: str | None) -> None:
    if srv_type is None:
        async with open_session() as session:
            srv_type = await find_type(session, order.name, order.timeout)
    print(template(srv_class(srv_type).Request))


async def _call(order: _Order, srv_type: str | None) -> int:
    # Before the session is opened, which takes longer than to report a mistake.
    known = None if srv_type is None else srv_class(srv_type)
    async with open_session(order.timeout) as session:
        found = known or srv_class(await find_type(session, order.name, order.timeout))
        if order.several:
            return await _call_several(session, order, found)
        async for request in order.requests(found):
            try:
                response = await _one(session, order, found, request)
            except asyncio.CancelledError:
                note("interrupted before the response came; the server may still run the request")
                raise
            _print(response, order)
    return Code.ANSWERED


async def _one(session: rosasync.Session, order: _Order, srv_class: Any, request: Any) -> Any:
    retry = rosasync.Retry(attempts=order.retry) if order.retry > 1 else None
    return await session.call(srv_class, order.name, request, timeout=order.timeout, retry=retry)


async def _call_several(session: rosasync.Session, order: _Order, srv_class: Any) -> int:
    tally = Tally()

    def on_response(response: Any, _: float) -> None:
        if order.prints_responses:
            _print(response, order, separate=tally.answered > 1)

    def on_failure(error: Exception) -> None:
        if order.as_json:
            print_json({"error": {"kind": type(error).__name__, "message": str(error)}})
        elif tally.failures[type(error).__name__] == 1:
            fail(error)

    try:
        async with progress(lambda: _state(tally, order)):
            await make_calls(
                lambda request: _one(session, order, srv_class, request),
                order.requests(srv_class),
                tally,
                callers=order.concurrency,
                rate=order.rate,
                on_response=on_response,
                on_failure=on_failure,
            )
    finally:
        if tally.answered or tally.failed:
            _summarise(tally, order)
    return tally.code


def _print(response: Any, order: _Order, *, separate: bool = False) -> None:
    value: Any = plain(response)
    if order.field is not None:
        value, separate = pick(value, order.field), False
    print_value(value, as_json=order.as_json, separate=separate)


def _state(tally: Tally, order: _Order) -> str:
    made = tally.answered + tally.failed
    of = "" if order.text == "-" else f" of {order.count}"
    return f"{made}{of} calls made, {tally.failed} failed"


def _summarise(tally: Tally, order: _Order) -> None:
    if order.as_json:
        print_json({"summary": tally.figures()})
        return
    for line in tally.lines():
        note(line) if order.prints_responses else print(line)
