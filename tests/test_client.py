"""One client on a fake port: sequence numbers, deadlines, what an ended call leaves."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from rosasync import Limits, Retry
from rosasync.aio import Deadlines, Expired
from rosasync.call import Call
from rosasync.client import Client, Counts
from rosasync.statistics import ServiceKey
from rosasync.testing import FakeClient, FakeGraph, FakeNode
from tests.support.times import TICK, until


class Rig:
    """A client, the fake port below it, and how often it reported capacity."""

    def __init__(self, **limits: Any) -> None:
        self.node = FakeNode(FakeGraph())
        self.counts = Counts()
        self.capacity = 0
        self.client = Client(self._open, Limits(**limits), self.counts, self._on_capacity)
        self._deadlines = Deadlines()

    def _open(self, deliver: Callable[[int, Any], None]) -> FakeClient:
        self.port = FakeClient(self.node, ServiceKey("/echo", ""), deliver)
        self.node.clients.append(self.port)
        return self.port

    def _on_capacity(self) -> None:
        self.capacity += 1

    async def call(self, deadline: float | None = None, retry: Retry | None = None) -> Any:
        """Call in the place of a lease that is held elsewhere."""
        call = Call(asyncio.get_running_loop().create_future(), None, retry, leased=True)
        call.start(self.client)
        if deadline is not None:
            self._deadlines.set(call.future, deadline)
        try:
            return await call.future
        finally:
            if call.in_flight:
                call.end()

    async def calling(self, **options: Any) -> asyncio.Task[Any]:
        task = asyncio.create_task(self.call(**options))
        sent = len(self.port.sent)
        await until(lambda: len(self.port.sent) > sent)
        return task


async def test_responses_find_their_callers_in_any_order() -> None:
    rig = Rig()
    tasks = [await rig.calling() for _ in range(3)]
    for number in (2, 3, 1):
        rig.port.deliver(number, f"answer {number}")
    assert await asyncio.gather(*tasks) == ["answer 1", "answer 2", "answer 3"]
    assert rig.client.abandoned == rig.counts.in_flight == 0
    assert rig.counts.peak == 3


async def test_a_passed_deadline_abandons_and_the_late_response_frees() -> None:
    rig = Rig(in_flight=1)
    deadline = asyncio.get_running_loop().time() + TICK
    with pytest.raises(Expired):
        await rig.call(deadline)
    assert (rig.client.abandoned, rig.client.capacity) == (1, 0)
    assert not rig.client.is_idle
    rig.port.deliver(1, "late")
    assert (rig.client.abandoned, rig.client.capacity, rig.counts.late, rig.capacity) == (
        0,
        1,
        1,
        1,
    )


async def test_a_response_twice_is_late_once() -> None:
    rig = Rig()
    task = await rig.calling()
    rig.port.deliver(1, "first")
    rig.port.deliver(1, "second")
    assert await task == "first"
    assert rig.counts.late == 1


async def test_an_answered_attempt_frees_those_before_it() -> None:
    rig = Rig()
    task = await rig.calling(retry=Retry(3, TICK, 1.0))
    await until(lambda: len(rig.port.sent) == 3)
    rig.port.deliver(2, "second attempt")
    assert await task == "second attempt"
    assert rig.client.abandoned == 1  # The third; the first was before the second in the queue.
    rig.port.deliver(1, "first attempt")
    assert (rig.client.abandoned, rig.counts.late, rig.port.out) == (1, 1, {3})


async def test_a_send_that_fails_again_ends_the_call() -> None:
    rig = Rig()
    task = await rig.calling(retry=Retry(2, TICK))

    def refuse(request: object) -> int:
        raise RuntimeError("the middleware is gone")

    rig.client.send = refuse
    with pytest.raises(RuntimeError, match="gone"):
        await task
    assert rig.counts.in_flight == 0


async def test_fail_ends_every_call_and_forgets_the_abandoned() -> None:
    rig = Rig()
    tasks = [await rig.calling() for _ in range(3)]
    tasks[0].cancel()
    await asyncio.wait(tasks[:1])
    assert rig.client.abandoned == 1
    rig.client.fail(ZeroDivisionError)
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert [type(r) for r in results[1:]] == [ZeroDivisionError] * 2
    assert (rig.client.abandoned, rig.port.out) == (0, set())


async def test_close_is_idempotent_and_leaves_no_timer() -> None:
    rig = Rig(grace=1000.0)
    task = await rig.calling()
    task.cancel()
    await asyncio.wait([task])
    timer = rig.client._grace_timer
    assert timer is not None
    rig.client.close()
    rig.client.close()
    assert timer.cancelled()
    assert rig.port.closed
    assert repr(rig.client) == "<Client closed, 0 leases, 0 abandoned>"
