"""Servers that end, stall, multiply or misbehave while they are called."""

from __future__ import annotations

import asyncio
import os
import signal
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile

from rosasync import Limits, Retry, Session
from tests.faults.trial import PATIENT, Trial
from tests.support.echo import ECHO, request_of, service_class
from tests.support.nodes import borrowed_node
from tests.support.servers import Misbehaviour, ServerProcess
from tests.support.serving import FORMS
from tests.support.times import LIMIT, TICK, until

TRIGGER = "std_srvs/srv/Trigger"
TRANSIENT = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.mark.slow
async def test_killed_and_another_a_second_later(
    trial: Trial, server: ServerProcess, full: bool
) -> None:
    async with trial.session() as session:
        for round_ in range(1, 6 if full else 2):
            name = f"/killed_{round_}"
            # Longer than a busy machine may hold it up.
            async with ServerProcess(lease=3) as mortal, asyncio.TaskGroup() as group:
                await mortal.serve(name, delay="hold")
                group.create_task(trial.calls(session, name, 30, timeout=2 * LIMIT))
                await mortal.received(name, 10)
                await asyncio.to_thread(mortal.kill)
                await asyncio.sleep(20 * TICK if full else TICK)
                await server.serve(name)
            # Those that were out end with the server; those that waited are answered by the next.
            received = await server.received(name, 0)
            assert trial.failed == {"ServerGone": 10 * round_}, f"{len(received)} reached the next"


@pytest.mark.slow
async def test_stopped_and_continued(trial: Trial, full: bool) -> None:
    async with ServerProcess() as stopped, trial.session() as session:
        await stopped.serve("/stopped")
        await session.wait_for_service(ECHO, "/stopped", timeout=LIMIT)
        async with trial.callers(session, "/stopped", 20, timeout=8 * TICK):
            await trial.more_answers(100)
            os.kill(stopped.pid, signal.SIGSTOP)
            await asyncio.sleep(100 * TICK if full else 12 * TICK)
            os.kill(stopped.pid, signal.SIGCONT)
            await trial.more_answers(100)
    assert trial.failed
    assert trial.failed.keys() <= {"ResponseTimeout", "QueueTimeout"}


@pytest.mark.slow
@pytest.mark.parametrize("retry", [None, PATIENT], ids=["once", "Retry"])
async def test_restarted_under_callers(
    trial: Trial, server: ServerProcess, full: bool, retry: Retry | None
) -> None:
    async with (
        trial.session() as session,
        trial.callers(
            session,
            "/restarted",
            50 if full else 20,
            timeout=LIMIT if retry else 20 * TICK,
            retry=retry,
        ),
    ):
        for number in range(20 if full else 2):
            async with ServerProcess(lease=1) as mortal:
                await mortal.serve("/restarted")
                await trial.more_answers(100)
                await asyncio.sleep(40 * TICK if full else 4 * TICK)
                await asyncio.to_thread(mortal.kill if number % 2 else mortal.interrupt)
        await server.serve("/restarted")
        await trial.more_answers(100)
        trial.row.notes.append(f"{session.pool.statistics().retried:,} requests sent again")
    assert trial.failed.keys() <= {
        "ServerGone",
        "ServiceUnavailable",
        "ResponseTimeout",
        "QueueTimeout",
    }


@pytest.mark.parametrize("wrong", ["twice", "thrice", "forging"])
async def test_answering(
    trial: Trial, server: ServerProcess, full: bool, wrong: Misbehaviour
) -> None:
    await server.serve("/wrong", wrong=wrong)
    async with trial.session() as session:
        await session.wait_for_service(ECHO, "/wrong", timeout=LIMIT)
        for _ in range(100 if full else 5):
            await trial.calls(session, "/wrong", 30, timeout=LIMIT)
        assert not trial.failed
        assert session.pool.statistics().completed == trial.row.made


@pytest.mark.parametrize("retry", [None, PATIENT], ids=["once", "Retry"])
async def test_answering_every_second_request(
    trial: Trial, server: ServerProcess, full: bool, retry: Retry | None
) -> None:
    await server.serve("/half", wrong="every second")
    async with trial.session() as session:
        await session.wait_for_service(ECHO, "/half", timeout=LIMIT)
        for _ in range(20 if full else 2):
            timeout = LIMIT if retry else 10 * TICK
            await trial.calls(session, "/half", 10, timeout=timeout, retry=retry)
    assert trial.row.answered > 0
    if retry is not None:
        assert not trial.failed
    else:
        # Those that would be answered too late on a busy machine are not sent.
        assert trial.failed["ResponseTimeout"]
        assert trial.failed.keys() <= {"ResponseTimeout", "QueueTimeout"}


async def test_never_answering(trial: Trial, server: ServerProcess, full: bool) -> None:
    await server.serve("/never", delay="never")
    async with trial.session() as session:
        await session.wait_for_service(ECHO, "/never", timeout=LIMIT)
        for _ in range(20 if full else 2):
            await trial.calls(session, "/never", 50, timeout=4 * TICK)
        await server.change("/never", None)
        await trial.call(session, "/never", timeout=LIMIT)
    assert trial.row.answered == 1
    assert trial.failed.keys() <= {"ResponseTimeout", "QueueTimeout"}


async def test_one_of_two_ends(trial: Trial, server: ServerProcess, full: bool) -> None:
    """With Retry: the queue of the other one may have overflowed while this one answered."""
    await server.serve("/two")
    async with (
        ServerProcess() as other,
        trial.session() as session,
        trial.callers(session, "/two", 20, timeout=LIMIT, retry=PATIENT),
    ):
        await trial.more_answers(20)
        for _ in range(20 if full else 2):
            await other.serve("/two")
            await until(lambda: session.node.count_services("/two") == 2)
            await trial.more_answers(50)
            await other.stop("/two")
            await until(lambda: session.node.count_services("/two") == 1)
            await trial.more_answers(50)
    assert not trial.failed


async def test_with_clients_that_cannot_be_matched(trial: Trial, full: bool) -> None:
    """A response to such a client fails after a while; those of others must not wait for it."""
    async with Session("serving", bridge=trial.bridge) as serving, trial.session() as session:
        with borrowed_node("unmatched") as node:
            client = node.create_client(service_class(ECHO), "/unmatched", qos_profile=TRANSIENT)
            form = FORMS["async, request and response"]
            async with serving.serve(ECHO, "/unmatched", form) as server:
                await trial.call(session, "/unmatched", timeout=LIMIT)
                for _ in range(100 if full else 10):
                    client.call_async(request_of("unmatched"))
                    await trial.calls(session, "/unmatched", 10, timeout=LIMIT)
                while server.statistics().taken <= trial.row.made:
                    # Those that were sent before the server was discovered are lost.
                    client.call_async(request_of("unmatched"))
                    await trial.call(session, "/unmatched", timeout=LIMIT)
    assert not trial.failed


@pytest.mark.parametrize("obstacle", ["wrong type", "unmatched QoS"])
async def test_that_do_not_fit(
    trial: Trial, server: ServerProcess, echo: str, full: bool, obstacle: str
) -> None:
    await server.serve("/obstacle", TRIGGER if obstacle == "wrong type" else ECHO)
    options: dict[str, Any] = {} if obstacle == "wrong type" else {"qos": TRANSIENT}
    async with trial.session() as session:
        await session.wait_for_service(ECHO, echo, timeout=LIMIT)
        for _ in range(20 if full else 2):
            async with asyncio.TaskGroup() as group:
                calls = trial.calls(session, "/obstacle", 10, timeout=4 * TICK, **options)
                group.create_task(calls)
                group.create_task(trial.calls(session, echo, 10, timeout=LIMIT))
    assert trial.failed == {"ServiceUnavailable": trial.row.made // 2}


async def test_destroyed_and_made_again_at_once(
    trial: Trial, server: ServerProcess, full: bool
) -> None:
    limits = Limits(in_flight=10, grace=2 * TICK)
    async with trial.session(limits=limits) as session:
        await server.serve("/again")
        async with trial.callers(session, "/again", 20, timeout=40 * TICK):
            for _ in range(100 if full else 5):
                await trial.more_answers(50)
                await server.stop("/again")
                await server.serve("/again")
            await trial.more_answers(50)
    assert trial.failed.keys() <= {
        "ServerGone",
        "ServiceUnavailable",
        "ResponseTimeout",
        "QueueTimeout",
    }
