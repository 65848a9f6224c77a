"""Coroutines that begin in the turn that asks for them, not in the loop's next."""

from __future__ import annotations

import asyncio
import sys
import types
from collections.abc import Coroutine, Generator
from typing import Any

__all__ = ["begin"]

Work = Coroutine[Any, Any, None]


def begin(loop: asyncio.AbstractEventLoop, work: Work) -> asyncio.Task[None] | None:
    """Run a coroutine up to its first suspension, and the rest of it as a task.

    To be called on the thread of a running loop. To cancel the task, call its ``cancel`` in a
    later turn (``loop.call_soon``): before Python 3.12 it could not be heard in this one.

    Returns:
        The task, or None where there was nothing to wait for.
    """
    if sys.version_info >= (3, 12):
        task = asyncio.Task(work, loop=loop, eager_start=True)
        return None if task.done() else task
    try:
        awaited = work.send(None)
    except StopIteration:
        return None
    return loop.create_task(_resume(work, awaited))


@types.coroutine
def _resume(work: Work, awaited: Any) -> Generator[Any, Any, None]:
    """Go on with a coroutine that waits for what it has yielded already."""
    try:
        while True:
            try:
                value = yield awaited
            except BaseException as error:
                awaited = work.throw(error)
            else:
                awaited = work.send(value)
    except StopIteration:
        return
