"""The handlers of a server: their kinds, and how they and the hooks run."""

from __future__ import annotations

import asyncio
import functools
import inspect
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextvars import Context
from dataclasses import dataclass
from time import monotonic
from typing import Any, Generic, TypeAlias

from rosasync._server.blocking import BLOCKING, BlockingReport
from rosasync._server.counts import CallCounts
from rosasync._server.handler_tasks import HandlerTasks
from rosasync._server.sending import ResponseSender
from rosasync._server.service_call import ServiceCall
from rosasync._status.wire import Outcome
from rosasync.errors import ContextShutdown, SessionClosed
from rosasync.typing import RequestT, ResponseT

__all__ = [
    "Answer",
    "ErrorHook",
    "Handler",
    "HandlerKind",
    "HandlerRunner",
    "OverloadHook",
    "settle_kind",
]

Answer: TypeAlias = ResponseT | Mapping[str, Any]
"""A response, or a mapping of its fields."""

Handler: TypeAlias = (
    Callable[[RequestT, ResponseT], Answer[ResponseT] | Awaitable[Answer[ResponseT]]]
    | Callable[
        [ServiceCall[RequestT, ResponseT]],
        Answer[ResponseT] | Awaitable[Answer[ResponseT] | None] | None,
    ]
)
"""``handler(request, response)`` or ``handler(call)``, plain or async."""

ErrorHook: TypeAlias = Callable[
    [ServiceCall[RequestT, ResponseT], Exception],
    Answer[ResponseT] | Awaitable[Answer[ResponseT] | None] | None,
]
"""``on_error(call, error)``, plain or async."""

OverloadHook: TypeAlias = Callable[
    [ServiceCall[RequestT, ResponseT]],
    Answer[ResponseT] | Awaitable[Answer[ResponseT] | None] | None,
]
"""``on_overload(call)``, plain or async."""

logger = logging.getLogger("rosasync")

LONG = 0.001
"""Seconds from which a plain handler is long: the loop should look for requests after it."""


@dataclass(frozen=True, slots=True)
class HandlerKind(Generic[RequestT, ResponseT]):
    """How to run a handler.

    Attributes:
        invoke: calls the handler with the arguments that it takes.
        may_defer: whether it may return None, to respond later.
        name: its name, for the log.
    """

    invoke: Callable[[ServiceCall[RequestT, ResponseT]], Any]
    may_defer: bool
    name: str


class HandlerRunner(Generic[RequestT, ResponseT]):
    """Runs the handler and the hooks of a server, and settles their calls.

    Confined to the loop's thread. Exceptions of handlers and hooks do not leave it, except those
    that end the program, such as KeyboardInterrupt.

    Args:
        kind: how to run the handler; None if the calls are iterated over.
        on_error: the hook for handlers that failed.
        sender: sends the responses.
        counts: counts the handlers that defer or fail.
        tasks: runs the async handlers.

    Attributes:
        on_finished: called when an async handler has finished; set by `HandlerStarter`.
        running: how many handlers run.
        was_long: whether the handler that was started last has blocked the loop for `LONG`.
    """

    def __init__(
        self,
        kind: HandlerKind[RequestT, ResponseT] | None,
        on_error: ErrorHook[RequestT, ResponseT] | None,
        sender: ResponseSender[ResponseT],
        counts: CallCounts,
        tasks: HandlerTasks,
    ) -> None:
        self.on_finished: Callable[[], None] = lambda: None
        self.running = 0
        self.was_long = False
        self._kind = kind
        self._on_error = on_error
        self._sender = sender
        self._counts = counts
        self._tasks = tasks
        self._blocking = BlockingReport(sender.name, "" if kind is None else kind.name)

    def start(self, call: ServiceCall[RequestT, ResponseT]) -> None:
        """Run the handler: a plain one to its end, an async one in a task."""
        trace = call.trace
        if trace is not None:
            trace.enter("handling")
        context = None if trace is None else trace.context
        self.running += 1
        in_task = False
        try:
            result = self._invoke(call, context)
            # The response first, because `isawaitable` is slow.
            if isinstance(result, self._sender.response_type) or not inspect.isawaitable(result):
                self._finish(call, result)
            else:
                in_task = True
                task = self._tasks.spawn(
                    self._await_handler(call, self._blocking.timed(result)),
                    lambda: self._never_ran(call, result),
                    context,
                )
                if call.status is not None:
                    call.status.task, call.status.pending = task, result
        except BaseException as error:
            self._contain(call, error, self._fail)
        finally:
            if not in_task:
                self.running -= 1

    def call_hook(
        self,
        call: ServiceCall[RequestT, ResponseT],
        hook: Callable[..., Any],
        arguments: tuple[Any, ...],
        otherwise: Callable[[ServiceCall[RequestT, ResponseT]], None],
        answered: Callable[[ServiceCall[RequestT, ResponseT]], None] = lambda call: None,
    ) -> None:
        """Send the response that a hook returns, plain or async.

        Args:
            call: the call to answer.
            hook: the hook.
            arguments: what it is called with.
            otherwise: called with the call if it is not answered then.
            answered: called with the call if it is.
        """
        try:
            result = hook(*arguments)
            if result is not None and inspect.isawaitable(result):
                self._tasks.spawn(
                    self._await_hook(call, result, otherwise, answered),
                    lambda: self._hook_never_ran(call, result, otherwise),
                )
                return
            if result is not None:
                call.respond(result)
        except BaseException as error:
            self._contain(call, error, self._fail_hook)
        (answered if call.responded else otherwise)(call)

    def _invoke(self, call: ServiceCall[RequestT, ResponseT], context: Context | None) -> Any:
        """Call the handler, in a context if there is one, and report it if it blocks the loop."""
        assert self._kind is not None
        invoke = self._kind.invoke
        began = monotonic()
        try:
            return invoke(call) if context is None else context.run(invoke, call)
        finally:
            took = monotonic() - began
            self.was_long = took > LONG
            if took > BLOCKING:
                self._blocking.report(took)

    def _never_ran(self, call: ServiceCall[RequestT, ResponseT], pending: Awaitable[Any]) -> None:
        """Settle a call whose handler's task was cancelled before it began."""
        self.running -= 1
        self._cancelled(call, pending)
        self.on_finished()

    def _hook_never_ran(
        self,
        call: ServiceCall[RequestT, ResponseT],
        pending: Awaitable[Any],
        otherwise: Callable[[ServiceCall[RequestT, ResponseT]], None],
    ) -> None:
        self._cancelled(call, pending)
        otherwise(call)

    def _cancelled(
        self, call: ServiceCall[RequestT, ResponseT], pending: Awaitable[Any] | None = None
    ) -> None:
        """Give up a call whose handler, or hook, was cancelled.

        Args:
            call: the call.
            pending: what the handler, or hook, has returned, if it has not been awaited.
        """
        if isinstance(pending, Coroutine):
            # Otherwise Python warns that it was never awaited.
            pending.close()
        # A handler that the end of the server cancels has not failed: another server may run it.
        closed = self._tasks.cancelled
        call.give_up(
            "given up: its handler was cancelled",
            Outcome.CLOSED if closed else Outcome.FAILED,
            error=None if closed else asyncio.CancelledError(),
        )
        if not call.responded:
            logger.log(
                logging.DEBUG if call.abandoned else logging.WARNING,
                "%s: the handler of %r was cancelled, so its client gets no response",
                self._sender.name,
                call,
            )

    async def _await_handler(
        self, call: ServiceCall[RequestT, ResponseT], pending: Awaitable[Any]
    ) -> None:
        try:
            self._finish(call, await pending)
        except BaseException as error:
            self._contain(call, error, self._fail)
        finally:
            self.running -= 1
            self.on_finished()

    async def _await_hook(
        self,
        call: ServiceCall[RequestT, ResponseT],
        pending: Awaitable[Any],
        otherwise: Callable[[ServiceCall[RequestT, ResponseT]], None],
        answered: Callable[[ServiceCall[RequestT, ResponseT]], None],
    ) -> None:
        try:
            result = await pending
            if result is not None:
                call.respond(result)
        except BaseException as error:
            self._contain(call, error, self._fail_hook)
        (answered if call.responded else otherwise)(call)

    def _finish(self, call: ServiceCall[RequestT, ResponseT], result: Any) -> None:
        assert self._kind is not None
        if result is not None:
            call.respond(result)
        elif not self._kind.may_defer:
            raise TypeError(
                "the handler returned None instead of the response: end it with `return response`; "
                "to respond later, take one argument, `call`, and use call.respond(response)"
            )
        elif not call.settled:
            self._counts.deferred += 1
            if call.trace is not None:
                call.trace.enter("deferred")

    def _contain(
        self,
        call: ServiceCall[RequestT, ResponseT],
        error: BaseException,
        fail: Callable[[ServiceCall[RequestT, ResponseT], Exception], None],
    ) -> None:
        """Settle a call whose handler, or hook, has raised; pass on what ends the program."""
        if call.trace is not None:
            call.trace.fail(error)
        if isinstance(error, asyncio.CancelledError):
            self._cancelled(call)
        elif isinstance(error, Exception):
            fail(call, error)
        else:
            raise error

    def _fail(self, call: ServiceCall[RequestT, ResponseT], error: Exception) -> None:
        if self._sender.ending is not None and isinstance(error, SessionClosed | ContextShutdown):
            logger.warning(
                "%s: the handler of %r outlasted the server, so its client gets no response",
                self._sender.name,
                call,
            )
            return
        self._counts.failed += 1
        if self._on_error is None or call.settled:
            self._give_up_failed(error, call)
        else:
            self.call_hook(
                call,
                self._on_error,
                (call, error),
                functools.partial(self._give_up_failed, error),
                functools.partial(self._log_answered, error),
            )

    def _log_answered(self, error: Exception, call: ServiceCall[RequestT, ResponseT]) -> None:
        """Log the error of a handler for which `on_error` has answered."""
        logger.debug(
            "%s: the handler of %r raised an exception, and on_error has answered",
            self._sender.name,
            call,
            exc_info=error,
        )

    def _give_up_failed(self, error: Exception, call: ServiceCall[RequestT, ResponseT]) -> None:
        """Log the error of a handler, and leave its call unanswered unless it is settled."""
        logger.error(
            "%s: the handler of %r raised an exception%s",
            self._sender.name,
            call,
            "" if call.settled else ", so its client gets no response",
            exc_info=error,
        )
        call.give_up("given up: its handler failed", Outcome.FAILED, failed=True, error=error)

    def _fail_hook(self, call: ServiceCall[RequestT, ResponseT], error: Exception) -> None:
        logger.error(
            "%s: on_error or on_overload raised an exception for %r",
            self._sender.name,
            call,
            exc_info=error,
        )


def settle_kind(
    handler: Handler[RequestT, ResponseT] | None,
) -> HandlerKind[RequestT, ResponseT] | None:
    """Decide how to run a handler, by the number of its required arguments.

    Raises:
        TypeError: it takes neither a call nor request and response.
    """
    if handler is None:
        return None
    if inspect.isclass(handler):
        raise TypeError(
            f"a handler is a function or a coroutine function, not the class {handler!r}"
        )
    if not callable(handler):
        raise TypeError(f"a handler must be callable, not {type(handler).__name__}")
    code: Any = handler
    while isinstance(code, functools.partial):
        code = code.func
    for function in (code, type(code).__call__):
        if inspect.isgeneratorfunction(function) or inspect.isasyncgenfunction(function):
            raise TypeError(f"a handler returns its response, it does not yield: {handler!r}")
    invoke: Callable[..., Any] = handler
    name = getattr(code, "__qualname__", type(code).__qualname__)
    match _count_required(handler):
        case 1:
            return HandlerKind(invoke, may_defer=True, name=name)
        case 2:
            return HandlerKind(
                lambda call: invoke(call.request, call.response), may_defer=False, name=name
            )
    raise TypeError(f"a handler takes (call) or (request, response): {handler!r} does not")


def _count_required(handler: Callable[..., Any]) -> int | None:
    """Return the number of required positional arguments; None if it needs others too."""
    try:
        parameters = inspect.signature(handler).parameters.values()
    except ValueError:
        return None
    required = [p for p in parameters if p.default is p.empty]
    if any(p.kind is p.KEYWORD_ONLY for p in required):
        return None
    return sum(p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) for p in required)
