"""Sessions, contexts and processes that end in every way and at every moment."""

from __future__ import annotations

import asyncio
import gc
import signal
import threading
import time
import warnings
from typing import Any

import pytest

from rosasync import ContextShutdown, Session, SessionClosed
from tests.faults.trial import Trial
from tests.support.checks import check_call
from tests.support.echo import ECHO
from tests.support.nodes import reports
from tests.support.program import run_program
from tests.support.servers import ServerProcess
from tests.support.serving import FORMS
from tests.support.times import LIMIT, TICK, until

pytestmark = pytest.mark.slow


async def test_closed_under_calls(trial: Trial, server: ServerProcess, full: bool) -> None:
    """Some calls are out then, others wait for a place, for a server, or have just been made."""
    await server.serve("/slow", delay=(0.0, TICK))
    for number in range(100 if full else 8):
        async with asyncio.TaskGroup() as group, trial.session() as session:
            for name in ("/slow", "/absent"):
                group.create_task(trial.calls(session, name, 20, timeout=LIMIT))
            await asyncio.sleep(number % 8 * TICK / 4)
            group.create_task(trial.calls(session, "/slow", 5, timeout=LIMIT))
            await session.aclose()
    assert trial.failed.keys() == {"SessionClosed"}


async def test_300_sessions_in_a_row(trial: Trial, echo: str, full: bool) -> None:
    for _ in range(300 if full else 10):
        async with trial.session() as session:
            await trial.calls(session, echo, 3, timeout=LIMIT)
    assert not trial.failed


async def test_context_shut_down_by_another_thread(trial: Trial, echo: str, full: bool) -> None:
    """Whatever is done at that moment works, or raises ContextShutdown and nothing else."""
    with reports() as reported:
        for number in range(200 if full else 10):
            async with Session("brief", bridge=trial.bridge) as session:
                await check_call(session, echo, "warm", timeout=LIMIT)
                context = session.node.context
                thread = threading.Thread(target=_shut_down, args=(context, number % 10))
                thread.start()
                async with asyncio.TaskGroup() as group:
                    group.create_task(_call_until_shut_down(trial, session, echo))
                    group.create_task(_use_until_shut_down(session))
                thread.join()
    assert reported == []
    assert trial.failed.keys() == {"ContextShutdown"}


def _shut_down(context: Any, delay: int) -> None:
    time.sleep(delay * TICK / 50)
    context.shutdown()


async def _call_until_shut_down(trial: Trial, session: Session, name: str) -> None:
    while await trial.call(session, name, timeout=LIMIT) == "answered":
        pass


async def _use_until_shut_down(session: Session) -> None:
    for number in range(100_000):
        try:
            session.service_is_ready(ECHO, f"/absent_{number % 5}")
            async with session.serve(ECHO, f"/served_{number % 5}", FORMS["plain, call"]) as server:
                server.statistics()
                session.statistics()
                await asyncio.sleep(0)
        except ContextShutdown:
            return
    pytest.fail("the context was not shut down")


async def test_dropped_unclosed_by_threads(trial: Trial, echo: str, full: bool) -> None:
    """Sessions in loops of several threads, never closed: the collector ends them."""
    each, lock = (20 if full else 2), threading.Lock()
    errors: list[BaseException] = []

    async def open_and_drop() -> None:
        session = Session("dropped", bridge=trial.bridge)
        await session.__aenter__()
        await check_call(session, echo, "text", timeout=LIMIT)
        with lock:
            trial.row.made += 1
            trial.row.answered += 1

    def work() -> None:
        try:
            for _ in range(each):
                asyncio.run(open_and_drop())
                gc.collect()
        except BaseException as error:
            errors.append(error)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        threads = [threading.Thread(target=work) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            await asyncio.to_thread(thread.join)
        gc.collect()
    assert errors == []
    await until(lambda: not [t for t in threading.enumerate() if t.name.startswith("rosasync")])


OPEN = """
async def main():
    async with Session("ended", bridge=bridge, timeout=30.0) as session:
        await check_call(session, "/echo", "text")
        print("called", flush=True)
        await session.call("std_srvs/srv/Trigger", "/absent", timeout=None)
asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("signals", "codes"),
    [
        pytest.param([signal.SIGINT], {130, -2}, id="SIGINT"),
        pytest.param([signal.SIGINT] * 2, {130, -2}, id="SIGINT twice"),
        pytest.param([signal.SIGTERM], {-15}, id="SIGTERM"),
    ],
)
@pytest.mark.usefixtures("echo")
async def test_a_program_ended_by(trial: Trial, signals: list[int], codes: set[int]) -> None:
    await _run(trial, OPEN, codes, *signals)


FORKING = """
import multiprocessing, os

async def main():
    async with Session("parent", bridge=bridge, timeout=30.0) as session:
        await check_call(session, "/echo", "before")
        print("called", flush=True)
        pid = os.fork()
        if not pid:
            os._exit(0)
        assert os.waitpid(pid, 0)[1] == 0
        await check_call(session, "/echo", "after a fork")
        for method in ("fork", "spawn"):
            process = multiprocessing.get_context(method).Process(target=int)
            process.start()
            process.join()
            assert process.exitcode == 0, process.exitcode
            await check_call(session, "/echo", "after a process")

if __name__ == "__main__":
    asyncio.run(main())
"""


@pytest.mark.usefixtures("echo")
async def test_a_program_that_forks(trial: Trial) -> None:
    await _run(trial, FORKING, {0})


LEFT_OPEN = "session = asyncio.run(opened(bridge))"


@pytest.mark.usefixtures("echo")
async def test_a_program_that_leaves_its_session_open(trial: Trial) -> None:
    await _run(trial, LEFT_OPEN, {0})


async def _run(trial: Trial, program: str, codes: set[int], *signals: int) -> None:
    """Run a program that makes a call; each program counts as one answered call."""
    trial.row.made += 1
    code, errors = await run_program(trial.bridge, program, *signals)
    assert code in codes, errors
    assert SessionClosed.__name__ not in errors
    trial.row.answered += 1
