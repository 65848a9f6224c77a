"""Tasks that start at once: what runs when, and that a cancellation reaches them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from rosasync._core.aio import start_task

pytestmark = pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])


class Work:
    """Waits for a future, then for a turn, and records its steps."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.future: asyncio.Future[str] = self.loop.create_future()
        self.steps: list[str] = []

    async def run(self) -> None:
        self.steps.append("begun")
        try:
            self.steps.append(await self.future)
            await asyncio.sleep(0)
            self.steps.append("ended")
        except BaseException as error:
            self.steps.append(type(error).__name__)
            raise
        finally:
            self.steps.append("left")


async def test_it_runs_to_its_first_wait_at_once_and_goes_on_later() -> None:
    work = Work()
    task = start_task(work.loop, work.run())
    assert work.steps == ["begun"]
    work.future.set_result("answered")
    assert work.steps == ["begun"]
    await task
    assert work.steps == ["begun", "answered", "ended", "left"]


async def test_what_never_waits_has_run_already() -> None:
    steps: list[str] = []

    async def run() -> str:
        steps.append("begun")
        return "ended"

    task = start_task(asyncio.get_running_loop(), run())
    assert steps == ["begun"]
    assert await task == "ended"


async def test_an_error_before_the_first_wait_is_the_tasks() -> None:
    async def run() -> None:
        raise ValueError("no")

    task = start_task(asyncio.get_running_loop(), run())
    with pytest.raises(ValueError, match="no"):
        await task


async def test_a_cancellation_cannot_undo_what_has_ended() -> None:
    async def run() -> str:
        return "ended"

    task = start_task(asyncio.get_running_loop(), run())
    task.cancel()
    assert await task == "ended"


async def test_the_loops_task_factory_makes_the_task() -> None:
    loop = asyncio.get_running_loop()
    made: list[object] = []

    def factory(
        loop: asyncio.AbstractEventLoop, coroutine: Any, **options: Any
    ) -> asyncio.Task[Any]:
        made.append(coroutine)
        return asyncio.Task(coroutine, loop=loop, **options)

    loop.set_task_factory(factory)
    work = Work()
    task = start_task(loop, work.run())
    assert len(made) == 1
    assert "Work.run" in repr(task)
    work.future.set_result("answered")
    await task


async def test_it_may_wait_for_nothing_but_its_turn() -> None:
    steps: list[str] = []

    async def run() -> None:
        for _ in range(2):
            await asyncio.sleep(0)
        steps.append("ended")

    task = start_task(asyncio.get_running_loop(), run())
    await task
    assert steps == ["ended"]


async def no_turn() -> None:
    """The cancellation comes in the turn in which the work began."""


async def some_turns() -> None:
    for _ in range(3):
        await asyncio.sleep(0)


@pytest.mark.parametrize("wait", [no_turn, some_turns])
async def test_a_cancellation_reaches_it(
    wait: Callable[[], Awaitable[None]],
) -> None:
    work = Work()
    task = start_task(work.loop, work.run())
    await wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert work.steps == ["begun", "CancelledError", "left"]
    assert work.future.cancelled()


async def test_an_error_reaches_it_and_the_task() -> None:
    work = Work()
    task = start_task(work.loop, work.run())
    work.future.set_exception(ValueError("no"))
    with pytest.raises(ValueError, match="no"):
        await task
    assert work.steps == ["begun", "ValueError", "left"]


async def test_a_task_that_is_cancelled_after_it_failed_at_once_is_cancelled() -> None:
    async def fail() -> None:
        raise ValueError

    task = start_task(asyncio.get_running_loop(), fail())
    task.cancel()
    await asyncio.wait([task])
    assert task.cancelled()
