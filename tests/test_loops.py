"""The main paths, on asyncio's own loop and on uvloop."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import anyio
import pytest
import uvloop

from rosasync import (
    QueueTimeout,
    ResponseTimeout,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
)
from tests.support.checks import assert_clean, check_call
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.servers import ServerProcess

pytestmark = pytest.mark.asyncio(loop_factories=["asyncio", "uvloop"])


@pytest.fixture(autouse=True)
async def right_loop(request: pytest.FixtureRequest) -> None:
    """Check that the test runs on the loop of its parametrization."""
    is_uvloop = isinstance(asyncio.get_running_loop(), uvloop.Loop)
    assert is_uvloop == ("uvloop" in request.node.callspec.id)


async def test_calls_one_at_a_time_and_at_once(session: Session, echo: str) -> None:
    for number in range(100):
        await check_call(session, echo, str(number))
    async with asyncio.TaskGroup() as group:
        for number in range(500):
            group.create_task(check_call(session, echo, str(number)))
    await assert_clean(session)


async def test_deadlines_and_cancellation(patient_session: Session, server: ServerProcess) -> None:
    session = patient_session
    with pytest.raises(ServiceUnavailable):
        await session.call(ECHO, "/absent", timeout=TICK)
    await server.serve("/echo", delay="hold")
    await session.wait_for_service(ECHO, "/echo", timeout=LIMIT)
    with pytest.raises(ResponseTimeout):
        await session.call(ECHO, "/echo", timeout=4 * TICK)
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(4 * TICK):
            await session.call(ECHO, "/echo")
    with pytest.raises(TimeoutError):
        with anyio.fail_after(4 * TICK):
            await session.call(ECHO, "/echo")
    out = [session.start(ECHO, "/echo", request_of(str(n)), timeout=LIMIT) for n in range(7)]
    await server.received("/echo", 10)
    with pytest.raises(QueueTimeout):
        await session.call(ECHO, "/echo", timeout=2 * TICK)
    await server.release("/echo")
    assert [answer_to(await task) for task in out] == [str(n) for n in range(7)]
    await until(lambda: session.pool.statistics().late == 3)
    await assert_clean(session)


async def test_a_server_that_goes_and_comes(session: Session, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    task = session.start(ECHO, "/echo", request_of("out"), timeout=None)
    await server.received("/echo", 1)
    await server.stop("/echo")
    with pytest.raises(ServerGone):
        await task
    waiting = asyncio.create_task(check_call(session, "/echo", "back", timeout=LIMIT))
    await server.serve("/echo")
    await waiting


async def test_closing_with_calls_out(bridge: Bridge, server: ServerProcess) -> None:
    await server.serve("/echo", delay="hold")
    async with Session("closing", bridge=bridge) as session:
        tasks = [session.start(ECHO, "/echo", timeout=None) for _ in range(20)]
        await server.received("/echo", 10)
    for task in tasks:
        with pytest.raises(SessionClosed):
            await task
