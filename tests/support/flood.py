"""What is lost when one process floods a stock server and another is slow to take its responses.

``python -m tests.support.flood`` measures it for rosasync and for ``client.call_async``, and prints
a table. Nothing is asserted: without ``Retry`` the middleware may drop requests and
responses, and how many depends on the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Awaitable, Callable
from typing import Literal

from rosasync import CallError, Limits, Retry, Session
from rosasync._ros.domain import isolate
from tests.support.clients import ClientProcess, Tally
from tests.support.echo import ECHO, request_of
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK

__all__ = ["blocked_loop", "call_in_bursts", "main", "start_flood"]

BURST = 10
Bridge = Literal["direct", "executor"]
PATIENCE = 20 * TICK


async def blocked_loop(block: float = TICK) -> None:
    """Keep the running loop busy for ``block`` seconds at a time, until cancelled."""
    while True:
        time.sleep(block)  # noqa: ASYNC251
        await asyncio.sleep(TICK / 10)


async def start_flood(client: ClientProcess, server: ServerProcess, name: str) -> None:
    """Have a process call a service, eight requests at once, until its result is asked for."""
    answered = await server.answered(name)
    await client.start(name, None, in_flight=8, timeout=4 * TICK)
    await server.answered(name, answered + 100)


async def call_in_bursts(
    session: Session, name: str, calls: int, *, retry: Retry | None, timeout: float
) -> Tally:
    """Call a service, ten requests at once, and count how the calls end."""
    tally = Tally()

    async def one(text: str) -> None:
        try:
            response = await session.call(
                ECHO, name, request_of(text), retry=retry, timeout=timeout
            )
        except CallError:
            response = None
        tally.count(text, response)

    for first in range(0, calls, BURST):
        async with asyncio.TaskGroup() as group:
            for number in range(first, min(first + BURST, calls)):
                group.create_task(one(f"call {number}"))
    return tally


async def main(calls: int) -> None:
    """Measure each way in turn beside the same flood, and print how many calls were lost."""

    def ours(bridge: Bridge, retry: Retry | None) -> Callable[[], Awaitable[Tally]]:
        async def run() -> Tally:
            limits = Limits(grace=TICK)
            async with Session("slow", bridge=bridge, limits=limits) as session:
                await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
                blocking = asyncio.create_task(blocked_loop())
                try:
                    return await call_in_bursts(
                        session, "/echo", calls, retry=retry, timeout=PATIENCE
                    )
                finally:
                    blocking.cancel()

        return run

    def stock(depth: int) -> Callable[[], Awaitable[Tally]]:
        return lambda: victim.run(
            "/echo", calls, in_flight=BURST, depth=depth, block=TICK, timeout=PATIENCE
        )

    retry = Retry(attempts=50, after=4 * TICK, backoff=1)
    ways = {
        "rosasync, direct bridge": ours("direct", None),
        "rosasync, direct bridge, Retry": ours("direct", retry),
        "rosasync, executor bridge": ours("executor", None),
        "rosasync, executor bridge, Retry": ours("executor", retry),
        "client.call_async, depth 10": stock(10),
        "client.call_async, depth 1,000": stock(1000),
    }
    print(f"{'':34}{'calls':>7}{'lost':>7}    flood: {'calls':>7}{'lost':>7}")
    async with ServerProcess() as server, ClientProcess() as flood, ClientProcess() as victim:
        await server.serve("/echo")
        for way, run in ways.items():
            await start_flood(flood, server, "/echo")
            tally = await run()
            others = await flood.result()
            assert not tally.wrong
            print(
                f"{way:34}{tally.calls:7}{tally.lost:7}           {others.calls:7}{others.lost:7}",
                flush=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=200, help="calls for each way")
    isolate()
    asyncio.run(main(parser.parse_args().calls))
