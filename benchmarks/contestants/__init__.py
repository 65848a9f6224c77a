"""The contestants, one file each, written as their own documentation recommends."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Literal

from benchmarks.contestants.base import Contestant, Tally

__all__ = ["CONTESTANTS", "Contestant", "Entry", "Tally", "make_contestant"]


@dataclass(frozen=True)
class Entry:
    """Where to find a contestant: ``CONTESTANTS[key]`` of the module creates one."""

    label: str
    module: str
    kind: Literal["ours", "peer", "limit", "leaf"] = "peer"
    """A ``limit`` is the lower bound of a call's cost, not a practical program. A ``leaf`` calls in
    ticks."""
    spins: bool = False
    """Whether it keeps a core busy while it waits."""


CONTESTANTS = {
    "direct": Entry("rosasync, direct bridge", "rosasync_session", "ours"),
    "direct-uvloop": Entry("rosasync, direct bridge, uvloop", "rosasync_session", "ours"),
    "direct-exclusive": Entry(
        "rosasync, direct bridge, 8 exclusive clients", "rosasync_session", "ours"
    ),
    "direct-retry": Entry("rosasync, direct bridge, with Retry", "rosasync_session", "ours"),
    "direct-busy": Entry(
        "rosasync, direct bridge, busy poll", "rosasync_session", "ours", spins=True
    ),
    "direct-busy-uvloop": Entry(
        "rosasync, direct bridge, busy poll, uvloop", "rosasync_session", "ours", spins=True
    ),
    "executor": Entry("rosasync, executor bridge", "rosasync_session", "ours"),
    "executor-uvloop": Entry("rosasync, executor bridge, uvloop", "rosasync_session", "ours"),
    "call": Entry("client.call, SingleThreadedExecutor in a thread", "threaded_call"),
    "call-multi": Entry("client.call, MultiThreadedExecutor in a thread", "multithreaded_executor"),
    "pool": Entry("client.call in a thread pool", "thread_pool"),
    "to-thread": Entry("asyncio.to_thread(client.call)", "to_thread"),
    "polled": Entry("call_async polled with sleep(0)", "polled_future", spins=True),
    "call-async": Entry("call_async, an asyncio future, no limit", "call_async"),
    "semaphore": Entry("call_async, a semaphore of ten", "call_async"),
    "spin-task": Entry("spin_once(0) in an asyncio task", "spin_in_task", spins=True),
    "spin-until": Entry("spin_until_future_complete", "spin_until_complete"),
    "afor": Entry("asyncio-for-robotics, its default QoS", "asyncio_for_robotics"),
    "afor-qos": Entry("asyncio-for-robotics, the service QoS", "asyncio_for_robotics"),
    "thread-per-call": Entry("a thread for each call", "thread_per_call"),
    "process-per-call": Entry("a process for each call", "process_per_call"),
    "floor": Entry("wait set in the calling thread (the floor)", "wait_set", "limit"),
    "busy": Entry("busy poll of take_response (the limit)", "busy_poll", "limit", spins=True),
    "tick-running": Entry("py_trees' own Running, no call", "ticked_rosasync", "leaf"),
    "tick-py-trees": Entry("CallService of py_trees", "ticked_rosasync", "leaf"),
    "tick-loop": Entry("AsyncServiceProxy, ticked in the loop", "ticked_rosasync", "leaf"),
    "tick-thread": Entry("AsyncServiceProxy, ticked in a thread", "ticked_rosasync", "leaf"),
    "tick-threads": Entry("a thread for each call, claimed clients", "ticked_threads", "leaf"),
    "tick-processes": Entry("a process for each call, a manager", "ticked_processes", "leaf"),
}


def make_contestant(key: str) -> Contestant:
    """Create a contestant, without setting it up."""
    module = importlib.import_module(f"{__name__}.{CONTESTANTS[key].module}")
    contestant: Contestant = module.CONTESTANTS[key]()
    return contestant
