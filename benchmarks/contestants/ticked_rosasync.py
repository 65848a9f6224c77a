"""rosasync's leaves: `AsyncServiceProxy`, ticked in the loop or in a thread, and py_trees."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Sequence
from typing import Any

import py_trees
from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy, Status

import rosasync
from benchmarks.ticking import (
    Leaf,
    Ticked,
    Ticks,
    call_timeout,
    drive_in_loop,
    watch_rclpy,
)
from benchmarks.work import READY_TIMEOUT, Work, load_type, make_request
from rosasync import AsyncServiceProxy, ProxyState
from rosasync.behaviours import CallService


class ProxyLeaf:
    def __init__(self, session: rosasync.Session, work: Work) -> None:
        self._proxy = AsyncServiceProxy(session, load_type(work.srv_type), work.names[0])
        self._request = make_request(work)
        self._timeout = call_timeout(work)
        self.state = self._proxy.get_state

    def start(self) -> None:
        self._proxy.call_service(self._request, self._timeout)

    def look(self) -> bool:
        state = self.state()
        if state is ProxyState.RUNNING:
            return False
        if state is not ProxyState.RESPONSE_READY:
            raise self._proxy.get_errors()[0]
        self._proxy.get_response()
        return True


class InLoop(Ticked):
    """Ticked in the loop, which runs between the ticks."""

    def setup(self, work: Work) -> None:
        self.stamps = watch_rclpy()
        self._work = work
        self._runner = asyncio.Runner()
        self._session = self._runner.run(_open(work))

    def leaf(self) -> Leaf:
        return ProxyLeaf(self._session, self._work)

    def drive(self, ticks: Ticks) -> None:
        self._runner.run(drive_in_loop(ticks))

    def close(self) -> None:
        with self._runner:
            self._runner.run(self._session.aclose())


class InThread(Ticked):
    """Ticked in another thread than the loop's."""

    def setup(self, work: Work) -> None:
        self.stamps = watch_rclpy()
        self._work = work
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        opening = asyncio.run_coroutine_threadsafe(_open(work), self._loop)
        self._session = opening.result()

    def leaf(self) -> Leaf:
        return ProxyLeaf(self._session, self._work)

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._session.aclose(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


class BehaviourLeaf:
    def __init__(self, behaviour: Behaviour) -> None:
        self.behaviour = behaviour

    def start(self) -> None:
        self.behaviour.tick_once()

    def look(self) -> bool:
        self.behaviour.tick_once()
        if self.behaviour.status is Status.FAILURE:
            raise RuntimeError(self.behaviour.feedback_message)
        return self.behaviour.status is Status.SUCCESS

    def state(self) -> object:
        return self.behaviour.status


class PyTrees(InThread):
    """`CallService` under a Parallel, or alone."""

    def leaf(self) -> Leaf:
        leaf = CallService(
            "leaf",
            load_type(self._work.srv_type),
            self._work.names[0],
            make_request(self._work),
            timeout=call_timeout(self._work),
            session=self._session,
        )
        leaf.setup()
        return BehaviourLeaf(leaf)

    def pending(self, leaves: Sequence[Any]) -> Callable[[], object]:
        behaviours = [leaf.behaviour for leaf in leaves]
        tick: Callable[[], object]
        if len(behaviours) == 1:
            tick = behaviours[0].tick_once
            return tick
        root = py_trees.composites.Parallel("root", ParallelPolicy.SuccessOnAll(), behaviours)
        # A root that is not RUNNING would stop its children first.
        root.status = Status.RUNNING
        tick = root.tick_once
        return tick


class Running(PyTrees):
    """py_trees' own `Running`, without a call: the lower bound of a tick's cost."""

    def leaf(self) -> Leaf:
        return BehaviourLeaf(py_trees.behaviours.Running("leaf"))


async def _open(work: Work) -> rosasync.Session:
    session = await rosasync.Session("bench", bridge="direct").__aenter__()
    await session.wait_for_service(load_type(work.srv_type), work.names[0], timeout=READY_TIMEOUT)
    return session


CONTESTANTS = {
    "tick-loop": InLoop,
    "tick-thread": InThread,
    "tick-py-trees": PyTrees,
    "tick-running": Running,
}
