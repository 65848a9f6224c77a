"""Many leaves: their responses, their threads and files, and ticks that never wait."""

from __future__ import annotations

import asyncio
import gc
import random
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

import py_trees
import pytest
from py_trees.common import ParallelPolicy, Status

from rosasync import AsyncServiceProxy, Limits, ProxyState, Session
from rosasync.behaviours import CallService
from tests.support.checks import assert_clean, count_descriptors, count_threads
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge

SERVICES = 10
LEAVES = [200, pytest.param(1000, marks=pytest.mark.soak)]
PERIOD = TICK / 5
PATIENCE = 4 * LIMIT


@dataclass
class Leaf:
    """Calls repeatedly, is halted at random, and checks each response."""

    proxy: AsyncServiceProxy
    name: str
    calls: int = 0
    answers: int = 0
    halts: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        return f"{self.name} {self.calls}"

    def tick(self, dice: random.Random, halt: float) -> None:
        state = self.proxy.get_state()
        if state is ProxyState.RUNNING:
            if dice.random() < halt:
                self.proxy.stop_call()
                self.halts += 1
            return
        if state is ProxyState.RESPONSE_READY:
            self.take()
        elif state not in (ProxyState.IDLE, ProxyState.ABORTED):
            self.wrong.append(f"{self.text}: {state} {self.proxy.get_errors()}")
        self.call()

    def call(self) -> None:
        self.calls += 1
        self.proxy.call_service(request_of(self.text), timeout=PATIENCE)

    def take(self) -> None:
        answer = answer_to(self.proxy.get_response())
        self.answers += 1
        if answer != self.text:
            self.wrong.append(f"{self.text}: got {answer}")


@pytest.mark.parametrize("number_of_leaves", LEAVES)
async def test_many_proxies_ticked_from_a_thread(
    session: Session, server: ServerProcess, number_of_leaves: int
) -> None:
    names = [f"/service_{number}" for number in range(SERVICES)]
    for name in names:
        await server.serve(name, delay=(0.0, 0.5))
        await session.wait_for_service(ECHO, name, timeout=LIMIT)
    leaves = [
        Leaf(AsyncServiceProxy(session, ECHO, names[number % SERVICES]), f"leaf {number}")
        for number in range(number_of_leaves)
    ]
    dice = random.Random(4)
    threads_seen: set[int] = set()
    descriptors_seen: set[int] = set()

    def tick_all() -> None:
        rounds = 0
        # On a busy machine the first answers may come later than that.
        while rounds < number_of_leaves or not any(leaf.answers for leaf in leaves):
            rounds += 1
            for leaf in leaves:
                leaf.tick(dice, halt=0.001)
            # Counted from the first tick on.
            threads_seen.add(count_threads())
            descriptors_seen.add(count_descriptors())
            time.sleep(PERIOD)
        # Halt the whole tree, and tick it again at once.
        for leaf in leaves:
            leaf.proxy.stop_call()
        for leaf in leaves:
            leaf.call()

    with ThreadPoolExecutor(1) as threads:
        await asyncio.get_running_loop().run_in_executor(threads, tick_all)
    await until(
        lambda: all(leaf.proxy.get_state() is ProxyState.RESPONSE_READY for leaf in leaves),
        PATIENCE,
    )
    for leaf in leaves:
        leaf.take()
    assert [text for leaf in leaves for text in leaf.wrong] == []
    assert min(leaf.answers for leaf in leaves) >= 1
    assert sum(leaf.answers for leaf in leaves) > number_of_leaves
    assert sum(leaf.halts for leaf in leaves) > 0
    assert session.pool.statistics().created == SERVICES
    assert len(threads_seen) == 1
    # The middleware opens and closes some of its own when it notices other processes come and go.
    assert max(descriptors_seen) - min(descriptors_seen) < SERVICES
    await assert_clean(session)


class Profile:
    """Counts the functions that the ticking thread calls, of Python and of C.

    Not those of a garbage collection, which may come at any time.
    """

    def __init__(self) -> None:
        self.count = 0
        self.names: set[str] = set()

    def __enter__(self) -> Self:
        gc.disable()
        sys.setprofile(self._on_event)
        return self

    def __exit__(self, *exc: object) -> None:
        sys.setprofile(None)
        gc.enable()

    def _on_event(self, frame: FrameType, event: str, arg: Any) -> None:
        if event == "call":
            self.count += 1
            self.names.add(frame.f_code.co_qualname)
        elif event == "c_call":
            self.count += 1
            self.names.add(arg.__qualname__)


MOST_CALLS = 2_000
"""Function calls in one tick of ten leaves that all fail and start again: 1,650 were counted."""

BLOCKING = {"sleep", "lock.acquire", "Condition.wait", "Event.wait"}


async def test_a_dead_server_does_not_make_a_tick_longer(bridge: Bridge) -> None:
    """A tick sends nothing, waits for nothing, and does no more than its leaves need.

    What a tick costs in time is measured by ``benchmarks ticks``.
    """
    calls: list[str] = []

    def call(name: str) -> Any:
        leaf = CallService(
            name, ECHO, "/doomed", request_of(name), timeout=TICK, on_feedback=calls.append
        )
        return py_trees.decorators.FailureIsRunning(f"again {name}", leaf)

    root = py_trees.composites.Parallel(
        "root", ParallelPolicy.SuccessOnAll(), [call(f"leaf {number}") for number in range(10)]
    )
    tree = py_trees.trees.BehaviourTree(root)
    most = 0
    names: set[str] = set()

    def tick_until(condition: Callable[[], bool]) -> None:
        nonlocal most
        while not condition():
            with Profile() as profile:
                tree.tick()
            most = max(most, profile.count)
            names.update(profile.names)
            time.sleep(TICK / 25)

    def halt_and_tick() -> None:
        ticks = tree.count + 20
        while tree.count < ticks:
            root.stop(Status.INVALID)
            tree.tick()

    async with ServerProcess() as doomed, Session(bridge=bridge, timeout=LIMIT) as session:
        await doomed.serve("/doomed")
        await session.call(ECHO, "/doomed", request_of("a"))
        doomed.kill()
        tree.setup(session=session)
        # Calls time out and are made again: the queues to the dead server fill.
        await asyncio.to_thread(tick_until, lambda: len(calls) > 200)
        with ThreadPoolExecutor() as threads:
            # The loop is blocked during the ticks, each of which starts every call again.
            threads.submit(halt_and_tick).result(LIMIT)
        assert root.status is Status.RUNNING
        tree.shutdown()
    assert "CallService.update" in names
    assert not {name for name in names if name in BLOCKING or "send_request" in name}
    assert most < MOST_CALLS


@pytest.mark.parametrize("number_of_leaves", LEAVES)
@pytest.mark.parametrize("where", ["loop", "thread"])
async def test_halting_a_tree_with_many_calls_out(
    bridge: Bridge, server: ServerProcess, where: str, number_of_leaves: int
) -> None:
    await server.serve("/echo", delay="hold", depth=number_of_leaves)
    answers: list[str] = []
    run = "old"

    def call(number: int) -> CallService:
        return CallService(
            f"leaf {number}",
            *(ECHO, "/echo"),
            lambda: request_of(f"{run} {number}"),
            timeout=PATIENCE,
            on_response=lambda response: answers.append(answer_to(response)),
        )

    root = py_trees.composites.Parallel(
        "root", ParallelPolicy.SuccessOnAll(), [call(number) for number in range(number_of_leaves)]
    )
    limits = Limits(in_flight=number_of_leaves, grace=PATIENCE)
    async with Session(bridge=bridge, limits=limits) as session:
        py_trees.trees.setup(root, session=session)

        async def do(function: Any) -> None:
            if where == "loop":
                function()
            else:
                await asyncio.to_thread(function)

        def halt_and_tick_on() -> None:
            nonlocal run
            root.stop(Status.INVALID)
            run = "new"
            root.tick_once()

        await do(root.tick_once)
        await server.received("/echo", number_of_leaves)
        await do(halt_and_tick_on)
        assert root.status is Status.RUNNING
        # No more than the old ones: on a slow machine, the window may have given up a place of
        # theirs for a new one.
        await server.release("/echo", number_of_leaves)
        await server.received("/echo", 2 * number_of_leaves)
        await until(lambda: session.pool.statistics().late == number_of_leaves)
        await do(root.tick_once)
        assert root.status is Status.RUNNING
        assert answers == []
        await server.release("/echo")
        await until(lambda: session.pool.statistics().completed == number_of_leaves)
        await do(root.tick_once)
        assert root.status is Status.SUCCESS
        assert answers == [f"new {number}" for number in range(number_of_leaves)]
        statistics = session.pool.statistics()
        assert (statistics.cancelled, statistics.created) == (number_of_leaves, 1)
        await assert_clean(session)
