"""Handlers that block the loop are named in a warning, once for each server."""

from __future__ import annotations

import asyncio
import functools
from typing import TYPE_CHECKING, Any

import pytest

from rosasync._server.blocking import BLOCKING
from tests.support.echo import ECHO
from tests.support.serving import AnyCall, ask, discard, echo_of
from tests.support.times import until

if TYPE_CHECKING:
    from rosasync import Session


class Clock:
    """The clock of the handlers: it only goes on if a test says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def go_on(self, seconds: float = 2 * BLOCKING) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Replace the clock of the handlers, so that a busy machine is not mistaken for blocking."""
    clock = Clock()
    for module in ("handlers", "blocking"):
        monkeypatch.setattr(f"rosasync._server.{module}.monotonic", clock)
    return clock


def warnings_in(log: pytest.LogCaptureFixture) -> list[str]:
    return [message for message in log.messages if "blocked the event loop" in message]


async def call(session: Session, handler: Any, log: pytest.LogCaptureFixture) -> list[str]:
    """Serve a handler, call it twice, and return the warnings."""
    log.clear()
    async with session.serve(ECHO, "/served", handler):
        assert [await ask(session, "/served", text) for text in "xy"] == ["x", "y"]
    return warnings_in(log)


async def test_a_plain_handler(
    session: Session, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    def slow_lamp(call: AnyCall) -> Any:
        clock.go_on()
        return echo_of(call.request)

    def slow_pair(request: Any, response: Any) -> Any:
        clock.go_on()
        return echo_of(request)

    (warning,) = await call(session, slow_lamp, caplog)
    assert warning.startswith("/served: the handler ")
    assert "slow_lamp has blocked the event loop for 200 ms" in warning
    (warning,) = await call(session, functools.partial(slow_pair), caplog)
    assert "slow_pair has blocked" in warning


async def test_a_plain_handler_that_raises(
    session: Session, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    def slow(call: AnyCall) -> Any:
        clock.go_on()
        raise ValueError("no")

    async with session.serve(ECHO, "/served", slow, on_error=lambda call, _: echo_of(call.request)):
        await ask(session, "/served", "x")
    assert len(warnings_in(caplog)) == 1


@pytest.mark.parametrize("step", range(3))
async def test_each_step_of_an_async_handler(
    session: Session, clock: Clock, caplog: pytest.LogCaptureFixture, step: int
) -> None:
    async def slow(call: AnyCall) -> Any:
        for number in range(3):
            if number == step:
                clock.go_on()
            await asyncio.sleep(0)
        return echo_of(call.request)

    (warning,) = await call(session, slow, caplog)
    assert "slow has blocked" in warning


async def test_what_does_not_block(
    session: Session, clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    async def waits(call: AnyCall) -> Any:
        for _ in range(3):
            clock.go_on(0.9 * BLOCKING)
            await in_another_turn()
        return echo_of(call.request)

    async def in_another_turn() -> None:
        await asyncio.gather(asyncio.create_task(pass_time()))

    async def pass_time() -> None:
        clock.go_on()

    def future(call: AnyCall) -> Any:
        result = asyncio.get_running_loop().create_future()
        result.get_loop().call_soon(clock.go_on)
        result.get_loop().call_soon(result.set_result, echo_of(call.request))
        return result

    assert not await call(session, waits, caplog)
    assert not await call(session, future, caplog)


async def test_what_a_handler_awaits_reaches_it(session: Session) -> None:
    """Results, exceptions and cancellations pass through the measurement."""
    seen: list[str] = []

    async def handler(call: AnyCall) -> Any:
        seen.append(await asyncio.sleep(0, "result"))
        failing = asyncio.get_running_loop().create_future()
        failing.get_loop().call_soon(failing.set_exception, KeyError("raised"))
        try:
            await failing
        except KeyError as error:
            seen.append(error.args[0])
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            seen.append("cancelled")
            raise

    server = session.serve(ECHO, "/served", handler)
    task = ask(session, "/served", "x")
    await until(lambda: len(seen) == 2)
    await server.aclose(0)
    assert seen == ["result", "raised", "cancelled"]
    await discard(task)
