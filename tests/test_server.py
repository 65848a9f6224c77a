"""Servers: their arguments, limits, QoS and introspection."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import pytest
import rclpy
from rclpy.executors import MultiThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from rosasync import (
    InvalidServiceName,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync._ros.services import take_requests
from tests.support.echo import ECHO, answer_to
from tests.support.serving import (
    AnyCall,
    Gate,
    Holder,
    Response,
    ask,
    discard,
    echo_call,
    echo_of,
    settled,
)
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge

RCLError: type[Exception] = rclpy_implementation.RCLError


async def test_other_bad_arguments(session: Session) -> None:
    with pytest.raises(TypeError, match="on_error"):
        session.serve(ECHO, "/bad", echo_call, on_error=3)  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="on_overload"):
        session.serve(ECHO, "/bad", echo_call, on_overload="x")  # type: ignore[call-overload]
    with pytest.raises(ValueError, match="concurrency"):
        session.serve(ECHO, "/bad", echo_call, concurrency=0)
    with pytest.raises(ValueError, match="backlog"):
        session.serve(ECHO, "/bad", echo_call, backlog=-1)
    with pytest.raises(ValueError, match="backlog_bytes"):
        session.serve(ECHO, "/bad", echo_call, backlog_bytes=-1)
    with pytest.raises(ValueError, match="'fair' or 'arrival', not 'newest'"):
        session.serve(ECHO, "/bad", echo_call, order="newest")  # type: ignore[call-overload]
    with pytest.raises(TypeError, match="qos"):
        session.serve(ECHO, "/bad", echo_call, qos=10)
    with pytest.raises(InvalidServiceName):
        session.serve(ECHO, "/b a d", echo_call)
    with pytest.raises((TypeError, ValueError)):
        session.serve("no/srv/Such", "/bad", echo_call)
    assert session.statistics().servers == ()


class TestLimits:
    async def test_never_more_than_three_run_and_the_rest_in_order(self, session: Session) -> None:
        running = most = 0
        order: list[str] = []
        step = asyncio.Semaphore(0)

        async def handler(request: Any, response: Any) -> Any:
            nonlocal running, most
            order.append(request.load_namespace)
            running += 1
            most = max(most, running)
            await step.acquire()
            running -= 1
            return echo_of(request)

        # However long it takes on a busy machine.
        server = session.serve(ECHO, "/served", handler, concurrency=3, order="arrival")
        texts = [f"{n:02}" for n in range(10)]
        tasks = [ask(session, "/served", text) for text in texts]
        await until(lambda: server.statistics().taken == 10)
        assert (server.statistics().running, server.statistics().waiting) == (3, 7)
        assert repr(server) == f"<ServiceServer /served [{ECHO}] 3 running, 7 waiting>"
        for _ in texts:
            step.release()
            await asyncio.sleep(0)
        assert await asyncio.gather(*tasks) == texts
        assert order == texts
        assert most == 3

    async def test_beyond_the_backlog_somebody_answers(self, session: Session) -> None:
        gate = Gate()

        async def busy(call: AnyCall) -> Any:
            await asyncio.sleep(0)
            return Response(message="busy")

        for number, on_overload in enumerate((lambda call: Response(message="busy"), busy)):
            gate.clear()
            name = f"/served_{number}"
            server = session.serve(
                ECHO, name, gate, concurrency=1, backlog=2, on_overload=on_overload
            )
            tasks = [ask(session, name, str(n)) for n in range(5)]
            # The oldest of those that waited.
            assert await asyncio.gather(*tasks[1:3]) == ["busy", "busy"]
            gate.set()
            assert await asyncio.gather(*tasks[:1], *tasks[3:]) == ["0", "3", "4"]
            statistics = server.statistics()
            assert (statistics.rejected, statistics.dropped, statistics.responded) == (2, 0, 5)

    async def test_beyond_the_backlog_nobody_answers(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        holder = Holder()
        gate = asyncio.Event()

        async def handler(call: AnyCall) -> Any:
            holder(call)
            await gate.wait()
            return echo_of(call.request)

        server = session.serve(ECHO, "/served", handler, concurrency=1, backlog=1)
        tasks = [ask(session, "/served", str(n), timeout=None) for n in range(6)]
        await until(lambda: server.statistics().rejected == 4)
        assert server.statistics().dropped == 4
        assert len(caplog.messages) == 1
        assert "/served: overloaded, with 1 request waiting" in caplog.text
        gate.set()
        assert [await tasks[0], await tasks[5]] == ["0", "5"]
        await settled(server)
        assert server.statistics().responded == 2
        await discard(*tasks[1:5])

    async def test_beyond_the_backlog_in_bytes(self, session: Session) -> None:
        gate = Gate()

        def busy(call: AnyCall) -> Any:
            return Response(message="busy")

        server = session.serve(
            ECHO, "/served", gate, concurrency=1, backlog_bytes=100, on_overload=busy
        )
        sizes = [60, 60, 60, 40, 1]
        tasks = [ask(session, "/served", "x" * size) for size in sizes]
        # The third pushes the second out, and the last the third.
        assert [await task for task in tasks[1:3]] == ["busy", "busy"]
        assert server.statistics().waiting == 2
        gate.set()
        assert [len(await task) for task in tasks] == [60, 4, 4, 40, 1]
        # Of a single request that waits, the size does not matter.
        gate.clear()
        tasks = [ask(session, "/served", "x" * size) for size in (1, 1_000)]
        await until(lambda: server.statistics().waiting == 1)
        gate.set()
        assert [len(await task) for task in tasks] == [1, 1_000]
        assert server.statistics().rejected == 2

    async def test_an_on_overload_that_raises(
        self, session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        def on_overload(call: AnyCall) -> None:
            raise ValueError("overtaxed")

        server = session.serve(ECHO, "/served", backlog=0, on_overload=on_overload)
        task = ask(session, "/served", "text", timeout=None)
        await until(lambda: server.statistics().dropped == 1)
        assert "overtaxed" in caplog.text
        await discard(task)


async def test_a_callback_in_a_multithreaded_executor_of_ones_own(bridge: Bridge) -> None:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("lender")
    executor = MultiThreadedExecutor(2)
    stopping = threading.Event()

    def spin() -> None:
        while not stopping.is_set():
            executor.spin_once()

    try:
        async with Session(node, executor=executor, bridge=bridge, timeout=2 * LIMIT) as session:
            spinner = threading.Thread(target=spin)
            spinner.start()
            order: list[str] = []

            async def handler(call: AnyCall) -> Any:
                order.append(call.request.load_namespace)
                return echo_of(call.request)

            session.serve(ECHO, "/served", handler)
            texts = [f"{n:03}" for n in range(100)]
            answers = await asyncio.gather(*(ask(session, "/served", text) for text in texts))
            assert answers == order == texts
        stopping.set()
        executor.create_task(lambda: None)
        await asyncio.to_thread(spinner.join)
        executor.shutdown()
    finally:
        rclpy.shutdown()
        node.destroy_node()


class TestIntrospection:
    @pytest.mark.parametrize("state", ["metadata", "contents"])
    async def test_four_events_for_a_call(self, bridge: Bridge, state: Any) -> None:
        events: list[Any] = []

        def of_a_call() -> list[Any]:
            """Return the events of the first call of which all have come."""
            seen = tuple(events)
            for number in sorted({event.info.sequence_number for event in seen}):
                found = [event for event in seen if event.info.sequence_number == number]
                if len(found) >= 4:
                    return found
            return []

        options: dict[str, Any] = {"bridge": bridge, "timeout": 2 * LIMIT}
        async with Session("seen", introspection=state, **options) as session:
            session.serve(SetBool, "/seen", lambda request, response: response)
            async with Session("watcher", bridge=bridge) as watcher:
                watcher.node.create_subscription(
                    SetBool.Event, "/seen/_service_event", events.append, 100
                )
                await session.wait_for_service(SetBool, "/seen", timeout=LIMIT)
                await until(
                    lambda: (
                        len(watcher.node.get_publishers_info_by_topic("/seen/_service_event")) == 2
                    )
                )
                await until(lambda: session.node.count_subscribers("/seen/_service_event") == 1)
                while not of_a_call():
                    await session.call(SetBool, "/seen", {"data": True})
                    await asyncio.sleep(2 * TICK)
        found = of_a_call()
        assert sorted(event.info.event_type for event in found) == [0, 1, 2, 3]
        filled = 2 if state == "contents" else 0
        assert sum(len(event.request) for event in found) == filled
        assert sum(len(event.response) for event in found) == filled

    async def test_off_by_default(self, session: Session) -> None:
        session.serve(Trigger, "/unseen", lambda call: call.response)
        await session.call(Trigger, "/unseen")
        assert session.node.count_publishers("/unseen/_service_event") == 0

    def test_anything_else(self) -> None:
        with pytest.raises(ValueError, match="introspection"):
            Session("seen", introspection="all")  # type: ignore[arg-type]


async def test_serving_on_a_session_that_is_not_open() -> None:
    session = Session("unopened")
    with pytest.raises(UsageError):
        session.serve(ECHO, "/served", echo_call)
    async with session:
        pass
    with pytest.raises(SessionClosed):
        session.serve(ECHO, "/served", echo_call)


async def test_calls_answer_the_right_requests(session: Session) -> None:
    session.serve(ECHO, "/served", echo_call)
    response = await session.call(ECHO, "/served", {"load_namespace": "mapped"})
    assert answer_to(response) == "mapped"


def test_a_request_that_cannot_be_read_hides_none(caplog: pytest.LogCaptureFixture) -> None:
    header = object()
    queue: list[Any] = [("first", header), RCLError("unreadable"), (None, None), ("last", header)]

    def take(request_type: type) -> Any:
        found = queue.pop(0) if queue else (None, None)
        if isinstance(found, Exception):
            raise found
        return found

    assert take_requests(take, str, 5) == [("first", header), ("last", header)]
    assert "unreadable" in caplog.text
