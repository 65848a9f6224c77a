"""One client on a fake port: sequence numbers, deadlines, and the state after a call ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from rosasync import Limits, Retry
from rosasync._client.call import Call
from rosasync._client.client import Client, Counts
from rosasync._client.retry import Attempts, RetryBudget
from rosasync._core.aio import Deadlines, Expired
from rosasync.statistics import ServiceKey
from rosasync.testing import FakeClient, FakeGraph, FakeNode
from tests.support.nodes import reports
from tests.support.times import TICK, until


class ClientUnderTest:
    """A client on a fake port, with the number of times it reported capacity."""

    def __init__(self, **limits: Any) -> None:
        self.node = FakeNode(FakeGraph())
        self.counts = Counts()
        self.capacity = 0
        self.callers = False
        self.client = Client(self._open, Limits(**limits), self.counts, self)
        self.budget = RetryBudget(self.counts, asyncio.get_running_loop().time)
        self._deadlines = Deadlines()

    def _open(self, deliver: Callable[[int, Any], None]) -> FakeClient:
        self.port = FakeClient(self.node, ServiceKey("/echo", ""), deliver)
        self.port.ready = lambda: True  # type: ignore[method-assign]
        self.node.clients.append(self.port)
        return self.port

    def is_matched(self, client: Client) -> bool:
        return client is self.client

    def on_capacity(self) -> None:
        self.capacity += 1

    def on_resend_waiting(self) -> None: ...

    def has_callers(self) -> bool:
        return self.callers

    async def call(self, deadline: float | None = None, retry: Retry | None = None) -> Any:
        """Call as on a lease, so that no lease of the client is released."""
        attempts = None if retry is None else Attempts(retry, self.budget)
        call = Call(asyncio.get_running_loop().create_future(), None, attempts, leased=True)
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


async def test_a_closed_client_starts_no_timer_for_a_late_response() -> None:
    under_test = ClientUnderTest()
    under_test.client.close()
    loop = asyncio.get_running_loop()
    before = len(loop._scheduled)  # type: ignore[attr-defined]
    under_test.client.expect_late(1)
    assert len(loop._scheduled) == before  # type: ignore[attr-defined]


async def test_responses_find_their_callers_in_any_order() -> None:
    tested = ClientUnderTest()
    tasks = [await tested.calling() for _ in range(3)]
    for number in (2, 3, 1):
        tested.port.deliver(number, f"answer {number}")
    assert await asyncio.gather(*tasks) == ["answer 1", "answer 2", "answer 3"]
    assert tested.client.abandoned == tested.counts.in_flight == 0
    assert tested.counts.peak == 3


async def test_a_passed_deadline_abandons_and_the_late_response_frees() -> None:
    tested = ClientUnderTest(in_flight=1)
    deadline = asyncio.get_running_loop().time() + TICK
    with pytest.raises(Expired):
        await tested.call(deadline)
    assert (tested.client.abandoned, tested.client.capacity) == (1, 0)
    assert not tested.client.is_idle
    tested.port.deliver(1, "late")
    assert (tested.client.abandoned, tested.client.capacity) == (0, 1)
    assert (tested.counts.late, tested.capacity) == (1, 1)


async def test_a_response_twice_is_late_once() -> None:
    tested = ClientUnderTest()
    task = await tested.calling()
    tested.port.deliver(1, "first")
    tested.port.deliver(1, "second")
    assert await task == "first"
    assert tested.counts.late == 1


async def test_an_answered_attempt_frees_those_before_it() -> None:
    tested = ClientUnderTest()
    task = await tested.calling(retry=Retry(3, TICK, 1.0))
    await until(lambda: len(tested.port.sent) == 3)
    tested.port.deliver(2, "second attempt")
    assert await task == "second attempt"
    assert tested.client.abandoned == 1  # The third; the first was before the second in the queue.
    tested.port.deliver(1, "first attempt")
    assert (tested.client.abandoned, tested.counts.late, tested.port.out) == (1, 1, {3})


async def test_a_send_that_fails_again_ends_the_call() -> None:
    tested = ClientUnderTest()
    task = await tested.calling(retry=Retry(2, TICK))

    def refuse(request: object) -> int:
        raise RuntimeError("the middleware is gone")

    tested.client.send = refuse
    with pytest.raises(RuntimeError, match="gone"):
        await task
    assert tested.counts.in_flight == 0


async def test_fail_ends_every_call_and_forgets_the_abandoned() -> None:
    tested = ClientUnderTest()
    tasks = [await tested.calling() for _ in range(3)]
    tasks[0].cancel()
    await asyncio.wait(tasks[:1])
    assert tested.client.abandoned == 1
    tested.client.fail(ZeroDivisionError)
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert [type(r) for r in results[1:]] == [ZeroDivisionError] * 2
    assert (tested.client.abandoned, tested.port.out) == (0, set())


async def test_close_is_idempotent_and_leaves_no_timer() -> None:
    tested = ClientUnderTest(grace=1000.0)
    task = await tested.calling()
    task.cancel()
    await asyncio.wait([task])
    timer = tested.client._timer
    assert timer is not None
    tested.client.close()
    tested.client.close()
    assert timer.cancelled()
    assert tested.port.closed
    assert repr(tested.client) == "<Client closed, 0 leases, 0 abandoned>"


async def test_a_request_expected_late_twice_is_forgotten_once() -> None:
    under_test = ClientUnderTest(grace=TICK)
    with reports() as reported:
        for _ in range(2):
            under_test.client.expect_late(1)
        forgotten: list[int] = []

        def forget(sequence_number: int) -> None:
            forgotten.append(sequence_number)

        under_test.port.forget = forget  # type: ignore[method-assign]
        await until(lambda: forgotten)
        await asyncio.sleep(TICK)
    assert (forgotten, reported) == ([1], [])
