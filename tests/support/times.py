"""The unit of time of the tests: every delay, timeout and limit is a multiple of ``TICK``."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

import pytest

__all__ = ["LIMIT", "TICK", "count_timers", "until"]

TICK = 0.05
"""Seconds: much longer than a call (about 0.3 ms), much shorter than a test."""

LIMIT = 400 * TICK
"""Seconds after which a test gives up waiting. Long enough for a machine with other work."""


async def until(condition: Callable[[], object], limit: float = LIMIT) -> None:
    """Wait for a state that has no event of its own, such as a statistics counter.

    Args:
        condition: called in the loop every tenth of a tick until it returns something true.
        limit: seconds to wait.

    Raises:
        AssertionError: the condition did not become true in time.
    """
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, f"not within {limit:g} s: {condition}"
        await asyncio.sleep(TICK / 10)


def count_timers(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a list to which the time of each timer is added that is set in the running loop."""
    loop = asyncio.get_running_loop()
    call_at = loop.call_at
    timers: list[float] = []

    def count(when: float, *args: Any, **options: Any) -> asyncio.TimerHandle:
        timers.append(when)
        return call_at(when, *args, **options)

    monkeypatch.setattr(loop, "call_at", count)
    return timers
