"""Latencies: the percentiles in the statistics, and how accurate they are."""

from __future__ import annotations

import asyncio
import math
import random
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rosasync import LatencyStatistics, ResponseTimeout, Session
from rosasync._client.latency import LatencyHistogram, summarize
from tests.support.echo import ECHO
from tests.support.serving import ask
from tests.support.times import TICK

if TYPE_CHECKING:
    from tests.support.servers import ServerProcess

ACCURACY = 1 / 64


def histogram(*durations: int) -> LatencyHistogram:
    result = LatencyHistogram()
    for duration in durations:
        result.add(duration)
    return result


# On a loaded machine one example may take seconds to draw.
@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.integers(0, 2**45), min_size=1, max_size=300))
def test_the_accuracy(durations: list[int]) -> None:
    found = summarize([histogram(*durations)])
    durations.sort()
    for percent, seconds in ((50, found.p50), (90, found.p90), (99, found.p99)):
        exact = durations[math.ceil(len(durations) * percent / 100) - 1] / 1e9
        assert seconds == pytest.approx(exact, rel=ACCURACY, abs=1e-15)
    assert found.max == durations[-1] / 1e9
    assert found.count == len(durations)


def test_every_duration_up_to_a_thousand() -> None:
    for duration in range(1000):
        seconds = summarize([histogram(duration, 10**12)]).p50
        assert seconds == pytest.approx(duration / 1e9, rel=ACCURACY, abs=1e-15)


def test_several_together() -> None:
    dice = random.Random(1)
    durations = [int(10 ** dice.uniform(3, 10)) for _ in range(3000)]
    parts = [histogram(*durations[:10]), histogram(), histogram(*durations[10:])]
    assert summarize(parts) == summarize([histogram(*durations)])


@pytest.mark.parametrize("empty", [[], [LatencyHistogram()]])
def test_none(empty: list[LatencyHistogram]) -> None:
    assert summarize(empty) == LatencyStatistics(0, 0.0, 0.0, 0.0, 0.0)


def test_memory_is_taken_for_new_powers_of_two_only() -> None:
    spread = histogram(*range(2**15, 2**16))
    assert list(spread.octaves) == [16]
    assert list(spread.octaves[16]) == [1024] * 32


# uvloop's own time stands still while callbacks run.
@pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])
async def test_the_statistics_of_a_session(session: Session, server: ServerProcess) -> None:
    await server.serve("/echo")
    await server.serve("/slow", delay=3 * TICK)
    await server.serve("/silent", delay="never")
    await session.wait_for_service(ECHO, "/slow")
    for number in range(20):
        await ask(session, "/echo", str(number))
    await asyncio.gather(*(ask(session, "/slow", str(number)) for number in range(3)))
    with pytest.raises(ResponseTimeout):
        await ask(session, "/silent", "x", timeout=TICK)
    pool = session.statistics().pool
    echo, slow, silent = (
        next(each.latency for key, each in pool.keys.items() if key.srv_name == name)
        for name in ("/echo", "/slow", "/silent")
    )
    assert (echo.count, slow.count, silent.count, pool.latency.count) == (20, 3, 0, 23)
    for latency in (echo, slow, pool.latency):
        assert 0 < latency.p50 <= latency.p90 <= latency.p99 <= latency.max
    # The server's delay is in it, and the failed call is not.
    assert slow.p50 >= 3 * TICK * (1 - ACCURACY)
    assert silent == LatencyStatistics()
    assert pool.latency.max == max(echo.max, slow.max)
