"""The arguments of a call: every way to call checks them alike, before anything is sent."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from rosasync import AsyncServiceProxy, Limits, Retry, Session
from tests.support.echo import ECHO, fill, request_of, service_class
from tests.support.fake_graph import FakeGraph
from tests.support.times import LIMIT

NAME = "/echo"
Way = Callable[..., Awaitable[object]]


async def session_call(session: Session, request: object, **options: Any) -> object:
    return await session.call(ECHO, NAME, request, **options)


async def session_start(session: Session, request: object, **options: Any) -> object:
    return session.start(ECHO, NAME, request, **options)


async def client_call(session: Session, request: object, **options: Any) -> object:
    return await session.client(ECHO, NAME).call(request, **options)


async def client_start(session: Session, request: object, **options: Any) -> object:
    return session.client(ECHO, NAME).start(request, **options)


async def lease_call(session: Session, request: object, **options: Any) -> object:
    async with session.pool.lease(ECHO, NAME) as client:
        return await client.call(request, **options)


async def portal_call(session: Session, request: object, **options: Any) -> object:
    portal = session.from_thread
    return await asyncio.to_thread(lambda: portal.call(ECHO, NAME, request, **options))


async def portal_submit(session: Session, request: object, **options: Any) -> object:
    portal = session.from_thread
    return await asyncio.to_thread(lambda: portal.submit(ECHO, NAME, request, **options))


async def proxy_call(session: Session, request: object, **options: Any) -> object:
    proxy = AsyncServiceProxy(session, ECHO, NAME)
    proxy.call_service(request, **options)
    return proxy


WAYS: list[Way] = [
    session_call,
    session_start,
    client_call,
    client_start,
    lease_call,
    portal_call,
    portal_submit,
    proxy_call,
]
WITHOUT: dict[Way, tuple[str, ...]] = {lease_call: ("wait",), proxy_call: ("retry",)}
WRONG: list[tuple[str, Any, type[Exception]]] = [
    ("request", 5, TypeError),
    ("request", service_class(ECHO).Response(), TypeError),
    ("request", {"no_such_field": 1}, ValueError),
    ("timeout", "soon", TypeError),
    ("timeout", True, TypeError),
    ("timeout", Decimal(1), TypeError),
    ("timeout", math.nan, ValueError),
    ("timeout", np.float32("nan"), ValueError),
    ("timeout", 10**400, ValueError),
    ("wait", "1", TypeError),
    ("wait", math.nan, ValueError),
    ("wait", None, TypeError),
    ("retry", 3, TypeError),
    ("retry", Retry, TypeError),
]


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("name", "value", "error"), WRONG)
async def test_a_wrong_argument_raises_at_once_and_nothing_is_sent(
    fake_graph: FakeGraph, way: Way, name: str, value: Any, error: type[Exception]
) -> None:
    if name in WITHOUT.get(way, ()):
        return
    server = fake_graph.serve(ECHO, NAME, lambda request: service_class(ECHO).Response())
    async with fake_graph.session() as session:
        request = value if name == "request" else request_of("x")
        options = {} if name == "request" else {name: value}
        with pytest.raises(error):
            await way(session, request, **options)
        assert server.received == []
        total = session.pool.statistics()
        assert (total.in_flight, total.waiting, total.abandoned) == (0, 0, 0)


async def test_wrong_arguments_take_no_place_for_good(session: Session, echo: str) -> None:
    client = session.client(ECHO, echo)
    wrong: Any = 3
    for _ in range(2 * Limits().in_flight):
        with pytest.raises(TypeError, match="retry must be a rosasync.Retry"):
            await client.call(request_of("x"), retry=wrong)
    await asyncio.gather(*(client.call(request_of("x"), timeout=LIMIT) for _ in range(20)))
    assert session.pool.statistics().in_flight == 0


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("number", [5, 5.0, np.float32(5), np.float64(5), np.int16(5), Fraction(5)])
async def test_every_real_number_is_a_timeout(fake_graph: FakeGraph, way: Way, number: Any) -> None:
    response_class = service_class(ECHO).Response
    fake_graph.serve(ECHO, NAME, lambda request: fill(request, response_class()))
    async with fake_graph.session() as session:
        ended = await way(session, request_of("x"), timeout=number)
        if isinstance(ended, asyncio.Task):
            await ended


def test_every_whole_number_is_a_limit() -> None:
    limits = Limits(
        clients=np.int64(2),  # type: ignore[arg-type]
        in_flight=np.uint8(3),  # type: ignore[arg-type]
        waiting=np.int32(4),  # type: ignore[arg-type]
        idle=np.float32(1.5),  # type: ignore[arg-type]
        grace=Fraction(1, 2),  # type: ignore[arg-type]
    )
    assert limits == Limits(2, 3, 4, 1.5, 0.5)
    assert [type(value) for value in (limits.clients, limits.idle)] == [int, float]
    retry = Retry(np.int8(2), np.float16(0.5), np.float32(1), np.float32(0.5))  # type: ignore[arg-type]
    assert retry == Retry(2, 0.5, 1.0, 0.5)


@pytest.mark.parametrize("value", [2.0, np.float64(2), True, np.bool_(True), "2", None])
def test_nothing_else_is_a_limit(value: Any) -> None:
    with pytest.raises(TypeError, match="clients must be a whole number"):
        Limits(clients=value)


async def test_types_and_names_are_known_after_the_first_call_from_any_thread(
    fake_graph: FakeGraph,
) -> None:
    async with fake_graph.session() as session:
        arguments = session.core.arguments
        with ThreadPoolExecutor() as threads:
            services = set(threads.map(lambda _: arguments.service(ECHO, NAME, None), range(8)))
        assert len(services) == 1
