"""Hosts whose network loses and delays packets, is cut, or loses a link: newcomers and others."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from tests.conftest import Bridge
from tests.faults.caller import CallerProcess
from tests.faults.conftest import fault_of
from tests.faults.table import Row
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
