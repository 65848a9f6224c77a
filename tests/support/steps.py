"""Cancel a call at a chosen await, and at a chosen moment of that await."""

from __future__ import annotations

import asyncio
import itertools
import types
from collections.abc import AsyncIterator, Callable, Coroutine, Generator
from typing import Any, Literal, TypeVar, get_args

__all__ = ["MOMENTS", "Moment", "Victim", "every_victim"]

T = TypeVar("T")

Moment = Literal["as it suspends", "in the next turn", "as it wakes"]
"""When the cancellation comes: before the loop has seen the await, in the turn after, or when what
is awaited is done but the task has not been resumed."""

MOMENTS: tuple[Moment, ...] = get_args(Moment)


class Victim:
    """A task that runs a coroutine and is cancelled at one of its awaits.

    Args:
        coroutine: the coroutine to run.
        suspension: the number of the await, counted from 0.
        moment: when in that await to cancel.
    """

    def __init__(self, coroutine: Coroutine[Any, Any, Any], suspension: int, moment: Moment):
        self.cancelled = False
        self.suspensions = 0
        self._target = suspension
        self.moment = moment
        self.task = asyncio.get_running_loop().create_task(_run(coroutine, self._suspended))

    def __repr__(self) -> str:
        return f"<Victim await {self._target}, {self.moment}>"

    def _suspended(self, awaited: Any) -> None:
        number, self.suspensions = self.suspensions, self.suspensions + 1
        if number != self._target:
            return
        if self.moment == "as it suspends":
            self._cancel()
        elif self.moment == "in the next turn" or awaited is None:
            self.task.get_loop().call_soon(self._cancel)
        else:
            awaited.add_done_callback(lambda _: self._cancel())

    def _cancel(self) -> None:
        if not self.task.done():
            self.cancelled = True
            self.task.cancel()


async def every_victim(
    make: Callable[[], Coroutine[Any, Any, Any]],
    moments: tuple[Moment, ...] = MOMENTS,
) -> AsyncIterator[Victim]:
    """Yield a victim for each moment of each await, until the call has no further await.

    Args:
        make: makes the coroutine of the next victim, which starts when the victim is yielded.
        moments: the moments to try at each await.
    """
    for suspension in itertools.count():
        cancelled = False
        for moment in moments:
            victim = Victim(make(), suspension, moment)
            yield victim
            assert victim.task.done(), "the test has to wait for its victim"
            cancelled = cancelled or victim.cancelled
        if not cancelled:
            assert suspension > 0, "the call never waits, so nothing was tested"
            return


async def _run(coroutine: Coroutine[Any, Any, T], suspended: Callable[[Any], None]) -> T:
    # From Python 3.12 on, a task does not take the generator of a `types.coroutine`.
    return await _watched(coroutine, suspended)


@types.coroutine
def _watched(
    coroutine: Coroutine[Any, Any, T], suspended: Callable[[Any], None]
) -> Generator[Any, Any, T]:
    """Run a coroutine as ``await`` does, and report what it waits for at each suspension."""
    try:
        awaited = coroutine.send(None)
        while True:
            suspended(awaited)
            try:
                value = yield awaited
            except BaseException as error:
                awaited = coroutine.throw(error)
            else:
                awaited = coroutine.send(value)
    except StopIteration as end:
        result: T = end.value
        return result
