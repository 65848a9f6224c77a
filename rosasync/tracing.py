"""Tracing: the events of each call, for the hook of the session and for the log at DEBUG."""

from __future__ import annotations

import asyncio
import inspect
import itertools
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import Context
from dataclasses import dataclass
from time import monotonic_ns
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, TypeVar, runtime_checkable

if TYPE_CHECKING:
    from rosasync.statistics import ServiceKey

__all__ = [
    "CallEnd",
    "CallPhase",
    "CallTrace",
    "ClientTracing",
    "Outcome",
    "Phase",
    "ServerTrace",
    "ServerTracing",
    "Side",
    "Trace",
    "TracedCall",
    "Tracing",
    "check_trace",
]

logger = logging.getLogger("rosasync")

RECHECK_NS = 100_000_000
"""Nanoseconds for which it is remembered that nothing listens, because it is expensive to ask."""

Side: TypeAlias = Literal["client", "server"]
Phase: TypeAlias = Literal[
    "waiting",
    "queued",
    "sent",
    "sent again",
    "accepted",
    "canceling",
    "handling",
    "deferred",
    "failed",
]
Outcome: TypeAlias = Literal[
    "answered", "timed out", "cancelled", "failed", "dropped", "undeliverable", "detached"
]

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class TracedCall:
    """A call that a `Trace` follows.

    Attributes:
        number: identifies the call. Unique in this process, on both sides: the two sides of one
            call have two numbers.
        side: ``"client"`` for a call made, ``"server"`` for a request taken.
        srv_name: the resolved service name.
        srv_type: the name of the type, ``"std_srvs/srv/SetBool"``.
        time_ns: when it started, in ns of ``time.monotonic_ns()``.
    """

    number: int
    side: Side
    srv_name: str
    srv_type: str
    time_ns: int


@dataclass(frozen=True, slots=True)
class CallPhase:
    """The beginning of a phase of a call. A call may skip phases.

    On the client's side, a call is ``"waiting"`` for a server, ``"queued"`` for a place in the
    window, ``"sent"``, and ``"sent again"`` for each retry. The goal of an action is one call, and
    besides ``"accepted"`` and ``"canceling"``.

    On the server's side, it is ``"queued"`` for a handler, ``"handling"`` in one, ``"failed"`` if
    the handler or a hook has raised an exception, and ``"deferred"`` if the handler has returned
    without a response.

    Attributes:
        name: the phase.
        time_ns: when it began, in ns of ``time.monotonic_ns()``.
        error: what the handler raised, if it has failed.
    """

    name: Phase
    time_ns: int
    error: BaseException | None = None


@dataclass(frozen=True, slots=True)
class CallEnd:
    """The end of a call.

    Attributes:
        outcome: ``"answered"``; on the client's side otherwise ``"timed out"``, ``"cancelled"``,
            ``"failed"``, or ``"detached"`` for a goal that was left running; on the server's side
            otherwise ``"failed"`` or ``"cancelled"`` as its handler, ``"undeliverable"`` if the
            client cannot get the response, or ``"dropped"`` if nothing answered it.
        time_ns: when it ended, in ns of ``time.monotonic_ns()``.
        error: on the client's side, what the caller gets; on the server's side, what the handler
            raised, also if ``on_error`` answered.
    """

    outcome: Outcome
    time_ns: int
    error: BaseException | None = None


@runtime_checkable
class Trace(Protocol):
    """What ``Session(trace=…)`` calls for each call made and each request taken.

    Each call has one start, any number of phases, and exactly one end. The methods are called on
    the loop's thread, in the middle of the call: they should return quickly, and must not use the
    session. Their exceptions are logged, and do not disturb the call. If the loop is closed before
    a call ends, its end may be reported on another thread.
    """

    def start(self, call: TracedCall, /) -> Context | None:
        """Follow a call.

        It is called in the context of the caller, or of the loop for a request taken.

        Returns:
            For a request, the ``contextvars.Context`` in a copy of which its handler runs. None for
            the context of the loop.
        """

    def phase(self, call: TracedCall, phase: CallPhase, /) -> None:
        """Report that a phase of a call has begun."""

    def end(self, call: TracedCall, end: CallEnd, /) -> None:
        """Report the end of a call."""


def check_trace(trace: object) -> None:
    """Raise `TypeError` unless ``trace`` is a `Trace` or None."""
    if trace is not None and (inspect.isclass(trace) or not isinstance(trace, Trace)):
        raise TypeError(
            "trace must be an object with the methods start, phase and end of rosasync.Trace, "
            f"not {trace!r}"
        )


class Tracing:
    """Starts the traces of a session, if something listens: its hook, or the log at DEBUG.

    Confined to the loop's thread. A call that nothing listens to costs one comparison.

    Attributes:
        quiet_until: nothing listens before this time, in ns of ``time.monotonic_ns()``.
    """

    def __init__(self, hook: Trace | None = None) -> None:
        self.quiet_until = 0
        self._hooks: tuple[Trace, ...] = () if hook is None else (hook,)
        self._log = _LogTrace()
        self._muted = False

    @contextmanager
    def muted(self) -> Iterator[None]:
        """Follow no call that starts in this block: it is a part of a goal, which is followed.

        The block must not await anything. Hooks with a true ``action_calls`` follow these as well.
        """
        self._muted = True
        try:
            yield
        finally:
            self._muted = False

    def for_servers(self) -> Tracing:
        """Return what a server that is created now traces its requests by.

        In a muted block, that is a part of an action server, whose goals are followed.
        """
        return _PartTracing(self._hooks) if self._muted else self

    def follow(self, name: str, type_name: str) -> CallTrace | None:
        """Start the trace of an action's goal, if something listens."""
        now = monotonic_ns()
        listeners = () if now < self.quiet_until else self.listeners(now)
        if not listeners:
            return None
        return CallTrace(listeners, TracedCall(next(_numbers), "client", name, type_name, now))

    def listeners(self, now: int) -> tuple[Trace, ...]:
        """Return what listens to a call that starts now."""
        if self._muted:
            return tuple(hook for hook in self._hooks if getattr(hook, "action_calls", False))
        if logger.isEnabledFor(logging.DEBUG):
            return (*self._hooks, self._log)
        if not self._hooks:
            self.quiet_until = now + RECHECK_NS
        return self._hooks


class _PartTracing(Tracing):
    """Follows the calls of an action's services, only for hooks with a true ``action_calls``."""

    def __init__(self, hooks: tuple[Trace, ...]) -> None:
        super().__init__()
        self._hooks = hooks
        self._muted = True

    def listeners(self, now: int) -> tuple[Trace, ...]:
        """Return what listens to a call that starts now."""
        listeners = super().listeners(now)
        if not listeners:
            self.quiet_until = now + RECHECK_NS
        return listeners


class CallTrace:
    """The trace of one call: passes its events to the hooks. Confined to the loop's thread.

    Attributes:
        context: the context for the handler, which a hook has returned.
    """

    __slots__ = ("_call", "_ended", "_hooks", "_phase", "context")

    def __init__(self, hooks: tuple[Trace, ...], call: TracedCall) -> None:
        self.context: Context | None = None
        self._hooks = hooks
        self._call = call
        self._phase: Phase | None = None
        self._ended = False
        for hook in hooks:
            context = self._notify(hook.start, call)
            if isinstance(context, Context):
                # A copy, because a context can only be entered once at a time.
                self.context = context.copy()

    def enter(self, phase: Phase, error: BaseException | None = None) -> None:
        """Begin a phase, unless the call is waiting or queued already, or has ended."""
        if self._ended or (phase == self._phase and phase in _WAITS):
            return
        self._phase = phase
        event = CallPhase(phase, monotonic_ns(), error)
        for hook in self._hooks:
            self._notify(hook.phase, self._call, event)

    def end(self, outcome: Outcome, error: BaseException | None = None) -> None:
        """End the call, unless it has ended."""
        if not self._ended:
            self._ended = True
            self._report(CallEnd(outcome, monotonic_ns(), error))

    def _report(self, end: CallEnd) -> None:
        for hook in self._hooks:
            self._notify(hook.end, self._call, end)

    def _notify(self, method: Callable[..., T], *event: Any) -> T | None:
        try:
            return method(*event)
        except (Exception, asyncio.CancelledError):
            logger.exception("%s: the trace hook %r failed", self._call.srv_name, method)
            return None


class ClientTracing:
    """The traces of the calls of one service. Confined to the loop's thread.

    Args:
        tracing: the session's.
        key: the service.
    """

    def __init__(self, tracing: Tracing, key: ServiceKey) -> None:
        self._tracing = tracing
        self._key = key
        # Those whose calls wait for a server.
        self._unmatched: dict[CallTrace, None] = {}

    def start(self, now: int) -> CallTrace | None:
        """Start the trace of a call, if something listens."""
        listeners = self._tracing.listeners(now)
        return CallTrace(listeners, _traced_call("client", self._key, now)) if listeners else None

    def wait(self, trace: CallTrace, for_server: bool) -> None:
        """Begin the wait for a server, or for a place."""
        if for_server:
            self._unmatched[trace] = None
        trace.enter("waiting" if for_server else "queued")

    def on_matched(self) -> None:
        """Let the calls that waited for a server wait for a place, because a client is matched."""
        waiting, self._unmatched = self._unmatched, {}
        for trace in waiting:
            trace.enter("queued")

    def end(self, trace: CallTrace, outcome: Outcome, error: BaseException | None = None) -> None:
        """End the trace of a call."""
        self._unmatched.pop(trace, None)
        trace.end(outcome, error)


class ServerTrace(CallTrace):
    """The trace of a request to a server, which may be answered from any thread."""

    __slots__ = ("_end", "_error", "_server")

    def __init__(self, hooks: tuple[Trace, ...], call: TracedCall, server: ServerTracing) -> None:
        super().__init__(hooks, call)
        self._server = server
        # Both are dropped with the report, because an exception refers to the call in its frames.
        self._error: BaseException | None = None
        self._end: CallEnd | None = None

    def fail(self, error: BaseException) -> None:
        """Report that the handler, or a hook of the server, has raised an exception."""
        self.enter("failed", error)
        if self._error is None and not self._ended:
            self._error = error

    def end(self, outcome: Outcome, error: BaseException | None = None) -> None:
        """End the call, unless it has ended. From any thread."""
        if not self._ended:
            self._end = CallEnd(outcome, monotonic_ns(), error or self._error)
            self._ended = True
            self._server.call_on_loop(self.report_end)

    def end_unanswered(self) -> None:
        """End the call as its handler has ended. From any thread."""
        if self._error is None:
            self.end("dropped")
        else:
            cancelled = isinstance(self._error, asyncio.CancelledError)
            self.end("cancelled" if cancelled else "failed")

    def report_end(self) -> None:
        """Report the end, unless it has been reported."""
        end, self._end, self._error = self._end, None, None
        if end is not None:
            self._server.remove(self)
            self._report(end)


class ServerTracing:
    """The traces of one server's calls. On the loop's thread, unless a method says otherwise.

    Args:
        tracing: the session's.
        key: the server's service.
    """

    def __init__(self, tracing: Tracing, key: ServiceKey) -> None:
        self._tracing = tracing
        self._key = key
        self._loop = asyncio.get_running_loop()
        self._thread = threading.get_ident()
        # Those whose end has not been reported.
        self._open: dict[ServerTrace, None] = {}

    def start(self, now: int) -> ServerTrace | None:
        """Start the trace of a request, if something listens."""
        listeners = self._tracing.listeners(now)
        if not listeners:
            return None
        trace = ServerTrace(listeners, _traced_call("server", self._key, now), self)
        self._open[trace] = None
        return trace

    def remove(self, trace: ServerTrace) -> None:
        """Forget a trace."""
        del self._open[trace]

    def call_on_loop(self, callback: Callable[[], None]) -> None:
        """Call a function at once on the loop's thread, or soon. From any thread."""
        if threading.get_ident() != self._thread:
            # Otherwise the loop is closed.
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(callback)
                return
        callback()

    def close(self) -> None:
        """End the traces of the calls that are still open, because the server has ended."""
        for trace in tuple(self._open):
            trace.end_unanswered()
            trace.report_end()


_numbers = itertools.count(1)


def _traced_call(side: Side, key: ServiceKey, now: int) -> TracedCall:
    return TracedCall(next(_numbers), side, key.srv_name, key.srv_type, now)


class _LogTrace:
    """Logs each call in one line, when it has ended: its phases, and how long each took."""

    def __init__(self) -> None:
        self._phases: dict[int, list[CallPhase]] = {}

    def start(self, call: TracedCall) -> None:
        self._phases[call.number] = []

    def phase(self, call: TracedCall, phase: CallPhase) -> None:
        self._phases[call.number].append(phase)
        if phase.name == "sent again":
            after = _duration(phase.time_ns - call.time_ns)
            logger.debug("#%d %s: sent again after %s", call.number, call.srv_name, after)

    def end(self, call: TracedCall, end: CallEnd) -> None:
        phases = self._phases.pop(call.number)
        name = call.srv_name if call.side == "client" else f"serving {call.srv_name}"
        logger.debug("#%d %s: %s", call.number, name, "; ".join(_describe(call, phases, end)))


def _describe(call: TracedCall, phases: list[CallPhase], end: CallEnd) -> Iterator[str]:
    """Give a clause for each phase that is over, and one for the end."""
    state: str | None = None
    since = call.time_ns
    for phase in phases:
        took = _duration(phase.time_ns - since)
        if state in _WAITS:
            yield _WAITS[state].format(took)
        elif phase.name in ("sent again", "accepted", "canceling", "deferred", "failed"):
            yield f"{phase.name} after {took}{_reason(phase.error)}"
        state, since = phase.name, phase.time_ns
    took = _duration(end.time_ns - since)
    if state in _WAITS:
        yield _WAITS[state].format(took)
        yield f"{end.outcome}{_reason(end.error)}"
    elif state != "failed":
        yield f"{end.outcome} after {took}{_reason(end.error)}"
    elif end.outcome not in ("failed", "cancelled"):
        yield f"{end.outcome} after {took}"


_WAITS = {"waiting": "waited {} for a server", "queued": "queued {}"}


def _reason(error: BaseException | None) -> str:
    if error is None:
        return ""
    return f": {type(error).__name__}: {error}" if str(error) else f": {type(error).__name__}"


def _duration(nanoseconds: int) -> str:
    """Format a duration with two or three digits."""
    milliseconds = max(nanoseconds / 1e6, 0.001)
    if milliseconds < 99.5:
        return f"{milliseconds:.2g} ms"
    if milliseconds < 999.5:
        return f"{milliseconds:.0f} ms"
    seconds = milliseconds / 1000
    return f"{seconds:.3g} s" if seconds < 999.5 else f"{seconds:.0f} s"
