"""Arguments of every kind: each works, or is a clear error before anything is sent."""

from __future__ import annotations

import asyncio
import decimal
import fractions
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from std_srvs.srv import SetBool

from rosasync import CallError, InvalidServiceName, Limits, PoolFull, Retry, Session, UsageError
from tests.support.fake_graph import FakeGraph
from tests.support.times import LIMIT, TICK

REFUSALS = (TypeError, ValueError, UsageError)
"""The errors for an argument; InvalidServiceName is a ValueError."""

REALS = st.one_of(
    st.floats(),
    st.integers(),
    st.decimals(allow_nan=True, allow_infinity=True),
    st.fractions(),
    st.sampled_from(
        [
            math.nan,
            math.inf,
            -math.inf,
            10**400,
            decimal.Decimal("sNaN"),
            decimal.Decimal("1e999999"),
            fractions.Fraction(1, 3),
            numpy.float32(0.5),
            numpy.float64("nan"),
            numpy.int8(1),
            numpy.bool_(True),
            numpy.array([1.0]),
            True,
            "1",
            None,
            ...,
            1j,
            [],
        ]
    ),
)
NAMES = st.one_of(
    st.text(max_size=20),
    st.text("/~{}_ab1.: \0\ud800", max_size=12),
    st.sampled_from(["", "/", "~", "~/x", "/a//b", "a/", "/1a", "{node}/x", "x" * 300, "/ü"]),
)
ODD = st.one_of(NAMES, st.none(), st.integers(), st.binary(max_size=5), st.lists(st.none()))
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.one_of(REALS, st.text(max_size=5), st.binary(max_size=5)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


@pytest.fixture(scope="module")
def runner() -> Iterator[asyncio.Runner]:
    with asyncio.Runner() as runner:
        yield runner


@pytest.fixture(scope="module", params=["direct", "executor"])
def real(request: pytest.FixtureRequest, runner: asyncio.Runner) -> Iterator[Session]:
    """A session on rclpy, without any server."""
    session = Session("input", bridge=request.param)
    runner.run(_open(session))
    yield session
    runner.run(session.aclose())


async def _open(session: Session) -> None:
    await session.__aenter__()


def examples(full: bool) -> settings:
    return settings(
        max_examples=2_000 if full else 60,
        deadline=None,
        derandomize=not full,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


def test_names_and_types(real: Session, runner: asyncio.Runner, full: bool) -> None:
    @examples(full)
    @given(srv_type=st.one_of(ODD, st.just("std_srvs/srv/SetBool")), srv_name=ODD, wait=ODD)
    def check(srv_type: Any, srv_name: Any, wait: Any) -> None:
        async def call() -> None:
            try:
                await real.call(srv_type, srv_name, wait=False, timeout=LIMIT)
            except REFUSALS:
                return
            except CallError:
                assert isinstance(srv_name, str)
                return
            pytest.fail("there is no server")

        runner.run(call())
        for use in (
            lambda: real.client(srv_type, srv_name),
            lambda: real.start(SetBool, "/x", wait=wait).cancel(),
        ):
            try:
                runner.run(_in_loop(use))
            except REFUSALS:
                continue
        # The session still works.
        assert runner.run(_in_loop(lambda: real.service_is_ready(SetBool, "/absent"))) is False

    check()


async def _in_loop(use: Callable[[], Any]) -> Any:
    return use()


def test_names_that_are_refused_name_themselves(real: Session, runner: asyncio.Runner) -> None:
    for name in ("", "/", "a b", "/1a", "a//b", "x" * 300, "/\0", "/\ud800"):
        with pytest.raises(InvalidServiceName, match="valid service name"):
            runner.run(real.call(SetBool, name, timeout=LIMIT))


class Answered:
    """A session in memory, and how often its server was called."""

    def __init__(self, limits: Limits | None = None) -> None:
        self.graph = FakeGraph()
        self.server = self.graph.serve(
            SetBool, "/lamp", lambda request: SetBool.Response(success=request.data)
        )
        self.limits = limits

    async def call(self, request: Any = None, **options: Any) -> str:
        """Call, and return how it ended; a refused call has sent nothing."""
        async with self.graph.session(limits=self.limits) as session:
            try:
                response = await session.call(SetBool, "/lamp", request, **options)
            except REFUSALS:
                assert not self.server.received
                return "refused"
            except CallError:
                return "timed out"
            assert response.success in (True, False)
            assert len(self.server.received) == 1
            return "answered"


def test_timeouts(full: bool) -> None:
    @examples(full)
    @given(timeout=REALS)
    def check(timeout: Any) -> None:
        how = asyncio.run(Answered().call(timeout=timeout))
        if how == "timed out":
            # Also if it is negative: no time is left.
            assert float(timeout) < TICK
        if timeout is None or timeout is ...:
            assert how == "answered"

    check()
    assert asyncio.run(Answered().call(timeout=-1)) == "timed out"
    for refused in (math.nan, True, "1", 10**400, numpy.bool_(True), decimal.Decimal(9)):
        assert asyncio.run(Answered().call(timeout=refused)) == "refused", refused
    for accepted in (math.inf, LIMIT, fractions.Fraction(9), numpy.float32(9), numpy.int8(9)):
        assert asyncio.run(Answered().call(timeout=accepted)) == "answered", accepted


def test_mappings(full: bool) -> None:
    @examples(full)
    @given(request=st.one_of(VALUES, st.dictionaries(st.just("data"), VALUES)))
    def check(request: Any) -> None:
        how = asyncio.run(Answered().call(request, timeout=LIMIT))
        assert how in ("answered", "refused")
        if how == "answered":
            assert (
                request is None or request == {} or isinstance(request["data"], bool | numpy.bool_)
            )

    check()


def test_limits_and_retries(full: bool) -> None:
    fields = ["clients", "in_flight", "waiting", "idle", "grace", "server_depth"]
    retries = ["attempts", "after", "backoff"]

    @examples(full)
    @given(
        limits=st.dictionaries(st.sampled_from(fields), REALS),
        retry=st.dictionaries(st.sampled_from(retries), REALS),
    )
    def check(limits: Any, retry: Any) -> None:
        try:
            checked, again = Limits(**limits), Retry(**retry)
        except REFUSALS:
            return
        try:
            how = asyncio.run(Answered(checked).call(timeout=LIMIT, retry=again))
        except PoolFull:
            how = "answered"
        assert how == "answered"

    check()
    assert asyncio.run(Answered().call(timeout=LIMIT, retry=3)) == "refused"
