"""``rosasync watch``: the requests and responses of others, by service introspection."""

from __future__ import annotations

import asyncio
import sys
from collections import OrderedDict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

import rosasync
from rosasync._cli.documents import dump_json, plain
from rosasync._cli.graph import find_type, resolve, srv_class
from rosasync._cli.introspection import switched_on
from rosasync._cli.options import AsJson, Name, OptionalType
from rosasync._cli.output import console, note, print_json
from rosasync._cli.run import open_session, run

if TYPE_CHECKING:
    from rich.table import Table

__all__ = ["watch"]

KINDS = ("request_sent", "request_received", "response_sent", "response_received")
"""The events, in the order of service_msgs/msg/ServiceEventInfo."""

OTHER_LINES = 6
"""Lines of the terminal that the table's rows may not use."""


def watch(
    name: Name,
    srv_type: OptionalType = None,
    count: Annotated[
        int, typer.Option(min=0, help="End after this many events; 0 to go on until Ctrl-C.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Show the requests and responses of others as they pass.

    They are seen only if their server or client publishes service introspection. If none does, it
    is switched on while the command runs, on nodes that have the parameter for it.

    \b
    Examples:
      $ rosasync watch /lamp/switch
      $ rosasync watch /lamp/switch --count 4 --json
    """
    run(_watch(name, srv_type, count, as_json))


@dataclass(frozen=True, slots=True)
class _Event:
    """One event: what happened when, and what was sent if that is published."""

    kind: str
    seconds: float
    client: str
    sequence: int
    contents: dict[str, Any] | None

    @classmethod
    def of(cls, message: Any) -> _Event:
        info = message.info
        kind = KINDS[info.event_type]
        found = message.request if kind.startswith("request") else message.response
        return cls(
            kind,
            info.stamp.sec + info.stamp.nanosec / 1e9,
            bytes(info.client_gid).hex(),
            int(info.sequence_number),
            plain(found[0]) if found else None,
        )

    @property
    def time(self) -> str:
        return f"{datetime.fromtimestamp(self.seconds):%H:%M:%S.%f}"[:-3]

    def as_json(self) -> dict[str, Any]:
        described = {"event": self.kind, "stamp": self.seconds, "client": self.client}
        contents = {} if self.contents is None else {self.kind.partition("_")[0]: self.contents}
        return {**described, "sequence": self.sequence, **contents}

    def __str__(self) -> str:
        contents = "" if self.contents is None else dump_json(self.contents)
        return f"{self.time} {self.kind:<17} {self.client[:8]} #{self.sequence} {contents}".rstrip()


async def _watch(name: str, srv_type: str | None, count: int, as_json: bool) -> None:
    async with open_session() as session:
        resolved = resolve(session, name)
        found = srv_class(srv_type or await find_type(session, name, 5.0))
        seen = 0
        async with (
            _events(session, found, resolved) as events,
            switched_on(session, resolved),
        ):
            note(f"watching {resolved}; Ctrl-C ends it")
            try:
                async with _screen(as_json) as show:
                    while not count or seen < count:
                        show(await events.get())
                        seen += 1
            finally:
                note(f"{seen} events")


@asynccontextmanager
async def _events(
    session: rosasync.Session, srv_class: type[Any], name: str
) -> AsyncIterator[asyncio.Queue[_Event]]:
    from rosasync._ros.inspect import subscribe

    events: asyncio.Queue[_Event] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def deliver(message: Any) -> None:
        loop.call_soon_threadsafe(events.put_nowait, _Event.of(message))

    end = subscribe(session.node, srv_class.Event, f"{name}/_service_event", deliver)
    try:
        yield events
    finally:
        end()


@asynccontextmanager
async def _screen(as_json: bool) -> AsyncIterator[Any]:
    """Yield the function that shows an event: in a table on a terminal, as a line elsewhere."""
    if as_json:
        yield lambda event: print_json(event.as_json())
    elif not sys.stdout.isatty():
        yield partial(print, flush=True)
    else:
        from rich.live import Live

        screen = console()
        table = _Calls(max(1, screen.height - OTHER_LINES))
        with Live(table.render(), console=screen, auto_refresh=False) as live:

            def show(event: _Event) -> None:
                table.add(event)
                live.update(table.render(), refresh=True)

            yield show


class _Calls:
    """The latest calls, each with its events."""

    def __init__(self, rows: int) -> None:
        self._rows = rows
        self._calls: OrderedDict[tuple[str, int], list[_Event]] = OrderedDict()

    def add(self, event: _Event) -> None:
        """Add an event to its call."""
        self._calls.setdefault((event.client, event.sequence), []).append(event)
        while len(self._calls) > self._rows:
            self._calls.popitem(last=False)

    def render(self) -> Table:
        """Return the table, the latest call last."""
        from rich.table import Table

        table = Table("time", "client", "#", "request", "response", "took", expand=True)
        for (client, sequence), events in self._calls.items():
            request, response = (_contents(events, kind) for kind in ("request", "response"))
            first, last = events[0], events[-1]
            took = f"{1e3 * (last.seconds - first.seconds):.1f} ms" if response else ""
            table.add_row(first.time, client[:8], str(sequence), request, response, took)
        return table


def _contents(events: list[_Event], kind: str) -> str:
    """Return what was sent, or that something was."""
    own = [event for event in events if event.kind.startswith(kind)]
    shown = [dump_json(event.contents) for event in own if event.contents is not None]
    return shown[0] if shown else "(seen)" if own else ""
