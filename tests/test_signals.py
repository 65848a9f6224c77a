"""The eventfds that the loop watches: at once, or in intervals while they are busy."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable

import pytest

from rosasync._ros import signals
from rosasync._ros.signals import PacedSignal, Signal, Signals
from rosasync.testing import VirtualClock

PAUSE = 60.0
MEMBER = "member"


class Taker:
    """Notes what is taken, and may do something else then."""

    def __init__(self) -> None:
        self.taken: list[int] = []
        self.on_take: Callable[[], object] = lambda: None

    def __call__(self, signal: Signal[str], signalled: int) -> None:
        self.taken.append(signalled)
        self.on_take()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> VirtualClock:
    monkeypatch.setattr(signals, "PAUSE", PAUSE)
    return VirtualClock()


@pytest.fixture
def taker() -> Taker:
    return Taker()


@pytest.fixture
async def paced(clock: VirtualClock, taker: Taker) -> AsyncIterator[Signal[str]]:
    group: Signals[str] = Signals(asyncio.get_running_loop(), taker, PacedSignal)
    yield group.join(MEMBER)
    group.close()


async def write(signal: Signal[str], count: int = 1) -> None:
    """Signal, and let the loop look at it, if it does so without a timer."""
    for _ in range(count):
        os.eventfd_write(signal.fd, 1)
    for _ in range(5):
        await asyncio.sleep(0)


async def test_a_signal_after_a_pause_is_taken_at_once(
    clock: VirtualClock, paced: Signal[str], taker: Taker
) -> None:
    for expected in range(1, 4):
        await write(paced)
        assert taker.taken == [1] * expected
        await clock.advance(PAUSE)


async def test_those_that_come_in_quick_succession_are_taken_together(
    clock: VirtualClock, paced: Signal[str], taker: Taker
) -> None:
    await write(paced)
    await write(paced)
    await write(paced, 3)
    await write(paced, 4)
    assert taker.taken == [1, 1]
    await clock.advance(PAUSE)
    assert taker.taken == [1, 1, 7]
    await write(paced, 2)
    assert taker.taken == [1, 1, 7]
    await clock.advance(PAUSE)
    assert taker.taken == [1, 1, 7, 2]


async def test_it_is_watched_again_once_it_is_quiet(
    clock: VirtualClock, paced: Signal[str], taker: Taker
) -> None:
    await write(paced)
    await write(paced)
    await clock.advance(PAUSE)
    await write(paced)
    assert taker.taken == [1, 1, 1]


@pytest.mark.parametrize("quick", [False, True])
async def test_what_is_taken_may_close_the_signal(
    clock: VirtualClock, taker: Taker, quick: bool
) -> None:
    group: Signals[str] = Signals(asyncio.get_running_loop(), taker, PacedSignal)
    first, second = group.join("first"), group.join("second")
    if quick:
        await write(second)
        await write(second)
    taker.on_take = lambda: group.leave("second", second)
    await write(second)
    await clock.advance(2 * PAUSE)
    assert taker.taken
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.eventfd_write(second.fd, 1)
    assert first.members
    group.close()
