"""Processes that are killed and replaced, on one host and on several: the next answer comes."""

from __future__ import annotations

import asyncio
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest

from benchmarks import crash
from benchmarks.crash import CLIENT, HELD, OURS, PLACES, SERVER, STOCK, Place, Restart
from rosasync import Retry
from tests.faults.conftest import fault_of
from tests.faults.table import Row
from tests.faults.trial import PATIENT, Trial
from tests.support.child import ROOT
from tests.support.hosts import NoHosts
from tests.support.process import ended, first_line
from tests.support.times import LIMIT, until

pytestmark = pytest.mark.faults

RESTARTS = 10
MORTAL = """
import asyncio, sys
import rosasync
from tests.support.echo import ECHO, fill
name, holds = sys.argv[1], "hold" in sys.argv
held = []
async def main():
    print("standby", flush=True)
    await asyncio.to_thread(input)
    async with rosasync.Session("mortal") as session:
        if holds:
            session.serve(ECHO, name, lambda call: held.append(call))
        else:
            session.serve(ECHO, name, lambda request, response: fill(request, response))
        print("serving", flush=True)
        await asyncio.sleep(3600)
asyncio.run(main())
"""


@pytest.fixture
def place(request: pytest.FixtureRequest) -> Iterator[Place]:
    """The place that the test is parametrized with."""
    try:
        with crash.placed(request.param) as place:
            yield place
    except NoHosts as reason:
        pytest.skip(f"no network namespaces: {reason}")


@pytest.mark.parametrize("side", [CLIENT, SERVER, HELD], ids=["client", "server", "held"])
@pytest.mark.parametrize("place", PLACES, indirect=True)
def test_processes_that_are_killed_and_replaced(
    request: pytest.FixtureRequest,
    record: Callable[[Row], None],
    full: bool,
    place: Place,
    side: str,
) -> None:
    """Each of rosasync is answered. Of stock rclpy beside it, nothing is asserted."""
    restarts = RESTARTS if full else 1
    found = crash.measure([OURS, STOCK], restarts, place, sides=[side])
    for contestant, bridge in ((OURS, "direct"), (STOCK, "stock")):
        row = _row(fault_of(request), bridge, [r for r in found if r.contestant == contestant])
        record(row)
        if contestant == OURS:
            assert row.answered == restarts, row


def _row(fault: str, bridge: str, restarts: list[Restart]) -> Row:
    times = [r.seconds for r in restarts if r.seconds is not None]
    row = Row(fault, bridge, made=len(restarts), answered=len(times))
    row.hung = row.made - row.answered
    if times:
        row.notes.append(
            f"next answer after {statistics.median(times):.2f} s, {max(times):.2f} s at most"
        )
    return row


@pytest.mark.parametrize("retry", [None, PATIENT], ids=["once", "Retry"])
async def test_with_ten_calls_out(trial: Trial, full: bool, retry: Retry | None) -> None:
    """The calls that were out end, and with Retry they are answered by the next server."""
    times = []
    async with trial.session() as session:
        for number in range(5 if full else 1):
            name = f"/mortal_{number}"
            with _standby(name, "hold") as first, _standby(name) as second:
                await _begin(first)
                async with asyncio.TaskGroup() as group:
                    group.create_task(trial.calls(session, name, 10, timeout=LIMIT, retry=retry))
                    await until(lambda: session.pool.statistics().in_flight == 10)
                    first.kill()
                    # The id of a zombie is in use.
                    first.wait()
                    await _begin(second)
                    begin = time.monotonic()
                    assert await trial.call(session, name, timeout=LIMIT) == "answered"
                    times.append(time.monotonic() - begin)
    trial.row.notes.append(
        f"next answer after {statistics.median(times):.2f} s, {max(times):.2f} s at most"
    )
    if retry is None:
        assert trial.failed.total() == 10 * len(times)
        assert trial.failed.keys() <= {"ServerGone", "ResponseTimeout"}
    else:
        assert not trial.failed


@contextmanager
def _standby(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start a server that waits for `_begin`: Python and its imports take longer than a restart."""
    process = subprocess.Popen(
        (sys.executable, "-c", MORTAL, *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    with ended(process):
        assert process.stdout is not None
        assert first_line(process.stdout) == "standby\n"
        yield process


async def _begin(server: subprocess.Popen[str]) -> None:
    assert server.stdin is not None
    assert server.stdout is not None
    server.stdin.write("\n")
    server.stdin.flush()
    line = await asyncio.to_thread(partial(first_line, server.stdout))
    assert line == "serving\n"
