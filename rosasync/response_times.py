"""How long a client waits without any answer before it takes a request for lost."""

from __future__ import annotations

__all__ = ["PATIENCE_INITIAL", "PATIENCE_MIN", "ResponseTimes"]

PATIENCE_INITIAL = 1.0
"""Seconds of patience before the first response, as in RFC 6298."""
PATIENCE_MIN = 0.2
"""Minimum number of seconds of patience. A busy machine may stop a server that long."""
MULTIPLE = 4
"""Patience in response times."""
FALL = 1 / 2
"""Weight of a response that was faster than the estimate."""
RISE = 1 / 16
"""Weight of a response that was slower than the estimate."""


class ResponseTimes:
    """Estimates the response time of one client's server, and derives the patience from it.

    This is the retransmission timer of TCP (RFC 6298) with two differences. A slow response weighs
    less than a fast one: DDS repairs a loss only after up to three seconds, so a mean would make a
    client most patient on the networks that lose most. And no response is ambiguous (Karn's rule),
    because each attempt of a retried call has a sequence number of its own.

    Attributes:
        patience: seconds without any answer after which a request is more likely lost than queued.
    """

    __slots__ = ("_estimate", "patience")

    def __init__(self) -> None:
        self._estimate: float | None = None
        self.patience = PATIENCE_INITIAL

    def add(self, seconds: float) -> None:
        """Take a response time into account."""
        if self._estimate is None:
            self._estimate = seconds
        else:
            weight = RISE if seconds > self._estimate else FALL
            self._estimate += weight * (seconds - self._estimate)
        self.patience = max(PATIENCE_MIN, MULTIPLE * self._estimate)
