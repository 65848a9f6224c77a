"""The executor thread, borrowed nodes and contexts, and callbacks of the node."""

from __future__ import annotations

import asyncio
import functools
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.waitable import NumberOfEntities, Waitable
from std_msgs.msg import Empty
from test_msgs.action import Fibonacci

from rosasync import Limits, ServerGoal, Session
from rosasync._ros.topics import ExecutorSubscription
from tests.support.checks import assert_clean, check_call
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge


@contextmanager
def spinning(executor: Any) -> Iterator[None]:
    """Spin an executor in a thread, as a program without asyncio does."""
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once()

    thread = threading.Thread(target=spin)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        executor.create_task(lambda: None)
        thread.join()
        executor.shutdown()


def guest(bridge: Bridge, executor: Any) -> Session:
    """Make a session with a node of its own, which the user's executor spins."""
    return Session("guest", bridge=bridge, context=executor.context, executor=executor)


class SlowToCollect(Waitable):  # type: ignore[misc]
    """Keeps an executor for a while between collecting a node's entities and using them."""

    def __init__(self) -> None:
        self._group = ReentrantCallbackGroup()
        super().__init__(self._group)
        self.collecting = threading.Event()

    def __enter__(self) -> None:
        pass

    def __exit__(self, *exc: object) -> None:
        pass

    def get_num_entities(self) -> NumberOfEntities:
        self.collecting.set()
        time.sleep(TICK)
        return NumberOfEntities()

    def add_to_wait_set(self, wait_set: Any) -> None:
        pass

    def is_ready(self, wait_set: Any) -> bool:
        return False


@pytest.fixture
def context() -> Iterator[Any]:
    """A context that is not the session's."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    yield context
    assert context.ok()
    context.shutdown()


@pytest.fixture
def node(context: Any) -> Iterator[Any]:
    """A node that is not the session's."""
    node = rclpy.create_node("lender", context=context)
    yield node
    node.destroy_node()


class TestOwnThread:
    """The thread of a session that has a node of its own."""

    async def test_it_spins_the_nodes_timers_and_subscriptions(
        self, session: Session, echo: str
    ) -> None:
        loop = asyncio.get_running_loop()
        ticked, heard = asyncio.Event(), asyncio.Event()
        threads: set[int] = set()

        def tick() -> None:
            threads.add(threading.get_ident())
            publisher.publish(Empty())
            loop.call_soon_threadsafe(ticked.set)

        publisher = session.node.create_publisher(Empty, "/topic", 10)
        session.node.create_subscription(
            Empty, "/topic", lambda _: loop.call_soon_threadsafe(heard.set), 10
        )
        session.node.create_timer(TICK, tick)
        async with asyncio.timeout(LIMIT):
            await ticked.wait()
            await heard.wait()
        await check_call(session, echo, "beside them")
        assert threading.get_ident() not in threads
        assert len(threads) == 1

    async def test_a_callback_that_raises_reaches_the_loops_handler(
        self, session: Session, echo: str
    ) -> None:
        reported: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        asyncio.get_running_loop().set_exception_handler(
            lambda _, details: reported.put_nowait(details)
        )

        def fail() -> None:
            raise ZeroDivisionError("in the timer")

        timer = session.node.create_timer(TICK / 5, fail)
        async with asyncio.timeout(LIMIT):
            for number in range(5):
                details = await reported.get()
                assert isinstance(details["exception"], ZeroDivisionError)
                assert "in the timer" in str(details["exception"])
                await check_call(session, echo, str(number))
        session.node.destroy_timer(timer)
        await check_call(session, echo, "afterwards")
        await assert_clean(session)

    async def test_a_slow_callback_does_not_delay_the_direct_bridge(self, echo: str) -> None:
        async with Session("slow", bridge="direct") as session:
            await check_call(session, echo, "before")
            entered, leave = threading.Event(), threading.Event()

            def block() -> None:
                entered.set()
                leave.wait(LIMIT)

            timer = session.node.create_timer(0.0, block)
            try:
                await asyncio.to_thread(entered.wait, LIMIT)
                for number in range(20):
                    await check_call(session, echo, str(number), timeout=LIMIT / 4)
                assert not leave.is_set()
            finally:
                timer.cancel()
                leave.set()

    async def test_closing_waits_for_a_callback_under_way(self, bridge: Bridge) -> None:
        entered, left = threading.Event(), threading.Event()
        async with Session("busy", bridge=bridge) as session:

            def work() -> None:
                entered.set()
                timer.cancel()
                threading.Event().wait(4 * TICK)
                left.set()

            timer = session.node.create_timer(0.0, work)
            await asyncio.to_thread(entered.wait, LIMIT)
        assert left.is_set()

    async def test_entities_of_the_node_come_and_go_while_it_spins(
        self, session: Session, echo: str
    ) -> None:
        for number in range(50):
            publisher = session.node.create_publisher(Empty, f"/topic_{number}", 10)
            subscription = session.node.create_subscription(
                Empty, f"/topic_{number}", lambda _: None, 10
            )
            publisher.publish(Empty())
            await check_call(session, echo, str(number))
            session.node.destroy_subscription(subscription)
            session.node.destroy_publisher(publisher)


class TestBorrowed:
    """Borrowed nodes and contexts are neither shut down nor destroyed."""

    async def test_a_context(self, bridge: Bridge, context: Any, echo: str) -> None:
        for number in range(2):
            async with Session("guest", bridge=bridge, context=context) as session:
                assert session.node.context is context
                await check_call(session, echo, str(number))
            assert context.ok()

    async def test_a_node_that_nobody_spins(self, bridge: Bridge, node: Any, echo: str) -> None:
        for number in range(2):
            async with Session(node, bridge=bridge) as session:
                assert session.node is node
                await check_call(session, echo, str(number))
            assert node.executor is None
            assert node.get_name() == "lender"
            assert not list(node.clients)

    @pytest.mark.parametrize("kind", [SingleThreadedExecutor, MultiThreadedExecutor])
    async def test_a_node_in_the_users_own_executor(
        self, bridge: Bridge, node: Any, echo: str, kind: Any
    ) -> None:
        loop = asyncio.get_running_loop()
        ticked = asyncio.Event()
        node.create_timer(TICK / 5, lambda: loop.call_soon_threadsafe(ticked.set))
        executor = kind(context=node.context)
        executor.add_node(node)
        with spinning(executor):
            async with Session(node, bridge=bridge) as session:
                for number in range(100):
                    await check_call(session, echo, str(number))
                assert node.executor is executor
                await assert_clean(session)
            ticked.clear()
            async with asyncio.timeout(LIMIT):
                await ticked.wait()
            assert node.executor is executor
            executor.remove_node(node)

    async def test_an_executor_for_a_node_of_its_own(
        self, bridge: Bridge, context: Any, echo: str
    ) -> None:
        executor = SingleThreadedExecutor(context=context)
        with spinning(executor):
            async with guest(bridge, executor) as session:
                assert session.node in executor.get_nodes()
                await check_call(session, echo, "text")
            assert not executor.get_nodes()

    async def test_the_users_spin_goes_on_when_the_node_is_destroyed(
        self, bridge: Bridge, context: Any
    ) -> None:
        """It raised `InvalidHandle` if it was just collecting the node's entities."""
        executor = SingleThreadedExecutor(context=context)
        with spinning(executor):
            async with guest(bridge, executor) as session:
                slow = SlowToCollect()
                session.node.add_waitable(slow)
                executor.wake()
                assert await asyncio.to_thread(slow.collecting.wait, LIMIT)
            ticked = asyncio.Event()
            executor.create_task(asyncio.get_running_loop().call_soon_threadsafe, ticked.set)
            async with asyncio.timeout(LIMIT):
                await ticked.wait()

    async def test_several_threads_do_not_let_a_result_overtake_feedback(
        self, context: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        take_next = ExecutorSubscription._take_next

        def take_slowly(subscription: ExecutorSubscription) -> Any:
            threading.Event().wait(TICK)
            return take_next(subscription)

        async def count(goal: ServerGoal[Any, Any]) -> Any:
            for number in range(goal.request.order):
                goal.feedback({"sequence": [number]})
            return {}

        monkeypatch.setattr(ExecutorSubscription, "_take_next", take_slowly)
        executor = MultiThreadedExecutor(4, context=context)
        with spinning(executor):
            async with Session("server") as server, guest("executor", executor) as session:
                server.serve_action(Fibonacci, "/count", count)
                # For a new client, the server waits until the first feedback has arrived.
                for _ in range(2):
                    async with session.goal(Fibonacci, "/count", {"order": 3}) as goal:
                        await goal.result(timeout=LIMIT)
                        received = [message.sequence[0] async for message in goal]
                    assert received == [0, 1, 2]

    async def test_an_executor_that_nothing_spins(self, bridge: Bridge, context: Any) -> None:
        executor = SingleThreadedExecutor(context=context)

        async def open_and_close() -> None:
            async with guest(bridge, executor):
                pass

        # A loop of its own: it is closed when the executor is spun.
        await asyncio.to_thread(asyncio.run, open_and_close())
        assert not executor.get_nodes()
        for _ in range(3):
            executor.spin_once(timeout_sec=0.0)
        executor.shutdown()

    async def test_an_executor_that_is_shut_down_first(self, bridge: Bridge, context: Any) -> None:
        executor = SingleThreadedExecutor(context=context)
        async with guest(bridge, executor):
            executor.shutdown()

    async def test_two_sessions_on_one_node_in_the_users_executor(
        self, bridge: Bridge, node: Any, echo: str
    ) -> None:
        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)
        half = Limits(in_flight=5)
        with spinning(executor):
            async with (
                Session(node, bridge=bridge, limits=half) as one,
                Session(node, bridge=bridge, limits=half) as two,
            ):
                await asyncio.gather(
                    *(check_call(one, echo, f"one {n}") for n in range(50)),
                    *(check_call(two, echo, f"two {n}") for n in range(50)),
                )
            executor.remove_node(node)

    async def test_a_node_that_the_user_spins_later(
        self, bridge: Bridge, node: Any, echo: str
    ) -> None:
        """A session that ends leaves the node in the executor that it is in by then."""
        executor = SingleThreadedExecutor(context=node.context)
        async with Session(node, bridge=bridge) as session:
            await check_call(session, echo, "before")
            executor.add_node(node)
            with spinning(executor):
                await check_call(session, echo, "after")
                await session.aclose()
                assert node.executor is executor
                assert node in executor.get_nodes()
                executor.remove_node(node)


class TestShared:
    """Two sessions on one node that no executor has: one thread, until both have ended."""

    async def test_the_one_that_stays_is_still_spun(
        self, bridge: Bridge, node: Any, echo: str
    ) -> None:
        half = Limits(in_flight=5)
        loop = asyncio.get_running_loop()
        for first, second in ((0, 1), (1, 0)):
            sessions = [Session(node, bridge=bridge, limits=half) for _ in range(2)]
            for session in sessions:
                await session.__aenter__()
                await check_call(session, echo, "both")
            names = [thread.name for thread in threading.enumerate()]
            assert names.count("rosasync executor of lender") == 1
            await sessions[first].aclose()
            ticked = asyncio.Event()
            timer = node.create_timer(
                TICK / 5, functools.partial(loop.call_soon_threadsafe, ticked.set)
            )
            async with asyncio.timeout(LIMIT):
                await ticked.wait()
            for number in range(20):
                await check_call(sessions[second], echo, str(number))
            await assert_clean(sessions[second])
            node.destroy_timer(timer)
            await sessions[second].aclose()
            assert node.executor is None

    async def test_sessions_of_several_threads_come_and_go(
        self, bridge: Bridge, node: Any, echo: str
    ) -> None:
        """Each has a loop of its own, and each of its calls is answered."""

        async def come_and_go(name: int) -> None:
            limits = Limits(in_flight=1)
            for number in range(10):
                async with Session(node, bridge=bridge, limits=limits) as session:
                    await check_call(session, echo, f"{name} {number}", timeout=LIMIT)

        threads = (asyncio.to_thread(asyncio.run, come_and_go(name)) for name in range(4))
        await asyncio.gather(*threads)
        assert node.executor is None
        names = [thread.name for thread in threading.enumerate()]
        assert "rosasync executor of lender" not in names

    async def test_a_callback_that_raises_is_reported_once(self, bridge: Bridge, node: Any) -> None:
        reported: list[dict[str, Any]] = []
        asyncio.get_running_loop().set_exception_handler(
            lambda _, details: reported.append(details)
        )

        def fail() -> None:
            timer.cancel()
            raise ZeroDivisionError("in the timer")

        async with Session(node, bridge=bridge) as one, Session(node, bridge=bridge):
            timer = node.create_timer(0.0, fail)
            await until(lambda: reported)
            await one.aclose()
        assert len(reported) == 1
