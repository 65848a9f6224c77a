"""OpenTelemetry: spans and metrics of calls and requests. Needs the extra ``opentelemetry``.

::

    trace = OpenTelemetryTrace()
    async with rosasync.Session("my_app", trace=trace) as session:
        trace.observe_pool(session, "my_app")

The names follow the semantic conventions 1.44 for RPC.
"""

from __future__ import annotations

import asyncio
import contextvars
import time
import weakref
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING

try:
    from opentelemetry import context, metrics, trace
    from opentelemetry.context import Context
    from opentelemetry.metrics import CallbackOptions, Histogram, MeterProvider, Observation
    from opentelemetry.trace import Span, SpanKind, StatusCode, TracerProvider
except ImportError as error:
    raise ImportError(
        f"rosasync.opentelemetry needs the API of OpenTelemetry, which cannot be imported here "
        f"({error}): pip install 'rosasync[opentelemetry]'"
    ) from error

from rosasync.errors import HandlerFailed

if TYPE_CHECKING:
    from rosasync.session import Session
    from rosasync.statistics import KeyStatistics, ServiceKey
    from rosasync.tracing import CallEnd, CallPhase, TracedCall

__all__ = ["OpenTelemetryTrace"]

SCHEMA = "https://opentelemetry.io/schemas/1.44.0"
BUCKETS = (
    *(50e-6, 100e-6, 250e-6, 500e-6, 1e-3, 2.5e-3, 5e-3, 10e-3, 25e-3, 50e-3),
    *(0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0),
)
"""The boundaries of the histograms, in seconds. Those of the conventions begin at 5 ms, but a call
within one machine takes about 0.2 ms."""
POOL_TIMEOUT = 1.0
"""Seconds for which the thread that collects metrics waits for the loop of a session."""


class OpenTelemetryTrace:
    """A `Trace` that makes spans, and measures how long calls take.

    Each call is a span of kind CLIENT, below the current span of its caller. Each request is a span
    of kind SERVER with no parent, because a ROS request carries no context; its handler runs
    below it. Phases are events of the span. Spans and durations have the attributes
    ``rpc.system.name`` (``"ros2"``), ``rpc.method`` (the service type, ``"std_srvs/srv/SetBool"``)
    and ``ros.service.name`` (the service name). After a failure they also have ``error.type``: the
    class of the exception, or without one ``"dropped"`` or ``"undeliverable"``. For `HandlerFailed`
    it is the class of the exception that the server has reported.

    One object may serve several sessions, also in several threads.

    Args:
        tracer_provider: makes the spans; None for the global one.
        meter_provider: makes the instruments; None for the global one.
        action_calls: whether the calls that a goal of an action is made of have spans of their own,
            besides the goal's.
    """

    def __init__(
        self,
        tracer_provider: TracerProvider | None = None,
        meter_provider: MeterProvider | None = None,
        *,
        action_calls: bool = False,
    ) -> None:
        self.action_calls = action_calls
        self._tracer = trace.get_tracer("rosasync", None, tracer_provider, SCHEMA)
        self._meter = metrics.get_meter("rosasync", "", meter_provider, SCHEMA)
        self._durations = {side: self._make_histogram(side) for side in ("client", "server")}
        self._calls: dict[int, _Running] = {}
        self._pools: list[_Pool] = []
        # Once: a second instrument of the same name would have no callback.
        self._meter.create_observable_up_down_counter(
            "db.client.connection.count",
            [self._count_clients],
            "{connection}",
            "The number of clients that are idle or used.",
        )
        self._meter.create_observable_up_down_counter(
            "db.client.connection.pending_requests",
            [self._count_waiting],
            "{request}",
            "The number of callers that wait for a client.",
        )

    def start(self, call: TracedCall) -> contextvars.Context | None:
        """Start the span of a call, and return the context for the handler of a request."""
        server = call.side == "server"
        attributes = _attributes(call.srv_name, call.srv_type)
        to_epoch = time.time_ns() - time.monotonic_ns()
        span = self._tracer.start_span(
            call.srv_type,
            Context() if server else None,
            SpanKind.SERVER if server else SpanKind.CLIENT,
            attributes,
            start_time=call.time_ns + to_epoch,
        )
        self._calls[call.number] = _Running(span, attributes, to_epoch)
        if not server:
            return None
        handler_context = contextvars.copy_context()
        handler_context.run(context.attach, trace.set_span_in_context(span))
        return handler_context

    def phase(self, call: TracedCall, phase: CallPhase) -> None:
        """Add an event to the span."""
        running = self._calls[call.number]
        running.span.add_event(phase.name, timestamp=phase.time_ns + running.to_epoch)

    def end(self, call: TracedCall, end: CallEnd) -> None:
        """End the span, and record the duration."""
        running = self._calls.pop(call.number)
        span, attributes = running.span, running.attributes
        if end.error is not None or end.outcome not in ("answered", "detached"):
            attributes["error.type"] = _error_type(end)
            span.set_attribute("error.type", attributes["error.type"])
            span.set_status(StatusCode.ERROR, str(end.error or end.outcome))
        self._durations[call.side].record(
            (end.time_ns - call.time_ns) / 1e9, attributes, trace.set_span_in_context(span)
        )
        span.end(end.time_ns + running.to_epoch)

    def observe_pool(self, session: Session, pool_name: str) -> None:
        """Measure the pool of an open session until it is closed, or dropped.

        ``db.client.connection.count`` is the number of clients, by ``db.client.connection.state``,
        ``"idle"`` or ``"used"``. ``db.client.connection.pending_requests`` is the number of callers
        that wait. Both have ``ros.service.name`` and ``rpc.method``, and are named after the
        conventions for connection pools, so they are up-down counters: Prometheus shows them as
        gauges. They are read when metrics are collected, on any thread. Call this on the loop's
        thread, once for each session.

        Args:
            session: the session.
            pool_name: the ``db.client.connection.pool.name``, unique in the application.

        Raises:
            UsageError: the session is not open.
        """
        self._pools = [pool for pool in self._pools if not pool.closed]
        self._pools.append(_Pool(session, pool_name))

    def _count_clients(self, options: CallbackOptions) -> Iterator[Observation]:
        for statistics, attributes in self._services():
            used = statistics.clients - statistics.idle
            for state, count in (("idle", statistics.idle), ("used", used)):
                yield Observation(count, {**attributes, "db.client.connection.state": state})

    def _count_waiting(self, options: CallbackOptions) -> Iterator[Observation]:
        for statistics, attributes in self._services():
            yield Observation(statistics.waiting, attributes)

    def _services(self) -> Iterator[tuple[KeyStatistics, dict[str, str]]]:
        for pool in tuple(self._pools):
            if not pool.closed:
                for key, statistics in pool.services().items():
                    name = {"db.client.connection.pool.name": pool.name}
                    yield statistics, name | _attributes(key.srv_name, key.srv_type)

    def _make_histogram(self, side: str) -> Histogram:
        direction = "outgoing" if side == "client" else "incoming"
        return self._meter.create_histogram(
            f"rpc.{side}.call.duration",
            "s",
            f"Measures the duration of an {direction} Remote Procedure Call (RPC).",
            explicit_bucket_boundaries_advisory=BUCKETS,
        )


@dataclass(frozen=True, slots=True)
class _Running:
    """The span of a call that has not ended.

    Attributes:
        span: the span.
        attributes: those of the span and of the duration.
        to_epoch: the offset of the system clock to the monotonic clock, in ns.
    """

    span: Span
    attributes: dict[str, str]
    to_epoch: int


class _Pool:
    """Takes snapshots of the pool of one session, on any thread. Does not keep the session."""

    def __init__(self, session: Session, name: str) -> None:
        self.name = name
        self._pool = session.pool
        self._session = weakref.ref(session)
        self._loop = asyncio.get_running_loop()

    @property
    def closed(self) -> bool:
        session = self._session()
        return session is None or session.closed

    def services(self) -> Mapping[ServiceKey, KeyStatistics]:
        """Return the statistics of each service; none if the loop does not answer in time."""
        if asyncio._get_running_loop() is self._loop:
            return self._pool.statistics().keys
        snapshot: Future[Mapping[ServiceKey, KeyStatistics]] = Future()
        try:
            self._loop.call_soon_threadsafe(
                lambda: snapshot.set_result(self._pool.statistics().keys)
            )
            return snapshot.result(POOL_TIMEOUT)
        except (RuntimeError, TimeoutError):
            # The loop is closed, or blocked.
            return {}


def _attributes(srv_name: str, srv_type: str) -> dict[str, str]:
    return {"rpc.system.name": "ros2", "rpc.method": srv_type, "ros.service.name": srv_name}


def _error_type(end: CallEnd) -> str:
    if end.error is None:
        return end.outcome
    if isinstance(end.error, HandlerFailed) and end.error.error_type:
        return end.error.error_type
    kind = type(end.error)
    builtin = kind.__module__ == "builtins"
    return kind.__qualname__ if builtin else f"{kind.__module__}.{kind.__qualname__}"
