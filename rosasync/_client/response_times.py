"""How long a client waits without any answer before it takes a request for lost."""

from __future__ import annotations

__all__ = ["PATIENCE_INITIAL", "PATIENCE_MIN", "ResponseTimes"]

PATIENCE_INITIAL = 1.0
"""Seconds of patience before the first response, as in RFC 6298."""
PATIENCE_MIN = 0.2
"""Minimum number of seconds of patience. A busy machine may stop a server that long."""
MULTIPLE = 4
"""Patience in response times."""
RISE = 1 / 16
"""Weight of a response that was slower than the estimate."""


class ResponseTimes:
    """Estimates the response time of one client's server, and derives the patience from it.

    The patience has the part of TCP's retransmission timeout (RFC 6298), but not its estimate: it
    is a multiple of the lowest response time, which each slower response raises by a sixteenth of
    the difference. DDS repairs a loss only after up to three seconds, so a mean would make a client
    most patient on the networks that lose most. The lowest is enough, because each answer begins
    the wait again: it has to cover the time between two answers of a busy server, and not the time
    that a request spends in the queue. No response is ambiguous (Karn's rule), because each attempt
    of a retried call has a sequence number of its own.

    Attributes:
        patience: seconds without any answer after which a request is more likely lost than queued.
    """

    __slots__ = ("_estimate", "patience")

    def __init__(self) -> None:
        self.patience = PATIENCE_INITIAL
        self._estimate = PATIENCE_INITIAL / MULTIPLE

    def add(self, seconds: float) -> None:
        """Take a response time into account."""
        slower = seconds - self._estimate
        self._estimate += slower * RISE if slower > 0 else slower
        self.patience = max(PATIENCE_MIN, MULTIPLE * self._estimate)
