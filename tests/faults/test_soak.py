"""Everything at once, for as long as ``--soak-minutes`` says: ``python -m pytest -m soak``."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from typing import Any

import pytest

from tests.conftest import Bridge
from tests.faults.caller import CallerProcess
from tests.faults.table import Row
from tests.support.hosts import NoHosts
from tests.support.lossy import LossyHosts
from tests.support.servers import ServerProcess
from tests.support.times import TICK

NAME = "/soaked"
LEASE = 2
PAUSE = 60 * TICK
"""The mean time between two disturbances, in seconds."""


class Network:
    """Two servers and a process of callers: on hosts of their own if this machine can have them.

    Without network namespaces a partition is a server that is stopped for a while.
    """

    def __init__(self, stack: AsyncExitStack) -> None:
        self._stack = stack
        self._hosts: LossyHosts | None = None
        self._servers: list[ServerProcess] = []
        self.chance = random.Random(19)

    @classmethod
    @asynccontextmanager
    async def opened(cls) -> AsyncIterator[Network]:
        async with AsyncExitStack() as stack:
            network = cls(stack)
            try:
                network._hosts = stack.enter_context(LossyHosts("one", "two", "client", seed=19))
            except NoHosts:
                network._hosts = None
            network._servers = [await network._server(number) for number in (0, 1)]
            yield network

    async def caller(self) -> CallerProcess:
        # The same lease as the servers', for the same reason as in `partition`.
        caller = CallerProcess(lease=LEASE, **self._on("client"))
        return await self._stack.enter_async_context(caller)

    async def restart(self, how: Callable[[ServerProcess], object]) -> None:
        number = self.chance.randrange(2)
        await asyncio.to_thread(how, self._servers[number])
        await asyncio.sleep(self.chance.uniform(0, PAUSE))
        self._servers[number] = await self._server(number)

    async def partition(self) -> None:
        # Clearly shorter or clearly longer than the lease. In between, only one side may forget the
        # other, and Fast DDS does not always match them again.
        short = self.chance.random() < 0.5
        seconds = (0, LEASE / 2) if short else (4 * LEASE, 6 * LEASE)
        await self._disturb(1.0, self.chance.uniform(*seconds))

    async def renew(self) -> None:
        """Replace both servers."""
        for number in (0, 1):
            await asyncio.to_thread(self._servers[number].kill)
            self._servers[number] = await self._server(number)

    async def lose(self) -> None:
        await self._disturb(0.1, self.chance.uniform(0, 3 * PAUSE))

    async def _disturb(self, loss: float, seconds: float) -> None:
        if self._hosts is not None:
            self._hosts.set(loss=loss)
            await asyncio.sleep(seconds)
            self._hosts.set(loss=0.0)
            return
        pid = self.chance.choice(self._servers).pid
        os.kill(pid, signal.SIGSTOP)
        await asyncio.sleep(seconds)
        os.kill(pid, signal.SIGCONT)

    def _on(self, host: str) -> dict[str, Any]:
        if self._hosts is None:
            return {}
        return {"prefix": self._hosts.on(host), "environment": self._hosts.environment}

    async def _server(self, number: int) -> ServerProcess:
        server = ServerProcess(lease=LEASE, **self._on(["one", "two"][number]))
        await self._stack.enter_async_context(server)
        await server.serve(NAME)
        return server


@pytest.mark.soak
@pytest.mark.timeout(0)
@pytest.mark.parametrize("full", [False], indirect=True, ids=[""])
async def test_everything_at_once(
    request: pytest.FixtureRequest, record: Callable[[Row], None], bridge: Bridge, full: bool
) -> None:
    minutes = request.config.getoption("--soak-minutes")
    end = time.monotonic() + 60 * minutes
    restarts = partitions = unmatched = 0
    async with Network.opened() as network:
        caller = await network.caller()
        await caller.start(
            f"soak: {minutes:g} minutes",
            bridge,
            NAME,
            callers=50,
            retry=True,
            cancel=0.1,
            pause=10 * TICK,
        )
        await caller.more_answers(100)
        while time.monotonic() < end:
            await asyncio.sleep(network.chance.uniform(0, 2 * PAUSE))
            match network.chance.randrange(4):
                case 0:
                    await network.restart(ServerProcess.kill)
                    restarts += 1
                case 1:
                    await network.restart(ServerProcess.interrupt)
                    restarts += 1
                case 2:
                    await network.partition()
                    partitions += 1
                case 3:
                    await network.lose()
            try:
                await caller.more_answers(50)
            except AssertionError:
                if await caller.finds_server(NAME):
                    raise
                unmatched += 1
                await network.renew()
                await caller.more_answers(50)
        row = await caller.stop()
    row.notes.append(
        f"{restarts} restarts, {partitions} partitions; {unmatched} times no server was matched "
        "afterwards, not even by a stock client of the same node, until it was restarted"
    )
    record(row)
    row.check()
