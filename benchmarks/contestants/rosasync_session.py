"""rosasync: a session and its bound clients."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from functools import partial
from typing import Any, Literal

import uvloop

import rosasync
from benchmarks.contestants.base import Asynchronous, Tally
from benchmarks.work import (
    READY_TIMEOUT,
    Work,
    load_type,
    make_handler,
    make_qos,
    make_request,
)

SOAKING_CALLERS = 9
SOAKING_TIMEOUT = 0.001


class Rosasync(Asynchronous):
    def __init__(
        self,
        bridge: Literal["direct", "executor"],
        loop_factory: Callable[[], asyncio.AbstractEventLoop] | None = None,
        limits: rosasync.Limits | None = None,
        busy_poll: float = 0.0,
        retry: rosasync.Retry | None = None,
    ) -> None:
        self._bridge = bridge
        self.loop_factory = loop_factory
        self._limits = limits or rosasync.Limits()
        self._busy_poll = busy_poll
        self._retry = retry

    async def open(self, work: Work) -> None:
        srv_type = load_type(work.srv_type)
        qos = None if work.depth is None else make_qos(work.depth)
        self._stack = AsyncExitStack()
        session: Any = await self._stack.enter_async_context(
            rosasync.Session(
                "bench",
                bridge=self._bridge,
                limits=self._limits,
                timeout=work.timeout,
                busy_poll=self._busy_poll,
            )
        )
        if work.server == "inside":
            for name in work.names:
                session.serve(srv_type, name, make_handler(work), qos=qos)
        self._clients = [session.client(srv_type, name, qos=qos) for name in work.names]
        for client in self._clients:
            await client.wait(READY_TIMEOUT)
        await asyncio.gather(*(session.pool.warm(srv_type, name) for name in work.idle_names))
        self._request = make_request(work)

    async def call(self, service: int) -> None:
        await self._clients[service].call(self._request, retry=self._retry)

    async def shut(self) -> None:
        await self._stack.aclose()

    def beside(self, plain: int, retried: int) -> list[tuple[bool, bool]]:
        return self.runner.run(self._beside(plain, retried))

    async def _beside(self, plain: int, retried: int) -> list[tuple[bool, bool]]:
        kinds = [True] * retried + [False] * plain
        calls = (
            self._clients[0].call(self._request, retry=self._retry if kind else None)
            for kind in kinds
        )
        ends = await asyncio.gather(*calls, return_exceptions=True)
        return [
            (kind, not isinstance(end, BaseException))
            for kind, end in zip(kinds, ends, strict=True)
        ]

    def soak(self, calls: int) -> Tally:
        """Make calls: a third is answered, a third times out, and a third is cancelled."""
        return self.runner.run(self._soak(calls))

    async def _soak(self, calls: int) -> Tally:
        tally = Tally()
        share = range(calls // SOAKING_CALLERS)
        with tally.timed():
            async with asyncio.TaskGroup() as group:
                for i in range(SOAKING_CALLERS):
                    group.create_task((self._answer, self._expire, self._cancel)[i % 3](share))
        return tally

    async def _answer(self, calls: range) -> None:
        for _ in calls:
            await self._clients[0].call(self._request)

    async def _expire(self, calls: range) -> None:
        """Let every call time out; repeat a call that is answered first."""
        for _ in calls:
            with suppress(rosasync.CallError):
                while True:
                    await self._clients[1].call(self._request, timeout=SOAKING_TIMEOUT)

    async def _cancel(self, calls: range) -> None:
        """Cancel every call; repeat a call that is answered first."""
        for _ in calls:
            cancelled = False
            while not cancelled:
                task = self._clients[1].start(self._request)
                await asyncio.sleep(SOAKING_TIMEOUT)
                task.cancel()
                await asyncio.wait([task])
                cancelled = task.cancelled()


BUSY_POLL = 0.001
_exclusive = rosasync.Limits(clients=8, in_flight=1)
_retry = rosasync.Retry(attempts=10, after=0.2, backoff=1.0)

CONTESTANTS = {
    "direct": partial(Rosasync, "direct"),
    "direct-uvloop": partial(Rosasync, "direct", uvloop.new_event_loop),
    "direct-exclusive": partial(Rosasync, "direct", None, _exclusive),
    "direct-retry": partial(Rosasync, "direct", retry=_retry),
    "direct-busy": partial(Rosasync, "direct", busy_poll=BUSY_POLL),
    "direct-busy-uvloop": partial(Rosasync, "direct", uvloop.new_event_loop, busy_poll=BUSY_POLL),
    "executor": partial(Rosasync, "executor"),
    "executor-uvloop": partial(Rosasync, "executor", uvloop.new_event_loop),
}
