"""The calls that wait for a handler, and the tasks that wait for calls."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from contextlib import suppress
from typing import Generic

from rosasync._server.backlog import Backlog
from rosasync._server.overload import OverloadLog
from rosasync._server.service_call import ServiceCall
from rosasync._server.sizes import payload_size
from rosasync.typing import RequestT, ResponseT

__all__ = ["Intake"]


class Intake(Generic[RequestT, ResponseT]):
    """Calls that wait for a handler or an iterator. Confined to the loop's thread.

    Args:
        backlog: holds the calls, and decides which is next.
        log: counts and logs overloads.
        on_dropped: called with each call that is dropped because too many wait.

    Attributes:
        last_age: for how many seconds the call that was served last had waited.
    """

    def __init__(
        self,
        backlog: Backlog[ServiceCall[RequestT, ResponseT]],
        log: OverloadLog,
        on_dropped: Callable[[ServiceCall[RequestT, ResponseT]], None],
    ) -> None:
        self.last_age = 0.0
        self._loop = asyncio.get_running_loop()
        self._backlog = backlog
        self._log = log
        self._on_dropped = on_dropped
        self._closed = False
        # As in `asyncio.Queue`, a call is not handed to the task that waits: the task is woken, and
        # pops. So a task that is cancelled when it was just woken has no call to give back.
        self._getters: deque[asyncio.Future[None]] = deque()
        # How many tasks are in `get`, waiting or just woken.
        self._getting = 0

    def __len__(self) -> int:
        return len(self._backlog)

    @property
    def oldest_age(self) -> float:
        """For how many seconds the oldest call has waited; 0 if none waits."""
        return self._backlog.oldest_age(self._loop.time())

    def put(self, call: ServiceCall[RequestT, ResponseT], client: Hashable, waited: float) -> None:
        """Let a call wait, or drop one: this, or another.

        Args:
            call: the call.
            client: who sent it.
            waited: for how many seconds it has waited already.
        """
        backlog = self._backlog
        now = self._loop.time()
        size = payload_size(call.request)
        dropped = backlog.put(call, client, size, now, waited=waited, room=self._getting)
        self._log.update(
            backlog.standing or bool(dropped), len(dropped), len(backlog), backlog.oldest_age(now)
        )
        if call.trace is not None and call not in dropped:
            call.trace.enter("queued")
        self._wake_next()
        for other in dropped:
            self._on_dropped(other)

    def pop(self) -> ServiceCall[RequestT, ResponseT]:
        """Return the call to serve next. There must be one."""
        backlog = self._backlog
        now = self._loop.time()
        call = backlog.pop(now)
        self.last_age = backlog.last_age
        self._log.update(backlog.standing, 0, len(backlog), backlog.oldest_age(now))
        return call

    def remove(self, call: ServiceCall[RequestT, ResponseT]) -> bool:
        """Remove a call that waits, and return whether it did."""
        return self._backlog.remove(call)

    async def get(self) -> ServiceCall[RequestT, ResponseT] | None:
        """Wait for a call; None if the intake is closed."""
        self._getting += 1
        try:
            while not self._backlog:
                if self._closed:
                    return None
                await self._wait()
            return self.pop()
        finally:
            self._getting -= 1

    def clear(self) -> Sequence[ServiceCall[RequestT, ResponseT]]:
        """Remove all calls that wait, and return them in the order of their arrival."""
        return self._backlog.clear()

    def close(self) -> None:
        """End the iterators once no call is left; idempotent."""
        self._closed = True
        while self._getters and not self._loop.is_closed():
            self._wake_next()

    async def _wait(self) -> None:
        getter: asyncio.Future[None] = self._loop.create_future()
        self._getters.append(getter)
        try:
            await getter
        except BaseException:
            # The task was cancelled, or its coroutine closed.
            getter.cancel()
            with suppress(ValueError):
                self._getters.remove(getter)
            if self._backlog and not getter.cancelled():
                # It was woken for a call, which the next task gets now.
                self._wake_next()
            raise

    def _wake_next(self) -> None:
        while self._getters:
            getter = self._getters.popleft()
            if not getter.done():
                getter.set_result(None)
                return
