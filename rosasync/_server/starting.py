"""Which calls get a handler, and when: at most ``concurrency`` at a time."""

from __future__ import annotations

import asyncio
from typing import Generic

from rosasync._server.handlers import HandlerRunner
from rosasync._server.intake import Intake
from rosasync._server.service_call import ServiceCall
from rosasync.typing import RequestT, ResponseT

__all__ = ["HandlerStarter"]


class HandlerStarter(Generic[RequestT, ResponseT]):
    """Starts the handler for calls. Confined to the loop's thread.

    Args:
        runner: runs the handler.
        intake: holds the calls that wait.
        concurrency: the maximum number of handlers; 0 if the calls are iterated over.

    Attributes:
        paused: whether the loop takes requests before the next handler is started.
    """

    def __init__(
        self,
        runner: HandlerRunner[RequestT, ResponseT],
        intake: Intake[RequestT, ResponseT],
        concurrency: int,
    ) -> None:
        self.paused = False
        self._loop = asyncio.get_running_loop()
        self._runner = runner
        self._intake = intake
        self._concurrency = concurrency
        # Whether `start_waiting` is active, so that it is not entered again.
        self._starting = False
        runner.on_finished = self.start_waiting

    def start_now(self, call: ServiceCall[RequestT, ResponseT]) -> bool:
        """Start the handler for a call that has just arrived, or return False if it has to wait."""
        if self._intake or self.paused or self._runner.running >= self._concurrency:
            return False
        self._intake.last_age = 0.0
        self._start(call)
        return True

    def start_waiting(self) -> None:
        """Start the handler for the calls that wait, for as many as may run."""
        # An eager task (Python 3.12) may finish its handler inside `start`, which calls this again.
        # With a long backlog that would exceed the recursion limit, so the outer call goes on.
        if self._starting:
            return
        self._starting = True
        try:
            while self._intake and not self.paused and self._runner.running < self._concurrency:
                self._start(self._intake.pop())
        finally:
            self._starting = False

    def _start(self, call: ServiceCall[RequestT, ResponseT]) -> None:
        self._runner.start(call)
        if self._runner.was_long:
            # The requests that have arrived meanwhile are still in the queue of the middleware. If
            # the next handler were run now, they would be served in their order, however old they
            # are. So first the loop takes them, and then the backlog decides.
            self.paused = True
            self._loop.call_soon(self._go_on)

    def _go_on(self) -> None:
        self.paused = False
        self.start_waiting()
