"""Opening a session: the import of rclpy leaves the loop to other tasks, however it ends."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Any

import anyio
import pytest
import rclpy

from rosasync import Session, SessionClosed, UsageError
from rosasync._core.aio import call_in_thread
from rosasync._ros import node as ros_node
from rosasync._ros import type_supports
from tests.support.process import ROOT, own
from tests.support.times import LIMIT, TICK, until

TURNS = 3


class Gate:
    """Holds the import of every session, as a slow disk would."""

    def __init__(self) -> None:
        self.entered = 0
        self.error: BaseException | None = None
        self._open = threading.Event()

    def load(self) -> None:
        self.entered += 1
        assert self._open.wait(LIMIT), "nobody has opened the gate: the loop was blocked"
        if self.error is not None:
            raise self.error

    def open(self) -> None:
        self._open.set()


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    gate = Gate()
    monkeypatch.setattr(type_supports, "load", gate.load)
    return gate


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The nodes that sessions have opened."""
    opened: list[Any] = []
    before = ros_node.RosNode.__init__

    def opening(node: Any, *args: Any) -> None:
        opened.append(node)
        before(node, *args)

    monkeypatch.setattr(ros_node.RosNode, "__init__", opening)
    return opened


@asynccontextmanager
async def opening(gate: Gate) -> AsyncIterator[tuple[Session, asyncio.Task[Session]]]:
    """A session whose opening waits at the gate."""
    session = Session("slow")
    task = asyncio.create_task(session.__aenter__())
    await until(lambda: gate.entered)
    try:
        yield session, task
    finally:
        gate.open()
        await asyncio.wait([task])
        await session.aclose()


def importers() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name == "rosasync import"]


async def test_other_tasks_have_their_turns(gate: Gate) -> None:
    async with opening(gate) as (session, task):
        for _ in range(TURNS):
            await asyncio.sleep(0)
        assert not task.done()
        gate.open()
        assert await task is session
        assert importers() == []
        assert session.node.get_name() == "slow"


@pytest.mark.parametrize("turns", range(4))
async def test_cancelled_it_leaves_nothing_behind(gate: Gate, nodes: list[Any], turns: int) -> None:
    session = Session("slow")
    task = asyncio.create_task(session.__aenter__())
    for _ in range(turns):
        await asyncio.sleep(0)
    task.cancel()
    task.cancel()
    gate.open()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert nodes == []
    assert importers() == []
    async with session:
        assert session.node.get_name() == "slow"


async def by_asyncio(opening: Awaitable[Session]) -> None:
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(TICK):
            await opening


async def by_anyio(opening: Awaitable[Session]) -> None:
    with anyio.move_on_after(TICK) as scope:
        await opening
    assert scope.cancelled_caught


async def by_wait_for(opening: Awaitable[Session]) -> None:
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(opening, TICK)


@pytest.mark.parametrize("limit", [by_asyncio, by_anyio, by_wait_for])
async def test_deadlines_hold_when_the_import_has_ended(
    gate: Gate, nodes: list[Any], limit: Callable[[Awaitable[Session]], Awaitable[None]]
) -> None:
    asyncio.get_running_loop().call_later(3 * TICK, gate.open)
    await limit(Session("slow").__aenter__())
    assert nodes == []
    assert importers() == []


async def test_an_import_error_is_raised(gate: Gate, nodes: list[Any]) -> None:
    gate.error = ImportError("no such library")
    gate.open()
    session = Session("slow")
    with pytest.raises(ImportError, match="no such library"):
        await session.__aenter__()
    assert nodes == []
    gate.error = None
    async with session:
        assert not session.closed


async def test_without_rclpy_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosasync._ros.type_supports", None)
    with pytest.raises(ImportError, match=r"pip install 'rosasync\[jazzy\]'"):
        await Session("slow").__aenter__()


async def test_closed_meanwhile(gate: Gate, nodes: list[Any]) -> None:
    async with opening(gate) as (session, task):
        await session.aclose()
        assert session.closed
        gate.open()
        with pytest.raises(SessionClosed):
            await task
    assert nodes == []


async def test_opened_twice_at_once(gate: Gate, nodes: list[Any]) -> None:
    async with opening(gate) as (session, task):
        with pytest.raises(UsageError, match="only once"):
            await session.__aenter__()
        gate.open()
        await task
    assert len(nodes) == 1


async def test_used_meanwhile(gate: Gate) -> None:
    async with opening(gate) as (session, _):
        with pytest.raises(UsageError, match="is not open"):
            session.service_is_ready("std_srvs/srv/Empty", "/echo")


async def test_many_at_once() -> None:
    async with AsyncExitStack() as stack:
        sessions = [Session(f"one_of_many_{number}") for number in range(5)]
        await asyncio.gather(*(stack.enter_async_context(session) for session in sessions))
        assert len({session.node.get_name() for session in sessions}) == 5


def test_a_loop_that_ends_meanwhile() -> None:
    entered, gate = threading.Event(), threading.Event()

    def held() -> None:
        entered.set()
        gate.wait(LIMIT)

    loop = asyncio.new_event_loop()
    task = loop.create_task(call_in_thread(held, "held"))
    while not entered.is_set():
        loop.run_until_complete(asyncio.sleep(0))
    [thread] = [thread for thread in threading.enumerate() if thread.name == "held"]
    with suppress(AttributeError):
        task._log_destroy_pending = False  # type: ignore[attr-defined]
    loop.close()
    del task
    gc.collect()
    gate.set()
    thread.join(LIMIT)
    assert not thread.is_alive()


PROGRAM = """
import asyncio, sys, threading
import anyio

class Hook:
    # Every import of rclpy waits until the loop has had another turn.
    def __init__(self):
        self.modules = {}
        self.turn = threading.Event()

    def find_spec(self, name, path=None, target=None):
        on_loop = threading.current_thread() is threading.main_thread()
        self.modules[name] = on_loop
        if name.partition(".")[0] == "rclpy" and not on_loop:
            self.turn.clear()
            assert self.turn.wait(20), "the loop was blocked"

hook = Hook()
sys.meta_path.insert(0, hook)
import rosasync

async def tick():
    while True:
        hook.turn.set()
        await asyncio.sleep(0)

async def main():
    ticking = asyncio.create_task(tick())
    # The hook holds the import lock, and anyio imports its backend when it is first used.
    with anyio.CancelScope():
        await asyncio.sleep(0)
    hook.modules.clear()
    async with rosasync.Session("fresh") as session:
        print("on the loop:", *(n for n, on_loop in hook.modules.items() if on_loop))
        print("in the thread:", *(n for n, on_loop in hook.modules.items() if not on_loop))
    ticking.cancel()

asyncio.run(main())
"""


async def start_fresh(program: str) -> asyncio.subprocess.Process:
    """Run a program in a process of its own."""
    return await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", program),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )


async def test_in_a_fresh_process_nothing_of_ros_is_imported_on_the_loop() -> None:
    process = await start_fresh(PROGRAM)
    output, errors = await process.communicate()
    assert process.returncode == 0, errors.decode()
    lines = dict(line.split(":", 1) for line in output.decode().splitlines() if "the" in line)
    on_loop = {name.partition(".")[0] for name in lines["on the loop"].split()}
    in_thread = {name.partition(".")[0] for name in lines["in the thread"].split()}
    assert {"rclpy", "rcl_interfaces", "type_description_interfaces"} <= in_thread
    assert on_loop <= sys.stdlib_module_names | {"anyio", "sniffio"}


INTERRUPTED = """
import asyncio, sys, threading, time

class Hook:
    def find_spec(self, name, path=None, target=None):
        if name == "rclpy":
            print("importing", flush=True)
            sys.stdin.read()

sys.meta_path.insert(0, Hook())
import rosasync

async def main():
    async with rosasync.Session("interrupted"):
        raise AssertionError("it was opened")

asyncio.run(main())
"""


async def test_ctrl_c_during_the_import() -> None:
    process = await start_fresh(INTERRUPTED)
    assert process.stdout is not None
    while (line := await process.stdout.readline()) != b"importing\n":
        assert line, "it ended before the import"
    process.send_signal(signal.SIGINT)
    assert process.stdin is not None
    process.stdin.close()
    _, errors = await process.communicate()
    assert process.returncode in (130, -signal.SIGINT), errors.decode()
    assert "KeyboardInterrupt" in errors.decode()
    assert "terminate called" not in errors.decode()
    assert "it was opened" not in errors.decode()


@pytest.mark.parametrize("domain", [233, 1042, 2**32])
async def test_a_context_of_a_domain_that_does_not_exist(domain: int) -> None:
    """Fast DDS would end the process."""
    context = rclpy.context.Context()
    rclpy.init(context=context, domain_id=domain)
    try:
        with pytest.raises(UsageError, match=f"no ROS domain {domain}"):
            async with Session("nowhere", context=context):
                pass
    finally:
        context.try_shutdown()


OPEN = """
import asyncio, rosasync
async def main():
    try:
        async with rosasync.Session("opened"):
            print("opened")
    except rosasync.RosasyncError as error:
        print(error)
asyncio.run(main())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environ", "arguments", "expected"),
    [
        ({"ROS_LOG_DIR": "/proc/none"}, (), "set ROS_LOG_DIR"),
        ({"HOME": "", "ROS_LOG_DIR": "", "ROS_HOME": ""}, (), "set ROS_LOG_DIR"),
        (
            {"ROS_STATIC_PEERS": "no.such.invalid", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"},
            (),
            "ROS_STATIC_PEERS",
        ),
        (
            {
                "ROS_SECURITY_ENABLE": "true",
                "ROS_SECURITY_STRATEGY": "Enforce",
                "ROS_SECURITY_KEYSTORE": "/no/such/folder",
            },
            (),
            "ROS_SECURITY_KEYSTORE",
        ),
        ({}, ("--ros-args", "-r", "x"), "--ros-args"),
        ({}, ("--ros-args", "--nonsense"), "--ros-args"),
        ({}, ("--ros-args", "\udcff"), "--ros-args"),
        ({"LC_ALL": "xx_YY.none", "RCUTILS_LOGGING_BUFFERED_STREAM": "x"}, (), "opened"),
    ],
)
def test_what_the_environment_prevents_is_an_exception(
    environ: dict[str, str], arguments: tuple[str, ...], expected: str
) -> None:
    done = subprocess.run(
        (sys.executable, "-c", OPEN, *arguments),
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environ},
        cwd=ROOT,
    )
    assert expected in own(done.stdout)
    assert ".c:" not in done.stdout
