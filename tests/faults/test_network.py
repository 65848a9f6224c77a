"""Hosts whose network loses and delays packets, is cut, or loses a link: newcomers and others."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.conftest import Bridge
from tests.faults.actor import ActorProcess
from tests.faults.caller import CallerProcess
from tests.faults.conftest import fault_of
from tests.faults.table import Row
from tests.support.action_servers import ActionServerProcess
from tests.support.clients import ClientProcess
from tests.support.hosts import NoHosts, run_ip
from tests.support.lossy import LossyHosts
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK

Record = Callable[[Row], None]


@pytest.fixture(scope="module")
def hosts() -> Iterator[LossyHosts]:
    """Two hosts, joined by a switch that loses what it is told to."""
    try:
        with LossyHosts("server", "client", seed=3) as hosts:
            yield hosts
    except NoHosts as reason:
        pytest.skip(f"no network namespaces: {reason}")


@pytest.fixture
async def remote(hosts: LossyHosts) -> AsyncIterator[ServerProcess]:
    """A server on its host, and a network that loses nothing afterwards."""
    async with ServerProcess(
        lease=5, prefix=hosts.on("server"), environment=hosts.environment
    ) as server:
        await server.serve("/remote")
        yield server
    hosts.set(loss=0.0, delay=0.0)


@asynccontextmanager
async def caller_on(hosts: LossyHosts) -> AsyncIterator[CallerProcess]:
    async with CallerProcess(
        lease=5, prefix=hosts.on("client"), environment=hosts.environment
    ) as caller:
        yield caller


def forms(short: object, *full: object) -> list[Any]:
    """The only case of the short form, which has to be quick, and the cases of the full form."""
    return [
        pytest.param(False, short, id=f"short-{short}"),
        *(pytest.param(True, case, marks=pytest.mark.faults, id=f"full-{case}") for case in full),
    ]


LINKS = {
    "2 % lost": {"loss": 0.02},
    "20 % lost": {"loss": 0.2},
    "100 ms": {"delay": 0.1},
    "20 % lost and 100 ms": {"loss": 0.2, "delay": 0.1},
}


@pytest.mark.parametrize(("full", "link"), forms("2 % lost", *LINKS), indirect=["full"])
async def test_link(
    request: pytest.FixtureRequest,
    hosts: LossyHosts,
    remote: ServerProcess,
    record: Record,
    bridge: Bridge,
    full: bool,
    link: str,
) -> None:
    """Its first call is that of a newcomer, which has to discover the server on this network."""
    hosts.set(**LINKS[link])
    async with caller_on(hosts) as caller:
        await caller.start(fault_of(request), bridge, "/remote")
        await caller.more_answers(10)
        await asyncio.sleep(400 * TICK if full else 0)
        row = await caller.stop()
    record(row)
    row.check()
    assert row.failed.keys() <= {
        "ServiceUnavailable",
        "QueueTimeout",
        "ResponseTimeout",
        "ServerGone",
    }


@pytest.mark.parametrize(("full", "link"), forms("2 % lost", *LINKS), indirect=["full"])
async def test_link_with_the_stock_client(
    request: pytest.FixtureRequest,
    hosts: LossyHosts,
    remote: ServerProcess,
    record: Record,
    full: bool,
    link: str,
) -> None:
    """For comparison, the same with ``client.call_async``; nothing is asserted of it."""
    hosts.set(**LINKS[link])
    row = Row(fault_of(request).replace(" with the stock client", ""), "stock")
    async with ClientProcess(
        lease=5, prefix=hosts.on("client"), environment=hosts.environment
    ) as client:
        await client.start("/remote", None if full else 20, in_flight=10, timeout=40 * TICK)
        await asyncio.sleep(400 * TICK if full else 0)
        tally = await client.result()
    row.made, row.answered, row.wrong = tally.calls, tally.answered, tally.wrong
    row.failed = {"unanswered": tally.lost}
    record(row)


@pytest.mark.slow
@pytest.mark.parametrize(("full", "seconds"), forms(8, 8, 30), indirect=["full"])
async def test_cut_for_seconds(
    request: pytest.FixtureRequest,
    hosts: LossyHosts,
    remote: ServerProcess,
    record: Record,
    bridge: Bridge,
    full: bool,
    seconds: int,
) -> None:
    async with caller_on(hosts) as caller:
        await caller.start(fault_of(request), bridge, "/remote")
        await caller.more_answers(50)
        hosts.set(loss=1.0)
        await asyncio.sleep(seconds if full else seconds * TICK)
        hosts.set(loss=0.0)
        await caller.more_answers(50)
        row = await caller.stop()
    record(row)
    row.check()


@pytest.mark.slow
async def test_with_a_link_taken_down(
    request: pytest.FixtureRequest,
    hosts: LossyHosts,
    remote: ServerProcess,
    record: Record,
    bridge: Bridge,
    full: bool,
) -> None:
    link = ["-n", hosts.namespace("client"), "link", "set", "eth0"]
    async with caller_on(hosts) as caller:
        await caller.start(fault_of(request), bridge, "/remote")
        await caller.more_answers(50)
        run_ip(*link, "down")
        await asyncio.sleep(LIMIT / 4 if full else 10 * TICK)
        run_ip(*link, "up")
        run_ip("-n", hosts.namespace("client"), "route", "replace", "224.0.0.0/4", "dev", "eth0")
        await caller.more_answers(50)
        row = await caller.stop()
    record(row)
    row.check()


@asynccontextmanager
async def goals_out(
    hosts: LossyHosts, bridge: Bridge, lease: int, count: int
) -> AsyncIterator[tuple[ActionServerProcess, ActorProcess]]:
    """An action server on its host, with so many goals of another host; the network is whole."""
    options: Any = {"lease": lease, "environment": hosts.environment}
    try:
        async with (
            ActionServerProcess(prefix=hosts.on("server"), **options) as server,
            ActorProcess(prefix=hosts.on("client"), **options) as actor,
        ):
            await server.serve("/held", hold=True, idle=True)
            await actor.open_session(bridge)
            await actor.act("/held", count)
            await server.goals("/held", at_least=count)
            yield server, actor
            await actor.close_session()
    finally:
        hosts.set(loss=0.0)


@pytest.mark.faults
async def test_goals_of_a_cut_network(hosts: LossyHosts, bridge: Bridge, full: bool) -> None:
    """The peers do not notice the cut. Nothing is lost, and what was left in it is cancelled."""
    async with goals_out(hosts, bridge, lease=20, count=10) as (server, actor):
        hosts.set(loss=1.0)
        await actor.leave(4)
        await asyncio.sleep((200 if full else 8) * TICK)
        assert len(await server.running("/held")) == 10
        hosts.set(loss=0.0)
        await runs(server, 6)
        await server.release("/held")
        assert await actor.ends() == {"result": 6, "CancelledError": 4}


@pytest.mark.faults
async def test_goals_of_a_network_that_is_cut_for_longer(hosts: LossyHosts, bridge: Bridge) -> None:
    """Each peer is gone for the other. When it is back, its goals are cancelled."""
    async with goals_out(hosts, bridge, lease=1, count=10) as (server, actor):
        hosts.set(loss=1.0)
        await actor.leave(4)
        assert await actor.ends() == {"ServerGone": 6, "CancelledError": 4}
        assert len(await server.running("/held")) == 10
        hosts.set(loss=0.0)
        await runs(server, 0)


async def runs(server: ActionServerProcess, count: int) -> None:
    """Wait until so many goals of the server run."""
    for _ in range(200):
        if len(await server.running("/held")) == count:
            return
        await asyncio.sleep(LIMIT / 100)
    raise AssertionError(f"{len(await server.running('/held'))} goals run, not {count}")
