"""StubServer: a server of a test, with its answers, its faults, and what it was asked."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias

from rosasync._core.text import count
from rosasync._ros.messages import to_dict, to_message
from rosasync._ros.types import service_type
from rosasync.options import check_seconds
from rosasync.testing._arrivals import Arrivals
from rosasync.testing._faults import Faults, FaultyService, StubCall, set_in_block
from rosasync.testing._matching import (
    check_fields,
    describe,
    difference,
    explain_mismatch,
    matches,
)
from rosasync.testing._rules import Match, Rules
from rosasync.typing import RequestT, ResponseT

if TYPE_CHECKING:
    from rosasync._server.server import ServiceServer
    from rosasync._server.service_call import ServiceCall

__all__ = ["Answer", "Match", "StubCall", "StubServer"]

Answer: TypeAlias = Any
"""A response message, a mapping of its fields, an exception that the handler raises, or None for no
answer at all."""


class StubServer(Generic[RequestT, ResponseT]):
    """A server in a `Graph`; created by `Graph.serve` and `Graph.stub`.

    It is a `rosasync.ServiceServer` on the graph's own node, in memory or on real ROS. Confined to
    the loop's thread.

    Attributes:
        calls: the requests received, in order, each with its response.
        optional: whether a strict graph accepts that it is never called.
    """

    def __init__(
        self,
        srv_type: Any,
        srv_name: str,
        handler: Any,
        options: Mapping[str, Any],
        optional: bool,
        open_server: Callable[..., ServiceServer[RequestT, ResponseT]],
        on_unexpected: Callable[[str], None],
    ) -> None:
        self.calls: list[StubCall[RequestT, ResponseT]] = []
        self.optional = optional
        self._type = service_type(srv_type)
        self._name = srv_name
        self._handler = self._answer if handler is STUB else handler
        self._options = options
        self._open_server = open_server
        self._rules = Rules[Answer](self._type.Request, on_unexpected)
        self._faults = Faults()
        self._arrivals = Arrivals()
        self._server = self._open()

    def __repr__(self) -> str:
        state = "vanished" if self._server.closed else "up"
        return f"<StubServer {self.srv_name} {state}, {count(len(self.calls), 'call')}>"

    async def __aiter__(self) -> AsyncIterator[ServiceCall[RequestT, ResponseT]]:
        """Iterate over the calls, if `Graph.serve` was given no handler."""
        async for call in self._server:
            yield call

    @property
    def srv_name(self) -> str:
        """The resolved service name."""
        return self._server.srv_name

    @property
    def server(self) -> ServiceServer[RequestT, ResponseT]:
        """The server itself; another one after `come_back`."""
        return self._server

    @property
    def requests(self) -> list[dict[str, Any]]:
        """The fields of the requests received, in order, as plain values to compare."""
        return [to_dict(call.request) for call in self.calls]

    @property
    def lost_requests(self) -> int:
        """The number of requests that `drop_requests` lost, which are not in `calls`."""
        return self._faults.lost_requests

    # Answers.

    def answer(self, *answers: Answer, match: Match[RequestT] = None) -> Self:
        """Answer requests of a server that `Graph.stub` created.

        ::

            lamp.answer({"success": False}, match={"data": False})
            lamp.answer({"success": False}, {"success": True}, match={"data": True})
            lamp.answer({"success": True})

        For each request, the first rule that matches and has an answer left counts. If there is
        none, the request stays unanswered, and a strict graph fails the test.

        Args:
            answers: a single one answers every request, several are given in turn, once each. A
                response, a mapping of its fields, an exception that the handler raises (the request
                then stays unanswered, as with any handler that fails), or None for no answer.
            match: which requests: a mapping of the fields that count, or a function of the request.

        Raises:
            TypeError, ValueError: an answer or a field does not fit the service type.
        """
        self._rules.check(self.srv_name, match, answers)
        self._rules.add(match, [self._prepare(answer) for answer in answers])
        return self

    def _prepare(self, answer: Answer) -> Answer:
        if isinstance(answer, Mapping):
            return to_message(self._type.Response, answer)
        if answer is None or isinstance(answer, (Exception, self._type.Response)):
            return answer
        if isinstance(answer, type) and issubclass(answer, Exception):
            return answer
        raise TypeError(
            f"{self.srv_name}: an answer is a response, a mapping of its fields, an exception or "
            f"None, not {type(answer).__name__}"
        )

    def _answer(self, call: ServiceCall[Any, Any]) -> Any:
        answer = self._rules.take(self.srv_name, call.request)
        if answer is None:
            call.give_up("left unanswered by the test")
        elif isinstance(answer, (type, Exception)):
            raise answer
        return answer

    # Faults.

    def delay_responses(self, seconds: float) -> AbstractContextManager[None]:
        """Delay responses by a number of seconds, in this block."""
        return set_in_block(self._faults, "delay", check_seconds("seconds", seconds))

    def drop_requests(self) -> AbstractContextManager[None]:
        """Lose every request that arrives in this block."""
        return set_in_block(self._faults, "dropping_requests", True)

    def drop_responses(self) -> AbstractContextManager[None]:
        """Lose every response that is sent in this block."""
        return set_in_block(self._faults, "dropping_responses", True)

    def duplicate_responses(self) -> AbstractContextManager[None]:
        """Send every response of this block twice."""
        return set_in_block(self._faults, "duplicating", True)

    @contextmanager
    def hold_responses(self) -> Iterator[None]:
        """Hold every response of this block, and send it at the end of the block: late."""
        try:
            with set_in_block(self._faults, "holding", True):
                yield
        finally:
            self._faults.release()

    async def vanish(self) -> None:
        """Leave the graph, as a node that crashed; idempotent.

        Running handlers are cancelled, and unanswered requests stay unanswered.
        """
        self._faults.held.clear()
        await self._server.aclose(timeout=0)

    async def come_back(self) -> None:
        """Enter the graph again, as a node that was restarted; does nothing if it is there."""
        if self._server.closed:
            self._server = self._open()

    # What was called.

    async def wait_for_calls(
        self, number: int = 1, timeout: float = 10.0
    ) -> list[StubCall[RequestT, ResponseT]]:
        """Wait until it has received a number of requests, and return them.

        Raises:
            AssertionError: it has not, after ``timeout`` seconds.
        """
        if not await self._arrivals.wait_for(number, self.calls, timeout):
            raise self._failure(f"expected {count(number, 'call')} within {timeout:g} s")
        return self.calls[:number]

    def assert_called(self, times: int | None = None) -> None:
        """Check that it was called, or how often.

        Raises:
            AssertionError: it was not; the message lists the requests.
        """
        __tracebackhide__ = True
        if times is None and not self.calls:
            raise self._failure("expected a call")
        if times is not None and len(self.calls) != times:
            raise self._failure(f"expected {count(times, 'call')}")

    def assert_called_with(self, fields: Mapping[str, Any] | None = None, **more: Any) -> None:
        """Check that one of the requests has these fields; others do not count.

        Raises:
            AssertionError: none has; the message lists the requests, and shows the difference from
                the last one.
            ValueError: the request has no such field.
        """
        __tracebackhide__ = True
        expected = {**(fields or {}), **more}
        check_fields(self._type.Request, expected)
        requests = self.requests
        if any(matches(expected, request) for request in requests):
            return
        shown = ""
        if requests:
            last = {name: requests[-1][name] for name in expected}
            shown = f"\n{difference(expected, last)}"
        raise self._failure(f"expected a call with {expected}", shown)

    def assert_requests(self, *expected: Mapping[str, Any]) -> None:
        """Check all requests, in order; of each, only the fields that are given count.

        Raises:
            AssertionError: they differ; the message shows where.
            ValueError: the request has no such field.
        """
        __tracebackhide__ = True
        differences = explain_mismatch(self._type.Request, expected, self.requests)
        if differences is not None:
            raise self._failure(f"expected {count(len(expected), 'request')}", f"\n{differences}")

    def _failure(self, expected: str, more: str = "") -> AssertionError:
        received = describe(self.requests, self.lost_requests)
        return AssertionError(f"{self.srv_name}: {expected}, but {received}{more}")

    # Serving.

    def _open(self) -> ServiceServer[RequestT, ResponseT]:
        return self._open_server(
            lambda opener, service, deliver: FaultyService(
                opener, service, deliver, self._faults, self._on_call
            ),
            self._type,
            self._name,
            self._handler,
            **self._options,
        )

    def _on_call(self, call: StubCall[RequestT, ResponseT]) -> None:
        self.calls.append(call)
        self._arrivals.notify()


STUB = object()
"""The handler of a server whose answers are given by `StubServer.answer`."""
