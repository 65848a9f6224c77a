"""More callers, services, bytes and requests than anything was made for, and threads that block."""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import threading
import time
from typing import Any

import pytest

from rosasync import Limits, PoolFull, Session
from tests.faults.trial import Trial
from tests.support.clients import ClientProcess
from tests.support.echo import ECHO, request_of
from tests.support.servers import ServerProcess
from tests.support.serving import FORMS, Holder, echo_call
from tests.support.times import LIMIT, TICK, until

pytestmark = pytest.mark.slow

MEGABYTE = 1_000_000


async def test_10000_callers(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/echo")
    async with trial.session() as session:
        await trial.calls(session, "/echo", 10_000 if full else 1_000, timeout=6 * LIMIT)
    assert not trial.failed


async def test_one_caller_beyond_the_limit(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/full", delay="hold")
    waiting = 10_000 if full else 100
    async with trial.session(limits=Limits(waiting=waiting)) as session:
        await session.wait_for_service(ECHO, "/full", timeout=LIMIT)
        async with asyncio.TaskGroup() as group:
            group.create_task(trial.calls(session, "/full", 10 + waiting, timeout=6 * LIMIT))
            await until(lambda: session.pool.statistics().waiting == waiting)
            for _ in range(10):
                assert await trial.call(session, "/full", timeout=LIMIT) == PoolFull.__name__
            await server.change("/full", None)
            await server.release("/full")
    assert trial.failed == {"PoolFull": 10}


async def test_500_services(trial: Trial, full: bool) -> None:
    names = [f"/service_{number}" for number in range(500 if full else 50)]
    async with Session("serving", bridge=trial.bridge) as serving:
        servers = [serving.serve(ECHO, name, FORMS["plain, call"]) for name in names]
        async with trial.session() as session, asyncio.TaskGroup() as group:
            for name in names:
                group.create_task(trial.calls(session, name, 10, timeout=4 * LIMIT))
        await asyncio.gather(*(server.aclose() for server in servers))
    assert not trial.failed


@pytest.mark.parametrize("size", [0, 1, 1_000, 64_000, 1_000_000, 30_000_000])
async def test_payloads_of_bytes(
    trial: Trial, server: ServerProcess, full: bool, size: int
) -> None:
    await server.serve("/large")
    text = "x" * (size if full else min(size, 2 * MEGABYTE))
    # The middleware keeps as much as it once needed.
    trial.growth += 40 * len(text) / MEGABYTE
    async with trial.session() as session:
        for _ in range(5 if full else 1):
            await trial.calls(session, "/large", 3, text=text, timeout=4 * LIMIT)
    assert not trial.failed


async def test_the_loop_blocked(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/echo")
    async with trial.session() as session, trial.callers(session, "/echo", 20, timeout=LIMIT):
        for _ in range(10 if full else 2):
            await trial.more_answers(50)
            time.sleep(20 * TICK if full else 4 * TICK)  # noqa: ASYNC251
        await trial.more_answers(50)
    assert not trial.failed


async def test_the_executor_thread_blocked(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/echo")
    async with trial.session() as session:
        blocking = 20 * TICK if full else 4 * TICK
        timer = session.node.create_timer(2 * blocking, lambda: time.sleep(blocking))
        async with trial.callers(session, "/echo", 20, timeout=LIMIT):
            for _ in range(10 if full else 1):
                await asyncio.sleep(2 * blocking)
                await trial.more_answers(50)
        session.node.destroy_timer(timer)
    assert not trial.failed


async def test_a_collector_that_always_runs(
    trial: Trial, server: ServerProcess, full: bool
) -> None:
    await server.serve("/echo")
    before = gc.get_threshold()
    async with trial.session() as session:
        await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
        gc.set_threshold(1, 1, 1_000)
        try:
            for _ in range(50 if full else 2):
                await trial.calls(session, "/echo", 20, timeout=2 * LIMIT)
        finally:
            gc.set_threshold(*before)
    assert not trial.failed


async def test_a_flood_of_requests(client_process: ClientProcess, trial: Trial, full: bool) -> None:
    """A flood of one service of a session, beside a healthy caller of another one."""
    overloaded = Holder()
    async with Session("serving", bridge=trial.bridge) as serving, trial.session() as session:
        flooded = serving.serve(ECHO, "/flooded", overloaded, concurrency=5, backlog=20)
        healthy = serving.serve(ECHO, "/healthy", FORMS["async, call"])
        async with trial.callers(session, "/healthy", 5, timeout=LIMIT):
            await client_process.start("/flooded", None, clients=4, in_flight=10, timeout=TICK)
            await until(lambda: flooded.statistics().taken > (5_000 if full else 200))
            await trial.more_answers(50)
            await client_process.result()
        await flooded.aclose()
        await healthy.aclose()
    overloaded.calls.clear()
    assert not trial.failed


async def test_a_flood_of_megabytes(trial: Trial, full: bool) -> None:
    """What waits is bounded in bytes too, long before the backlog is full."""
    requests, bound = (500 if full else 30), 10 * MEGABYTE
    text = "x" * MEGABYTE
    trial.growth += 400
    started = asyncio.Event()

    async def slow(request: Any, response: Any) -> Any:
        await started.wait()
        response.message = request.load_namespace
        return response

    unlimited = Limits(in_flight=requests, server_depth=None, grace=2 * TICK)
    async with (
        Session("serving", bridge=trial.bridge) as serving,
        trial.session(limits=unlimited) as session,
        serving.serve(
            ECHO, "/large", slow, concurrency=1, backlog_bytes=bound, on_overload=echo_call
        ) as server,
        serving.serve(ECHO, "/healthy", FORMS["async, call"]),
    ):
        await session.wait_for_service(ECHO, "/large", timeout=LIMIT)
        async with asyncio.TaskGroup() as group:
            for _ in range(requests):
                group.create_task(trial.call(session, "/large", text, timeout=LIMIT))
                await asyncio.sleep(0)
            await until(lambda: server.statistics().rejected > 0)
            for _ in range(20):
                await trial.call(session, "/healthy", timeout=LIMIT)
            assert server.statistics().waiting <= bound / MEGABYTE
            await until(lambda: server.statistics().taken == requests)
            started.set()
        assert server.statistics().rejected >= requests - 1 - bound / MEGABYTE
    assert not trial.failed


async def test_peers_that_read_nothing(trial: Trial, full: bool) -> None:
    """The queue of responses to a stopped process fills; other callers are answered as before."""
    async with (
        Session("serving", bridge=trial.bridge) as serving,
        trial.session() as session,
        serving.serve(ECHO, "/shared", FORMS["async, call"]) as server,
        ClientProcess() as peer,
    ):
        await peer.start("/shared", None, in_flight=8, timeout=4 * TICK)
        await until(lambda: server.statistics().responded > 20)
        os.kill(peer.pid, signal.SIGSTOP)
        for _ in range(100 if full else 10):
            await trial.calls(session, "/shared", 10, timeout=2 * LIMIT)
        os.kill(peer.pid, signal.SIGCONT)
        await peer.result()
    assert not trial.failed


async def test_calls_from_threads(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/echo")
    each = 200 if full else 10
    async with trial.session() as session:
        portal = session.from_thread

        def work(results: list[bool]) -> None:
            for number in range(each):
                text = f"{threading.get_ident()}-{number}"
                response = portal.call(ECHO, "/echo", request_of(text), timeout=2 * LIMIT)
                results.append(response.message == text)

        results: list[bool] = []
        threads = [threading.Thread(target=work, args=(results,)) for _ in range(20)]
        for thread in threads:
            thread.start()
        for thread in threads:
            await asyncio.to_thread(thread.join)
        trial.row.made += len(results)
        trial.row.answered += results.count(True)
        trial.row.wrong += results.count(False)
        assert len(results) == 20 * each
