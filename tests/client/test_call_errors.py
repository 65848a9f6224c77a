"""The errors of a service's calls: what they cost if many calls fail at once."""

from __future__ import annotations

from typing import Any

import pytest

from rosasync._client.call_errors import SHARED, CallErrors
from rosasync.testing._memory.graph import MemoryNode, MemoryQueries
from tests.support.fake_graph import FakeGraph
from tests.support.plain import Echo


class SlowQueries(MemoryQueries):
    """Queries of a graph so large that its description takes 8 ms."""

    def __init__(self, now: list[float]) -> None:
        super().__init__(FakeGraph())
        self._now = now
        self.explained = 0

    def explain_missing(self, service: Any) -> str:
        """Count the descriptions."""
        self._now[0] += 0.008
        self.explained += 1
        return f"description {self.explained}"


def errors_of(queries: SlowQueries, now: list[float]) -> CallErrors:
    service = MemoryNode(FakeGraph()).describe(Echo, "/echo", None)
    return CallErrors(service, queries, lambda: now[0])


@pytest.mark.parametrize("calls", [1, 100])
async def test_calls_that_time_out_together_share_one_description_of_the_graph(calls: int) -> None:
    now = [0.0]
    queries = SlowQueries(now)
    errors = errors_of(queries, now)
    for _ in range(calls):
        assert "description 1" in str(errors.unavailable(1.0))
    assert (queries.explained, now[0]) == (1, 0.008)
    now[0] += SHARED * 0.008
    assert "description 2" in str(errors.unavailable(1.0))


async def test_the_graph_is_described_anew_for_a_call_that_fails_later() -> None:
    now = [0.0]
    errors = errors_of(SlowQueries(now), now)
    for number in range(1, 4):
        assert f"description {number}" in str(errors.unavailable(1.0))
        now[0] += 1.0
