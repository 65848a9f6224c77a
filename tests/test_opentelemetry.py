"""OpenTelemetry: spans and metrics, read from the exporters in memory of its SDK."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from typing import TYPE_CHECKING, Any

import pytest
from opentelemetry import trace as otel_trace
from opentelemetry.sdk.metrics import MeterProvider
from opentelemetry.sdk.metrics.export import InMemoryMetricReader
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

from rosasync import HandlerFailed, ResponseTimeout, Retry, Session, UsageError
from rosasync.opentelemetry import BUCKETS, OpenTelemetryTrace
from tests.support.echo import ECHO
from tests.support.process import ROOT
from tests.support.serving import AnyCall, Holder, Response, ask, discard, echo_call, echo_of
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge
    from tests.support.fake_graph import FakeGraph
    from tests.support.servers import ServerProcess


class Telemetry:
    """An `OpenTelemetryTrace`, and what it has exported."""

    def __init__(self) -> None:
        self._exporter = InMemorySpanExporter()
        self._reader = InMemoryMetricReader()
        self.tracers = TracerProvider()
        self.tracers.add_span_processor(SimpleSpanProcessor(self._exporter))
        self.meters = MeterProvider([self._reader])
        self.trace = OpenTelemetryTrace(self.tracers, self.meters)

    def spans(self, kind: SpanKind) -> list[ReadableSpan]:
        """The spans of a kind that have ended, in the order of their ends."""
        return [span for span in self._exporter.get_finished_spans() if span.kind is kind]

    def points(self, name: str) -> list[Any]:
        """Collect the metrics; return the data points of one."""
        data: Any = self._reader.get_metrics_data()
        return [
            point
            for resource in (data.resource_metrics if data else ())
            for scope in resource.scope_metrics
            for metric in scope.metrics
            if metric.name == name
            for point in metric.data.data_points
        ]

    def close(self) -> None:
        self.tracers.shutdown()
        self.meters.shutdown()


@pytest.fixture
def telemetry() -> Iterator[Telemetry]:
    telemetry = Telemetry()
    yield telemetry
    telemetry.close()


@pytest.fixture
async def observed(bridge: Bridge, telemetry: Telemetry) -> AsyncIterator[Session]:
    """An open session, on each bridge."""
    options: dict[str, Any] = {"bridge": bridge, "timeout": 2 * LIMIT, "trace": telemetry.trace}
    async with Session("observed", **options) as session:
        yield session


def attributes(name: str, **more: str) -> dict[str, str]:
    common = {"rpc.system.name": "ros2", "rpc.method": ECHO, "ros.service.name": name}
    return common | {key.replace("_", "."): value for key, value in more.items()}


class TestSpans:
    async def test_a_call_and_its_request(self, observed: Session, telemetry: Telemetry) -> None:
        observed.serve(ECHO, "/served", echo_call)
        tracer = telemetry.tracers.get_tracer("test")
        with tracer.start_as_current_span("caller") as caller:
            await ask(observed, "/served", "x")
        await until(lambda: telemetry.spans(SpanKind.SERVER))
        (client,) = telemetry.spans(SpanKind.CLIENT)
        (server,) = telemetry.spans(SpanKind.SERVER)
        for span in (client, server):
            assert span.name == ECHO
            assert span.attributes == attributes("/served")
            assert span.status.status_code is StatusCode.UNSET
            assert span.instrumentation_scope is not None
            assert (
                span.instrumentation_scope.schema_url == "https://opentelemetry.io/schemas/1.44.0"
            )
        assert client.parent == caller.get_span_context()
        assert server.parent is None
        assert [event.name for event in client.events][-1] == "sent"
        assert [event.name for event in server.events] == ["handling"]
        for span in (client, server):
            times = [span.start_time, *(event.timestamp for event in span.events), span.end_time]
            assert times == sorted(times)  # type: ignore[type-var]

    async def test_a_request_has_no_parent(
        self, fake_graph: FakeGraph, telemetry: Telemetry
    ) -> None:
        """The context in which the loop delivers a request may be that of any task."""
        tracer = telemetry.tracers.get_tracer("test")
        with tracer.start_as_current_span("opening"):
            async with fake_graph.session(trace=telemetry.trace) as session:
                session.serve(ECHO, "/served", echo_call)
                await ask(session, "/served", "x")
        (server,) = telemetry.spans(SpanKind.SERVER)
        assert server.parent is None

    @pytest.mark.parametrize("asynchronous", [True, False])
    async def test_the_calls_of_a_handler_are_below_its_request(
        self, observed: Session, telemetry: Telemetry, echo: str, asynchronous: bool
    ) -> None:
        tasks: list[asyncio.Task[str]] = []

        async def handler(call: AnyCall) -> Any:
            await asyncio.sleep(0)
            return Response(message=await ask(observed, echo, call.request.load_namespace))

        def plain_handler(call: AnyCall) -> None:
            async def answer() -> None:
                call.respond(await handler(call))

            tasks.append(asyncio.create_task(answer()))  # type: ignore[arg-type]

        observed.serve(ECHO, "/served", handler if asynchronous else plain_handler)
        assert await ask(observed, "/served", "x") == "x"
        await until(lambda: telemetry.spans(SpanKind.SERVER))
        inner, outer = telemetry.spans(SpanKind.CLIENT)
        (server,) = telemetry.spans(SpanKind.SERVER)
        assert inner.parent == server.get_span_context()
        assert outer.parent is None
        assert otel_trace.get_current_span() is otel_trace.INVALID_SPAN
        await asyncio.gather(*tasks)

    async def test_a_timeout_after_retries(
        self, observed: Session, telemetry: Telemetry, server: ServerProcess
    ) -> None:
        await server.serve("/silent", delay="never")
        await observed.wait_for_service(ECHO, "/silent")
        with pytest.raises(ResponseTimeout) as caught:
            await observed.call(ECHO, "/silent", timeout=20 * TICK, retry=Retry(2, after=TICK))
        (span,) = telemetry.spans(SpanKind.CLIENT)
        assert [event.name for event in span.events] == ["sent", "sent again"]
        assert span.attributes == attributes(
            "/silent", error_type="rosasync.errors.ResponseTimeout"
        )
        assert span.status.status_code is StatusCode.ERROR
        assert span.status.description == str(caught.value)

    async def test_a_cancellation(self, observed: Session, telemetry: Telemetry) -> None:
        task = ask(observed, "/none", "x")
        await asyncio.sleep(0)
        await discard(task)
        (span,) = telemetry.spans(SpanKind.CLIENT)
        assert span.attributes is not None
        assert span.attributes["error.type"] == "asyncio.exceptions.CancelledError"

    @pytest.mark.parametrize("answered", [True, False])
    async def test_a_handler_that_raises(
        self, observed: Session, telemetry: Telemetry, answered: bool
    ) -> None:
        def handler(call: AnyCall) -> Any:
            raise ValueError("no")

        def on_error(call: AnyCall, error: Exception) -> Any:
            return echo_of(call.request) if answered else None

        observed.serve(ECHO, "/served", handler, on_error=on_error)
        task = ask(observed, "/served", "x")
        await until(lambda: telemetry.spans(SpanKind.SERVER))
        (span,) = telemetry.spans(SpanKind.SERVER)
        assert span.attributes == attributes("/served", error_type="ValueError")
        assert (span.status.status_code, span.status.description) == (StatusCode.ERROR, "no")
        await discard(task)

    async def test_the_type_that_the_server_reports(
        self, fake_graph: FakeGraph, telemetry: Telemetry
    ) -> None:
        def handler(call: AnyCall) -> Any:
            raise LookupError("no")

        async with (
            fake_graph.session() as other,
            fake_graph.session(trace=telemetry.trace) as session,
        ):
            other.serve(ECHO, "/served", handler, status=True)
            await session.wait_for_service(ECHO, "/served")
            pool = session.pool.service(ECHO, "/served", None)
            node, listener = session.core.node, session.core.pool.listener

            def heard() -> bool:
                pool.match()
                return listener.hears(node.queries.find_servers(pool.service))

            await until(heard)
            with pytest.raises(HandlerFailed):
                await ask(session, "/served", "x", timeout=LIMIT)
        (span,) = telemetry.spans(SpanKind.CLIENT)
        assert span.attributes == attributes("/served", error_type="LookupError")

    async def test_a_request_that_nothing_answers(
        self, observed: Session, telemetry: Telemetry
    ) -> None:
        holder = Holder()
        server = observed.serve(ECHO, "/served", holder)
        task = ask(observed, "/served", "x")
        await holder.held(1)
        await server.aclose()
        (span,) = telemetry.spans(SpanKind.SERVER)
        assert span.attributes == attributes("/served", error_type="dropped")
        assert [event.name for event in span.events] == ["handling", "deferred"]
        await discard(task)


class TestMetrics:
    async def test_durations(self, observed: Session, telemetry: Telemetry) -> None:
        observed.serve(ECHO, "/served", echo_call)
        for number in range(3):
            await ask(observed, "/served", str(number))
        task = ask(observed, "/none", "x")
        await asyncio.sleep(0)
        await discard(task)
        await until(lambda: len(telemetry.spans(SpanKind.SERVER)) == 3)
        (server,) = telemetry.points("rpc.server.call.duration")
        assert server.attributes == attributes("/served")
        answered, cancelled = telemetry.points("rpc.client.call.duration")
        assert answered.attributes == attributes("/served")
        assert cancelled.attributes == attributes(
            "/none", error_type="asyncio.exceptions.CancelledError"
        )
        assert (server.count, answered.count, cancelled.count) == (3, 3, 1)
        assert answered.explicit_bounds == server.explicit_bounds == BUCKETS
        assert (BUCKETS[0], BUCKETS[-1]) == (50e-6, 10.0)
        spans = [
            span
            for span in telemetry.spans(SpanKind.CLIENT)
            if span.attributes == attributes("/served")
        ]
        total = sum((span.end_time or 0) - (span.start_time or 0) for span in spans) / 1e9
        assert answered.sum == pytest.approx(total)

    @pytest.mark.parametrize("from_thread", [True, False])
    async def test_the_pool(
        self,
        observed: Session,
        telemetry: Telemetry,
        server: ServerProcess,
        from_thread: bool,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr("rosasync.opentelemetry.POOL_TIMEOUT", LIMIT)
        await server.serve("/held", delay="hold")
        await observed.wait_for_service(ECHO, "/held")
        telemetry.trace.observe_pool(observed, "mine")

        async def count(metric: str) -> dict[str, int]:
            name = f"db.client.connection.{metric}"
            points = (
                await asyncio.to_thread(telemetry.points, name)
                if from_thread
                else telemetry.points(name)
            )
            pool = {"db.client.connection.pool.name": "mine"}
            states = [dict(point.attributes) for point in points]
            counts = [str(state.pop("db.client.connection.state", "")) for state in states]
            assert all(state == attributes("/held") | pool for state in states)
            return dict(zip(counts, (point.value for point in points), strict=True))

        assert await count("count") == {"idle": 1, "used": 0}
        tasks = [ask(observed, "/held", str(number)) for number in range(12)]
        await server.received("/held", 10)
        assert await count("count") == {"idle": 0, "used": 1}
        assert await count("pending_requests") == {"": 2}
        await server.change("/held", None)
        await server.release("/held")
        await asyncio.gather(*tasks)
        assert await count("count") == {"idle": 1, "used": 0}
        await observed.aclose()
        assert await count("count") == {}

    async def test_several_sessions(self, fake_graph: FakeGraph, telemetry: Telemetry) -> None:
        fake_graph.serve(ECHO, "/echo", echo_of)
        async with (
            fake_graph.session(trace=telemetry.trace) as one,
            fake_graph.session(trace=telemetry.trace) as two,
        ):
            telemetry.trace.observe_pool(one, "one")
            telemetry.trace.observe_pool(two, "two")
            await asyncio.gather(ask(one, "/echo", "x"), ask(two, "/echo", "x"))
            points = telemetry.points("db.client.connection.pending_requests")
            names = [point.attributes["db.client.connection.pool.name"] for point in points]
            assert sorted(names) == ["one", "two"]
        assert len(telemetry.spans(SpanKind.CLIENT)) == 2

    def test_a_loop_that_is_closed_or_blocked(
        self, fake_graph: FakeGraph, telemetry: Telemetry, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("rosasync.opentelemetry.POOL_TIMEOUT", TICK)
        session = fake_graph.session()

        async def open_session() -> None:
            await session.__aenter__()
            telemetry.trace.observe_pool(session, "mine")
            await discard(ask(session, "/none", "x"))

        loop = asyncio.new_event_loop()
        loop.run_until_complete(open_session())
        # The loop does not run now.
        assert telemetry.points("db.client.connection.count") == []
        loop.run_until_complete(session.aclose())
        loop.close()

    async def test_it_does_not_keep_a_session_that_is_dropped(
        self, fake_graph: FakeGraph, telemetry: Telemetry
    ) -> None:
        session = fake_graph.session()
        await session.__aenter__()
        telemetry.trace.observe_pool(session, "mine")
        sessions = [session]
        del session
        with pytest.warns(ResourceWarning, match="unclosed"):
            sessions.clear()
        assert telemetry.points("db.client.connection.count") == []

    async def test_a_session_that_is_not_open(self, telemetry: Telemetry) -> None:
        with pytest.raises(UsageError):
            telemetry.trace.observe_pool(Session("unopened"), "mine")


def test_without_opentelemetry_it_says_what_to_install() -> None:
    program = (
        "import sys; sys.modules['opentelemetry'] = None\n"
        "try:\n    import rosasync.opentelemetry\n"
        "except ImportError as error:\n    print(error)\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "pip install 'rosasync[opentelemetry]'" in process.stdout
