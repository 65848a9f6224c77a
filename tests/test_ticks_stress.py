"""A thousand leaves: their answers, what they use, and that no tick ever waits."""

from __future__ import annotations

import asyncio
import gc
import random
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

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
LEAVES = 1000
PERIOD = 0.01
SECONDS = 10.0


@dataclass
class Leaf:
    """Calls again and again, is halted now and then, and compares what it gets."""

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
        self.proxy.call_service(request_of(self.text), timeout=LIMIT)

    def take(self) -> None:
        answer = answer_to(self.proxy.get_response())
        self.answers += 1
        if answer != self.text:
            self.wrong.append(f"{self.text}: got {answer}")


async def test_a_thousand_proxies_ticked_from_a_thread(
    session: Session, server: ServerProcess
) -> None:
    names = [f"/service_{number}" for number in range(SERVICES)]
    for name in names:
        await server.serve(name, delay=(0.0, 0.5))
        await session.wait_for_service(ECHO, name, timeout=LIMIT)
    leaves = [
        Leaf(AsyncServiceProxy(session, ECHO, names[number % SERVICES]), f"leaf {number}")
        for number in range(LEAVES)
    ]
    dice = random.Random(4)
    used: set[tuple[int, int]] = set()

    def tick_all() -> None:
        # From the first tick on.
        ends = time.monotonic() + SECONDS
        while (began := time.monotonic()) < ends:
            for leaf in leaves:
                leaf.tick(dice, halt=0.001)
            used.add((count_threads(), count_descriptors()))
            time.sleep(max(0.0, began + PERIOD - time.monotonic()))
        # The whole tree is halted, and ticked on at once.
        for leaf in leaves:
            leaf.proxy.stop_call()
        for leaf in leaves:
            leaf.call()

    with ThreadPoolExecutor(1) as threads:
        await asyncio.get_running_loop().run_in_executor(threads, tick_all)
    await until(lambda: all(leaf.proxy.get_state() is ProxyState.RESPONSE_READY for leaf in leaves))
    for leaf in leaves:
        leaf.take()
    assert [text for leaf in leaves for text in leaf.wrong] == []
    assert min(leaf.answers for leaf in leaves) >= 1
    assert sum(leaf.answers for leaf in leaves) > LEAVES
    assert sum(leaf.halts for leaf in leaves) > 0
    assert session.pool.statistics().created == SERVICES
    assert len(used) == 1, f"threads and descriptors changed: {used}"
    await assert_clean(session)


@contextmanager
def without_collector() -> Iterator[None]:
    """Python's garbage collector runs in whichever thread allocates, and is not the tick's work."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


async def test_a_dead_server_does_not_make_a_tick_longer(bridge: Bridge) -> None:
    """By CPU time of the ticking thread: what a tick does itself, not what the machine does."""
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
    longest = 0

    def tick_all() -> None:
        nonlocal longest
        for _ in range(1000):
            began = time.thread_time_ns()
            tree.tick()
            longest = max(longest, time.thread_time_ns() - began)
            time.sleep(TICK / 25)

    async with ServerProcess() as doomed, Session(bridge=bridge, timeout=LIMIT) as session:
        await doomed.serve("/doomed")
        await session.call(ECHO, "/doomed", request_of("a"))
        doomed.kill()
        tree.setup(session=session)
        with without_collector():
            await asyncio.to_thread(tick_all)
        assert root.status is Status.RUNNING
        assert len(calls) > 100
        tree.shutdown()
    assert longest < 1_000_000


@pytest.mark.parametrize("where", ["loop", "thread"])
async def test_halting_a_tree_with_a_thousand_calls_out(
    bridge: Bridge, server: ServerProcess, where: str
) -> None:
    await server.serve("/echo", delay="hold", depth=LEAVES)
    answers: list[str] = []
    run = "old"

    def call(number: int) -> CallService:
        return CallService(
            f"leaf {number}",
            *(ECHO, "/echo"),
            lambda: request_of(f"{run} {number}"),
            timeout=3 * LIMIT,
            on_response=lambda response: answers.append(answer_to(response)),
        )

    root = py_trees.composites.Parallel(
        "root", ParallelPolicy.SuccessOnAll(), [call(number) for number in range(LEAVES)]
    )
    limits = Limits(in_flight=LEAVES, grace=LIMIT)
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
        await server.received("/echo", LEAVES)
        await do(halt_and_tick_on)
        assert root.status is Status.RUNNING
        await server.release("/echo")
        await server.received("/echo", 2 * LEAVES)
        await until(lambda: session.pool.statistics().late == LEAVES)
        await do(root.tick_once)
        assert root.status is Status.RUNNING
        assert answers == []
        await server.release("/echo")
        await until(lambda: session.pool.statistics().completed == LEAVES)
        await do(root.tick_once)
        assert root.status is Status.SUCCESS
        assert answers == [f"new {number}" for number in range(LEAVES)]
        statistics = session.pool.statistics()
        assert (statistics.cancelled, statistics.created) == (LEAVES, 1)
        await assert_clean(session)
