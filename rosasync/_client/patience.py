"""How long callers wait that leave without notice: what those that left say of the next."""

from __future__ import annotations

import math
from collections import deque

__all__ = ["INTERVAL", "LASTING", "NOBODY_LEAVES", "Patience"]

RECENT = 100
"""The number of callers that left from which is estimated how long the next one waits."""
STALE = 10.0
"""Seconds after which a caller that left says nothing any more, beyond the time for which it had
waited."""
FEW = 5
"""Fewer callers than these say nothing."""
SHORT = 0.1
"""The share of those that left that had waited for a shorter time than nearly all of them."""
INTERVAL = 0.1
"""Seconds for which callers must have been leaving. A tree that is halted cancels all its calls at
once, and that says nothing of the calls that follow."""
LASTING = 1.0
"""Minimum number of seconds for which the estimate holds after a caller has left. It holds for as
long as that caller had waited, if that is longer."""

NOBODY_LEAVES = (math.inf, math.inf)
"""The estimate while no callers leave."""


class Patience:
    """Estimates for how long the callers of a service wait that leave without notice.

    Those are the callers that are cancelled before the deadline of their call, or without one: by
    ``asyncio.timeout`` around it, or because what needed the answer has ended.

    Pure: all times are arguments, in seconds of one clock.

    Attributes:
        until: the time until which the callers that left count.
    """

    __slots__ = ("_last", "_left", "_since", "_waits", "until")

    def __init__(self) -> None:
        self.until = -math.inf
        # When each caller left, and for how long it had waited.
        self._left: deque[tuple[float, float]] = deque(maxlen=RECENT)
        # Since when callers have been leaving, and when the last one did.
        self._since = self._last = -math.inf
        # What they say, until the next one leaves.
        self._waits: tuple[float, float] | None = None

    def add(self, waited: float, now: float) -> None:
        """Record that a caller has left, after it had waited for so many seconds."""
        if now >= self.until:
            self._since = now
        self._last = now
        self.until = now + max(LASTING, waited)
        self._left.append((now, waited))
        self._waits = None

    def waits(self, now: float) -> tuple[float, float]:
        """Return for how many seconds nearly all callers wait, at least, and the longest at most.

        Both are infinite if no callers leave.
        """
        if now >= self.until or self._last - self._since < INTERVAL:
            return NOBODY_LEAVES
        if self._waits is None:
            recent = sorted(waited for at, waited in self._left if now - at <= STALE + waited)
            count = len(recent)
            self._waits = NOBODY_LEAVES
            if count >= FEW:
                self._waits = recent[int(SHORT * count)], recent[-1]
        return self._waits
