"""A process that sends goals from a host of its own: ``python -m tests.faults.actor``."""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Coroutine
from typing import Any, TypeVar

from test_msgs.action import Fibonacci

from rosasync import Session
from tests.support.child import serve_commands
from tests.support.process import NodeProcess
from tests.support.times import LIMIT

__all__ = ["ActorProcess"]

T = TypeVar("T")


class ActorProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.faults.actor"
    stock = False

    async def open_session(self, bridge: str) -> None:
        """Open its session."""
        await self.ask("open_session", bridge=bridge)

    async def act(self, name: str, goals: int) -> None:
        """Begin to await so many goals; returns at once."""
        await self.ask("act", name=name, goals=goals)

    async def leave(self, goals: int) -> None:
        """Cancel the tasks of the last so many goals."""
        await self.ask("leave", goals=goals)

    async def ends(self) -> dict[str, int]:
        """Wait for the ends of all goals; count them by the error, or ``result``."""
        ends: dict[str, int] = await self.ask("ends")
        return ends

    async def close_session(self) -> None:
        """Close its session."""
        await self.ask("close_session")


class _Actor:
    """The child's side: a loop in a thread of its own."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._tasks: list[asyncio.Task[str]] = []

    def open_session(self, bridge: str) -> None:
        self._session = Session("actor", bridge=bridge, timeout=3 * LIMIT)  # type: ignore[arg-type]
        self._run(self._session.open())

    def act(self, name: str, goals: int) -> None:
        async def start() -> None:
            self._tasks.extend(asyncio.create_task(self._act(name)) for _ in range(goals))

        self._run(start())

    def leave(self, goals: int) -> None:
        async def cancel() -> None:
            for task in self._tasks[-goals:]:
                task.cancel()

        self._run(cancel())

    def ends(self) -> dict[str, int]:
        async def wait() -> list[str]:
            return await asyncio.gather(*self._tasks)

        return dict(Counter(self._run(wait())))

    def close_session(self) -> None:
        self._run(self._session.aclose())

    def end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _act(self, name: str) -> str:
        try:
            await self._session.act(Fibonacci, name)
        except (Exception, asyncio.CancelledError) as error:
            return type(error).__name__
        return "result"

    def _run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(3 * LIMIT)


def main() -> None:
    actor = _Actor()
    serve_commands(actor)
    actor.end()


if __name__ == "__main__":
    main()
