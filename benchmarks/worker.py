"""The process of one contestant, controlled by the runner: ``python -m benchmarks.worker KEY``."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

from benchmarks.contestants import Contestant, Tally, make_contestant
from benchmarks.contestants.base import LoggedCall, Logging, Mixing, Soaking
from benchmarks.meter import Usage, resident_bytes, usage
from benchmarks.ticking import Ticking
from benchmarks.work import Work
from tests.support.child import serve_commands

MARGIN = 0.5
"""Seconds at the start and at the end of a rest that are not measured."""
SOAK_STATES = (10_000, 100_000)
"""The numbers of calls after which memory is measured."""


class Worker:
    def __init__(self, key: str) -> None:
        self._contestant: Contestant = make_contestant(key)

    def setup(self, work: dict[str, Any]) -> None:
        self._contestant.setup(Work.from_json(work))

    def call(
        self, callers: int, calls: int, seconds: float, begin: float | None = None
    ) -> dict[str, Any]:
        """Call, from a time on the monotonic clock on if one is given."""
        if begin is not None:
            self._contestant.rest(max(0.0, begin - time.monotonic()))
        before = usage()
        if callers == 1:
            tally = self._contestant.one_at_a_time(calls, seconds)
        else:
            tally = self._contestant.at_once(callers, calls, seconds)
        return _result(tally, usage() - before)

    def log(self, callers: int, seconds: float) -> list[LoggedCall]:
        """Call, and answer with every single call."""
        return cast(Logging, self._contestant).logged(callers, seconds)

    def beside(self, plain: int, retried: int) -> list[tuple[bool, bool]]:
        return cast(Mixing, self._contestant).beside(plain, retried)

    def rest(self, seconds: float) -> dict[str, Any]:
        """Rest, and measure without the first and the last moments."""
        with ThreadPoolExecutor(1) as thread:
            used = thread.submit(_usage_within, seconds)
            self._contestant.rest(seconds + 2 * MARGIN)
            return _result(Tally(elapsed=round(seconds * 1e9)), used.result())

    def soak(self) -> dict[str, Any]:
        before, done = usage(), 0
        tally, memory = Tally(), []
        for calls in SOAK_STATES:
            tally = cast(Soaking, self._contestant).soak(calls - done)
            done = calls
            memory.append(resident_bytes())
        return {**_result(tally, usage() - before), "memory": memory}

    def tick(self, measure: str, leaves: int, calls: int, seconds: float) -> dict[str, Any]:
        before = usage()
        tally = cast(Ticking, self._contestant).tick(measure, leaves, calls, seconds)
        return {**_result(tally, usage() - before), "added": tally.added}

    def close(self) -> None:
        self._contestant.close()


def _usage_within(seconds: float) -> Usage:
    time.sleep(MARGIN)
    before = usage()
    time.sleep(seconds)
    return usage() - before


def _result(tally: Tally, used: Usage) -> dict[str, Any]:
    return {
        "samples": tally.samples,
        "elapsed": tally.elapsed,
        "lost": tally.lost,
        "failed": tally.failed,
        "problem": tally.error,
        "client": used.to_json(),
    }


if __name__ == "__main__":
    serve_commands(Worker(sys.argv[1]))
