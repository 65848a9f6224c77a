"""The scenarios of ``python -m benchmarks ticks``: trees whose leaves call services."""

from __future__ import annotations

from benchmarks.runner import Scenario
from benchmarks.work import Work

__all__ = ["describe_ticks", "make_ticks"]

ANSWERING = Work(server="lean")
PENDING = Work(server="lean", delays=(600.0,), depth=1000)
STOPPED = Work(server="stopped")

LEAVES = ("tick-running", "tick-py-trees", "tick-loop", "tick-threads", "tick-processes")
AGAIN = ("tick-py-trees", "tick-loop", "tick-thread", "tick-threads")
CALLING = ("tick-loop", "tick-thread", "tick-threads", "tick-processes")
AT_ONCE = ("tick-loop", "tick-thread", "tick-threads")

TITLES = {
    "tick": "one tick of a tree in which every leaf has a pending call",
    "again": "one tick of a tree whose leaves call a server that has stopped, and call again after "
    "each timeout",
    "state": "one read of the state of a pending call",
    "decide": "from a leaf's decision until the middleware has the request",
    "see": "from taking the response out of the middleware until a tick sees it, without pauses",
    "rate": "every leaf starts its next call in the tick that sees the response",
    "added": "threads and descriptors added by a pending call in every leaf",
}


def make_ticks() -> list[Scenario]:
    """Return the scenarios. A process for each call runs with one leaf, and once with 50."""
    return [
        _ticks("tick", 1, LEAVES),
        _ticks("tick", 100, LEAVES[:-1]),
        _ticks("tick", 1000, LEAVES[:-1]),
        _scenario("tick, server stopped", "again", 10, AGAIN, calls=1000, work=STOPPED),
        _ticks("state", 1, LEAVES[2:]),
        _scenario("decision to request sent", "decide", 1, CALLING, calls=500),
        _scenario("response to tick", "see", 1, CALLING, calls=500),
        _scenario("50 leaves", "rate", 50, AT_ONCE, calls=10_000, metric="rate"),
        _scenario("50 leaves, processes", "rate", 50, CALLING[-1:], calls=50, metric="rate"),
        _scenario("1000 leaves in use", "added", 1000, AT_ONCE, work=PENDING, metric="threads"),
    ]


def describe_ticks(measure: str, leaves: int) -> str:
    """Describe such a scenario in one line."""
    return f"{TITLES[measure]}, leaves: {leaves}"


def _ticks(measure: str, leaves: int, contestants: tuple[str, ...]) -> Scenario:
    key = "state of a pending call" if measure == "state" else f"tick, {leaves} pending"
    return _scenario(key, measure, leaves, contestants, calls=1000, work=PENDING)


def _scenario(
    key: str,
    measure: str,
    leaves: int,
    contestants: tuple[str, ...],
    *,
    calls: int = 0,
    work: Work = ANSWERING,
    metric: str = "median",
) -> Scenario:
    return Scenario(
        key,
        "50 leaves" if measure == "rate" else key,
        contestants,
        work,
        callers=leaves,
        calls=calls,
        seconds=60.0 if contestants == CALLING[-1:] else 2.0,
        action="tick",
        rounds=5 if contestants == CALLING[-1:] else 1000,
        metric=metric,
        measure=measure,
    )
