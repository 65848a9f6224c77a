"""One client on a fake port: its calls, the responses it delivers, and what it leaves behind."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from rosasync import Limits, Retry
from rosasync._client.call import Call
from rosasync._client.client import Client
from rosasync._client.counts import Counts
from rosasync._client.retry import Plan, RetryBudget
from rosasync._client.sent import Sent
from rosasync._core.aio import Deadlines, Expired
from rosasync._status.listener import Listener
from rosasync.statistics import ServiceKey
from rosasync.testing._memory.graph import MemoryNode, new_identity
from rosasync.testing._memory.services import MemoryClient
from tests.support.fake_graph import FakeGraph
from tests.support.nodes import reports
from tests.support.times import TICK, until


class ClientUnderTest:
    """A client on a fake port, and a dispatch that sends again at once."""

    def __init__(self, **limits: Any) -> None:
        self.node = MemoryNode(FakeGraph())
        self.counts = Counts()
        self.queue: list[object] = []
        self.passed: list[object] = []
        self.resends: list[Call] = []
        self.leased: list[object] = []
        self.reported = 0
        self.dropped: list[Client] = []
        listener = Listener(self.node)
        self.client = Client(self._open, Limits(**limits), self.counts, self, listener)
        self.budget = RetryBudget(self.counts, asyncio.get_running_loop().time)
        self._deadlines = Deadlines()

    def _open(self, deliver: Callable[[int, Any], None]) -> MemoryClient:
        key, identity = ServiceKey("/echo", ""), new_identity(self.node.process)
        self.port = MemoryClient(self.node.graph, key, deliver, identity)
        return self.port

    # The owner of the client.

    def schedule(self) -> None:
        self.reported += 1

    on_places = schedule

    def send_again(self, call: Call) -> None:
        call.send_again(asyncio.get_running_loop().time())

    def make_response(self, value: object) -> Any:
        return value

    def check_servers(self) -> None:
        """Nothing: there are none."""

    def callers_wait(self) -> bool:
        return bool(self.queue)

    def next_resend(self, client: Client) -> Sent | None:
        return None

    def drop(self, client: Client) -> None:
        self.dropped.append(client)

    async def call(self, deadline: float | None = None, retry: Retry | None = None) -> Any:
        """Call as `ServicePool.call` does if there is a free place."""
        loop = asyncio.get_running_loop()
        plan = None if retry is None else Plan(retry, self.budget)
        call = Call(self, loop.create_future(), None, plan)
        call.start(self.client, loop.time())
        try:
            await self._deadlines.wait(call.future, deadline)
            return call.future.result()
        finally:
            if call.in_flight:
                call.end(loop.time())

    async def calling(self, **options: Any) -> asyncio.Task[Any]:
        task = asyncio.create_task(self.call(**options))
        sent = len(self.port.sent)
        await until(lambda: len(self.port.sent) > sent)
        return task


async def test_responses_find_their_callers_in_any_order() -> None:
    tested = ClientUnderTest()
    tasks = [await tested.calling() for _ in range(3)]
    for number in (2, 3, 1):
        tested.port.deliver(number, f"answer {number}")
    assert await asyncio.gather(*tasks) == ["answer 1", "answer 2", "answer 3"]
    assert (tested.client.window.taken, tested.counts.in_flight, tested.counts.peak) == (0, 0, 3)


async def test_a_passed_deadline_abandons_and_the_late_response_frees() -> None:
    tested = ClientUnderTest(in_flight=1)
    deadline = asyncio.get_running_loop().time() + TICK
    with pytest.raises(Expired):
        await tested.call(deadline)
    assert (len(tested.client.window.abandoned), tested.client.window.free) == (1, 0)
    assert not tested.client.is_idle
    before = tested.reported
    tested.port.deliver(1, "late")
    assert (len(tested.client.window.abandoned), tested.client.window.free) == (0, 1)
    assert (tested.counts.late, tested.reported) == (1, before + 1)


async def test_a_response_twice_is_late_once() -> None:
    tested = ClientUnderTest()
    task = await tested.calling()
    tested.port.deliver(1, "first")
    tested.port.deliver(1, "second")
    assert await task == "first"
    assert tested.counts.late == 1


async def test_a_response_to_what_was_never_sent_is_ignored() -> None:
    tested = ClientUnderTest(in_flight=2)
    tasks = [await tested.calling() for _ in range(2)]
    tasks[0].cancel()
    await asyncio.wait(tasks[:1])
    tested.port.deliver(2**62, "forged")
    assert (len(tested.client.window.abandoned), tested.client.window.answered) == (1, 0)
    assert tested.counts.late == 0
    tested.port.deliver(2, "real")
    assert await tasks[1] == "real"
    assert tested.client.is_idle


async def test_an_answered_attempt_frees_those_before_it() -> None:
    tested = ClientUnderTest()
    task = await tested.calling(retry=Retry(3, TICK, 1.0))
    await until(lambda: len(tested.port.sent) == 3)
    tested.port.deliver(2, "second attempt")
    assert await task == "second attempt"
    # The third is abandoned; the first was before the second in the queue.
    assert list(tested.client.window.abandoned) == [3]
    tested.port.deliver(1, "first attempt")
    assert (tested.counts.late, tested.port.out) == (1, {3})


async def test_a_send_that_fails_again_ends_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    tested = ClientUnderTest()
    task = await tested.calling(retry=Retry(2, TICK))

    def refuse(request: object) -> int:
        raise RuntimeError("the middleware is gone")

    monkeypatch.setattr(tested.port, "send", refuse)
    with pytest.raises(RuntimeError, match="gone"):
        await task
    assert tested.counts.in_flight == 0


async def test_fail_ends_every_call_and_forgets_the_abandoned() -> None:
    tested = ClientUnderTest()
    tasks = [await tested.calling() for _ in range(3)]
    tasks[0].cancel()
    await asyncio.wait(tasks[:1])
    tested.client.fail(ZeroDivisionError)
    results = await asyncio.gather(*tasks, return_exceptions=True)
    assert [type(r) for r in results[1:]] == [ZeroDivisionError] * 2
    assert (tested.client.window.sent, tested.port.out) == ({}, set())


async def test_close_is_idempotent_and_leaves_no_timer(pending_timers: Callable[[], int]) -> None:
    tested = ClientUnderTest(grace=1000.0)
    before = pending_timers()
    task = await tested.calling()
    task.cancel()
    await asyncio.wait([task])
    assert pending_timers() > before
    tested.client.close()
    tested.client.close()
    assert pending_timers() == before
    assert tested.port.closed
    assert repr(tested.client) == (
        "<Client closed, 0 calls, <Window 0/10 places, 0 leases, 0 abandoned>>"
    )


async def test_a_call_that_outlives_its_client_starts_no_timer(
    pending_timers: Callable[[], int],
) -> None:
    tested = ClientUnderTest()
    task = await tested.calling()
    before = pending_timers()
    tested.client.close()
    task.cancel()
    await asyncio.wait([task])
    assert pending_timers() <= before


async def test_a_late_response_is_no_longer_expected_after_the_grace_period() -> None:
    tested = ClientUnderTest(grace=TICK)
    with reports() as reported:
        task = await tested.calling()
        task.cancel()
        await asyncio.wait([task])
        assert tested.port.out == {1}
        await until(lambda: not tested.port.out)
        assert tested.client.is_idle
        await asyncio.sleep(TICK)
    assert reported == []


@pytest.fixture
async def pending_timers() -> Callable[[], int]:
    """Counts the timers of the loop."""
    loop: Any = asyncio.get_running_loop()
    return lambda: sum(not timer.cancelled() for timer in loop._scheduled)
