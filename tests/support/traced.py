"""A trace hook that keeps what it is told, and checks that it is consistent."""

from __future__ import annotations

import threading
from contextvars import Context

from rosasync import CallEnd, CallPhase, TracedCall
from tests.support.times import until

__all__ = ["Recorder"]

PHASES = {
    "client": ["waiting", "queued", "sent", "sent again", "accepted", "canceling"],
    "server": ["queued", "handling", "canceling", "failed", "deferred"],
}


class Recorder:
    """Keeps the events of every call.

    Attributes:
        calls: the calls, in the order of their starts.
        phases: the phases of each call, by its number.
        ends: the end of each call that has ended, by its number.
    """

    def __init__(self) -> None:
        self.calls: list[TracedCall] = []
        self.phases: dict[int, list[CallPhase]] = {}
        self.ends: dict[int, CallEnd] = {}
        self._thread = threading.get_ident()

    def start(self, call: TracedCall) -> Context | None:
        self._check_thread()
        assert call.number not in self.phases, "two starts"
        self.calls.append(call)
        self.phases[call.number] = []
        return None

    def phase(self, call: TracedCall, phase: CallPhase) -> None:
        self._check_thread()
        assert call.number not in self.ends, f"{phase} after the end"
        assert phase.name in PHASES[call.side]
        assert phase.time_ns >= self._last_time(call)
        self.phases[call.number].append(phase)

    def end(self, call: TracedCall, end: CallEnd) -> None:
        self._check_thread()
        assert call in self.calls, "an end without a start"
        assert call.number not in self.ends, "two ends"
        assert end.time_ns >= self._last_time(call)
        self.ends[call.number] = end

    def of(self, side: str) -> list[str]:
        """Return the phases and the outcome of each call of one side, joined by spaces."""
        return [
            " > ".join(
                (
                    *(phase.name for phase in self.phases[call.number]),
                    self.ends[call.number].outcome if call.number in self.ends else "...",
                )
            )
            for call in self.calls
            if call.side == side
        ]

    def error(self, side: str) -> BaseException | None:
        """Return the error of the only call of this side."""
        (call,) = (call for call in self.calls if call.side == side)
        return self.ends[call.number].error

    async def all_ended(self, calls: int) -> None:
        """Wait until so many calls have started, and all have ended."""
        await until(lambda: len(self.calls) >= calls and len(self.ends) == len(self.calls))
        assert len(self.calls) == calls

    def _last_time(self, call: TracedCall) -> int:
        phases = self.phases[call.number]
        return phases[-1].time_ns if phases else call.time_ns

    def _check_thread(self) -> None:
        assert threading.get_ident() == self._thread, "on another thread than the loop's"
