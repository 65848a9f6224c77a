"""rosasync's servers, with each kind of handler."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import uvloop

import rosasync
from benchmarks.work import (
    LIMITED,
    SERVERS,
    Work,
    async_handler,
    handled,
    handling_time,
    load_type,
    make_handler,
    make_qos,
    make_response,
)

__all__ = ["rosasync_server"]


def waiting_handler(work: Work) -> Callable[[Any, Any], Any]:
    """Return a handler that waits, as for a device, instead of blocking its loop."""
    prepared = make_response(work)

    async def handler(_request: Any, _response: Any) -> Any:
        await asyncio.sleep(handling_time(work))
        handled.append(time.monotonic())
        return prepared

    return handler


@contextmanager
def rosasync_server(work: Work) -> Iterator[None]:
    """Serve `work` in a loop in another thread."""
    started: threading.Event = threading.Event()
    ending: list[Callable[[], object]] = []
    thread = threading.Thread(target=_run, args=(work, started, ending))
    thread.start()
    started.wait()
    try:
        yield
    finally:
        ending[0]()
        thread.join()


def _run(work: Work, started: threading.Event, ending: list[Callable[[], object]]) -> None:
    kind = (SERVERS | LIMITED)[work.server]
    loop_factory = uvloop.new_event_loop if kind.endswith("uvloop") else None
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        runner.run(_serve(work, kind, started, ending))


async def _serve(
    work: Work, kind: str, started: threading.Event, ending: list[Callable[[], object]]
) -> None:
    bridge: Literal["direct", "executor"] = "executor" if "executor" in kind else "direct"
    handler = make_handler(work) if "plain" in kind else async_handler(work)
    concurrency = 100
    if "one at a time" in kind:
        handler, concurrency = waiting_handler(work), 1
    qos = None if work.depth is None else make_qos(work.depth)
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    async with rosasync.Session("bench_server", bridge=bridge) as session:
        servers = [
            session.serve(
                load_type(work.srv_type),
                name,
                handler,
                qos=qos,
                concurrency=concurrency,
                status="status" in kind,
            )
            for name in work.names
        ]
        ending.append(lambda: loop.call_soon_threadsafe(over.set))
        started.set()
        await over.wait()
        for server in servers:
            # Without the requests that wait, which may be a thousand.
            await server.aclose(0)
