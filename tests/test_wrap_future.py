"""``wrap_future``: any rclpy future, awaited in asyncio."""

from __future__ import annotations

import asyncio
import gc
import threading
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from rosasync import wrap_future
from tests.support.echo import ECHO, answer_to, request_of, service_class
from tests.support.times import LIMIT


@pytest.fixture
def executor() -> Iterator[SingleThreadedExecutor]:
    """An rclpy executor that spins in a thread."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor(context=context)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once()

    thread = threading.Thread(target=spin)
    thread.start()
    yield executor
    stop.set()
    executor.create_task(lambda: None)
    thread.join()
    executor.shutdown()
    context.shutdown()


@pytest.fixture
def node(executor: SingleThreadedExecutor) -> Iterator[Any]:
    """A node which that executor spins."""
    node = rclpy.create_node("wrapped", context=executor.context)
    executor.add_node(node)
    yield node
    executor.remove_node(node)
    node.destroy_node()


async def elsewhere(function: Any, *args: Any) -> None:
    """Run it in another thread, as an executor does."""
    await asyncio.to_thread(function, *args)


async def test_a_result(executor: SingleThreadedExecutor) -> None:
    future = Future(executor=executor)
    wrapped = wrap_future(future)
    assert isinstance(wrapped, asyncio.Future)
    await elsewhere(future.set_result, 7)
    assert await wrapped == 7


async def test_an_exception() -> None:
    future = Future()
    wrapped = wrap_future(future)
    await elsewhere(future.set_exception, ZeroDivisionError("x"))
    with pytest.raises(ZeroDivisionError, match="x"):
        await wrapped


async def test_what_is_done_already() -> None:
    done, failed, cancelled = Future(), Future(), Future()
    done.set_result("before")
    failed.set_exception(ZeroDivisionError())
    failed.exception()
    cancelled.cancel()
    assert await wrap_future(done) == "before"
    with pytest.raises(ZeroDivisionError):
        await wrap_future(failed)
    with pytest.raises(asyncio.CancelledError):
        await wrap_future(cancelled)


async def test_cancelling_the_asyncio_side_reaches_the_other() -> None:
    future = Future()
    wrapped = wrap_future(future)
    wrapped.cancel()
    with pytest.raises(asyncio.CancelledError):
        await wrapped
    await asyncio.sleep(0)
    assert future.cancelled()


async def test_cancelling_the_waiting_task_reaches_the_other() -> None:
    future = Future()

    async def waiter() -> None:
        await wrap_future(future)

    task = asyncio.create_task(waiter())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await asyncio.sleep(0)
    assert future.cancelled()


async def test_cancelling_the_rclpy_side_reaches_asyncio(executor: SingleThreadedExecutor) -> None:
    for future in (Future(), Future(executor=executor)):
        wrapped = wrap_future(future)
        await elsewhere(future.cancel)
        with pytest.raises(asyncio.CancelledError):
            async with asyncio.timeout(LIMIT):
                await wrapped
        assert wrapped.cancelled()


async def test_a_result_that_races_the_cancellation() -> None:
    future = Future()
    wrapped = wrap_future(future)
    thread = threading.Thread(target=future.set_result, args=[7])
    thread.start()
    thread.join()
    wrapped.cancel()
    await asyncio.sleep(0)
    assert wrapped.cancelled()
    future = Future()
    wrapped = wrap_future(future)
    wrapped.cancel()
    await elsewhere(future.set_result, 7)
    await asyncio.sleep(0)
    assert wrapped.cancelled()


async def test_two_wrappers_of_one_future() -> None:
    future = Future()
    one, two = wrap_future(future), wrap_future(future)
    await elsewhere(future.set_result, 7)
    assert [await one, await two] == [7, 7]


async def test_a_thousand_at_once() -> None:
    futures = [Future() for _ in range(1000)]
    wrapped = [wrap_future(future) for future in futures]

    def complete() -> None:
        for number, future in enumerate(futures):
            future.set_result(number)

    await elsewhere(complete)
    assert await asyncio.gather(*wrapped) == list(range(1000))


async def test_a_loop_that_has_gone() -> None:
    futures: list[Any] = []

    async def program() -> None:
        futures.append(Future())
        wrap_future(futures[0])

    await asyncio.to_thread(asyncio.run, program())
    futures[0].set_result(7)
    gc.collect()


def test_outside_of_a_loop() -> None:
    with pytest.raises(RuntimeError):
        wrap_future(Future())


@pytest.mark.parametrize("thing", [None, 7, asyncio.sleep])
async def test_what_is_no_future(thing: Any) -> None:
    with pytest.raises(TypeError):
        wrap_future(thing)


async def test_a_call_of_rclpys_own_client(node: Any, echo: str) -> None:
    client = node.create_client(service_class(ECHO), echo)
    assert await asyncio.to_thread(client.wait_for_service, LIMIT)
    for number in range(50):
        response = await wrap_future(client.call_async(request_of(str(number))))
        assert answer_to(response) == str(number)
    node.destroy_client(client)
