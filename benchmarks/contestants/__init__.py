"""The contestants: one file each, written as their own users are told to write it."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from benchmarks.contestants.base import Contestant, Tally

__all__ = ["CONTESTANTS", "Contestant", "Entry", "Tally", "make_contestant"]


@dataclass(frozen=True)
class Entry:
    """A contestant by its place: the module's ``CONTESTANTS[key]`` makes one."""

    label: str
    module: str
    spins: bool = False
    """Whether it burns a core while it waits."""


CONTESTANTS = {
    "direct": Entry("rosasync, direct bridge", "rosasync_session"),
    "direct-uvloop": Entry("rosasync, direct bridge, uvloop", "rosasync_session"),
    "direct-exclusive": Entry("rosasync, direct bridge, 8 exclusive clients", "rosasync_session"),
    "executor": Entry("rosasync, executor bridge", "rosasync_session"),
    "executor-uvloop": Entry("rosasync, executor bridge, uvloop", "rosasync_session"),
    "call": Entry("client.call, SingleThreadedExecutor in a thread", "threaded_call"),
    "call-multi": Entry("client.call, MultiThreadedExecutor in a thread", "multithreaded_executor"),
    "pool": Entry("client.call in a thread pool", "thread_pool"),
    "to-thread": Entry("asyncio.to_thread(client.call)", "to_thread"),
    "polled": Entry("call_async polled with sleep(0)", "polled_future", spins=True),
    "spin-task": Entry("spin_once(0) in an asyncio task", "spin_in_task", spins=True),
    "spin-until": Entry("spin_until_future_complete", "spin_until_complete"),
    "afor": Entry("asyncio-for-robotics, its default QoS", "asyncio_for_robotics"),
    "afor-qos": Entry("asyncio-for-robotics, the service QoS", "asyncio_for_robotics"),
    "thread-per-call": Entry("a thread for each call", "thread_per_call"),
    "process-per-call": Entry("a process for each call", "process_per_call"),
    "floor": Entry("wait set in the calling thread (the floor)", "wait_set"),
    "busy": Entry("busy poll of take_response (the limit)", "busy_poll", spins=True),
}


def make_contestant(key: str) -> Contestant:
    """Makes a contestant, not yet set up."""
    module = importlib.import_module(f"{__name__}.{CONTESTANTS[key].module}")
    contestant: Contestant = module.CONTESTANTS[key]()
    return contestant
