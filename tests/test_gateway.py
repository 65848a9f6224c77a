"""The gateway into the loop: order, batches, ends, and a collector that runs at any moment."""

from __future__ import annotations

import asyncio
import gc
import threading
import weakref
from typing import Any

import pytest

from rosasync import SessionClosed
from rosasync._core.gateway import LoopGateway
from tests.support.fake_graph import FakeGraph
from tests.support.times import LIMIT, until


class Operation:
    """An operation that another thread waits for."""

    def __init__(self) -> None:
        self.error: Exception | None = None

    def fail(self, error: Exception) -> None:
        self.error = error


class CollectingLoop:
    """A loop in whose `call_soon_threadsafe` the last reference to something is dropped."""

    def __init__(self, loop: asyncio.AbstractEventLoop, kept: list[Any]) -> None:
        self._loop = loop
        self._kept = kept

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loop, name)

    def call_soon_threadsafe(self, callback: Any, *args: Any) -> object:
        self._kept.clear()
        gc.collect()
        return self._loop.call_soon_threadsafe(callback, *args)


async def test_callbacks_of_each_thread_run_in_order_on_the_loops_thread() -> None:
    gateway = LoopGateway()
    loop_thread = threading.get_ident()
    ran: list[tuple[int, int]] = []

    def callback(thread: int, number: int) -> None:
        assert threading.get_ident() == loop_thread
        ran.append((thread, number))

    def post(thread: int) -> None:
        for number in range(100):
            gateway.post(callback, thread, number)

    await asyncio.gather(*(asyncio.to_thread(post, thread) for thread in range(4)))
    await until(lambda: len(ran) == 400)
    for thread in range(4):
        assert [n for t, n in ran if t == thread] == list(range(100))


async def test_a_callback_that_raises_does_not_end_the_others() -> None:
    gateway = LoopGateway()
    reported: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: reported.append(context))
    ran: list[int] = []

    def fail() -> None:
        raise ValueError("no")

    gateway.post(fail)
    gateway.post(ran.append, 1)
    await until(lambda: ran)
    assert [type(context["exception"]) for context in reported] == [ValueError]


async def test_the_end_fails_operations_and_drops_callbacks() -> None:
    gateway = LoopGateway()
    unfinished, finished = Operation(), Operation()
    gateway.register(unfinished)
    gateway.register(finished)
    gateway.discard(finished)
    ran: list[int] = []
    gateway.post(ran.append, 1)
    gateway.close()
    gateway.close()
    assert isinstance(unfinished.error, SessionClosed)
    assert finished.error is None
    assert gateway.pending == 0
    with pytest.raises(SessionClosed):
        gateway.post(ran.append, 2)
    gateway.post_if_open(ran.append, 3)
    await asyncio.sleep(0)
    assert ran == []


async def test_a_session_collected_inside_post_does_not_block_the_thread() -> None:
    session = FakeGraph().session()
    await session.__aenter__()
    gateway = session.core.gateway
    gateway.loop = CollectingLoop(gateway.loop, [session])  # type: ignore[assignment]
    del session

    async def post_in_a_thread() -> None:
        posting = threading.Thread(target=gateway.post_if_open, args=(print,), daemon=True)
        posting.start()
        await asyncio.to_thread(posting.join, LIMIT)
        assert not posting.is_alive()
        await until(lambda: gateway.closed)

    with pytest.warns(ResourceWarning, match="unclosed"):
        await post_in_a_thread()


async def test_a_gateway_closed_inside_post_takes_nothing() -> None:
    gateway = LoopGateway()
    loop = gateway.loop

    class ClosingLoop(CollectingLoop):
        def call_soon_threadsafe(self, callback: Any, *args: Any) -> object:
            gateway.close()
            return self._loop.call_soon_threadsafe(callback, *args)

    gateway.loop = ClosingLoop(loop, [])  # type: ignore[assignment]
    ran: list[int] = []
    with pytest.raises(SessionClosed):
        gateway.post(ran.append, 1)
    await asyncio.sleep(0)
    assert ran == []


def test_what_a_closed_loop_has_not_run_is_dropped() -> None:
    """The executor thread refers to the gateway, and a callback may refer to the session."""

    class Referred:
        def callback(self) -> None:
            raise AssertionError("never called")

    async def make() -> LoopGateway:
        return LoopGateway()

    loop = asyncio.new_event_loop()
    gateway = loop.run_until_complete(make())
    referred = Referred()
    reference = weakref.ref(referred)
    gateway.post(referred.callback)
    del referred
    assert reference() is not None
    loop.close()
    gc.collect()
    assert reference() is None
    with pytest.raises(SessionClosed):
        gateway.post(print)
