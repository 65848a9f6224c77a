"""How soon a server answers at its present pace: what its recent response times say of the next."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

__all__ = ["RECENT", "STALE", "Measured", "Pace"]

RECENT = 100
"""The number of response times from which the next one is estimated. Those of a full window
overlap, so a hundred of them hold about ten that are independent of each other."""
FEW = 3
"""Fewer response times than these say nothing."""
STALE = 10.0
"""Seconds after which a response time says nothing any more, beyond its own length."""
DEVIATIONS = 2.0
"""So many standard deviations above the mean, one response time in forty is longer."""

Measured = tuple[float, float, int, float]
"""A response time: when it was measured, how long it was, how many places were taken when its
request was sent, and for how long the server worked on it: from its send or the answer before,
whichever is later, to its answer."""


@dataclass(frozen=True, slots=True)
class Pace:
    """Estimates the next response time.

    If the server works on one request after another, it works on each that is out for the mean of
    the recent times. Its answers deviate from that: what counts is by how much, for each request
    that was out. The deviations of several requests add up as their squares, and the mean is not
    known exactly either. That gives the interval in which the next response time lies. A quantile
    of the response times would be too low: those of a full window share the same work, so a few of
    them say little of what is rare.

    If it works on several at once, that is too much. So it is not more than the longest recent
    response time, reduced to the places that are taken.

    Attributes:
        count: the number of response times.
        mean: the mean work on a request, in seconds.
        variance: the variance that each request adds, in square seconds.
        longest: the longest response time for each number of places that were taken.
        until: the time at which the first of the response times is stale.
    """

    count: int
    mean: float
    variance: float
    longest: dict[int, float]
    until: float

    @classmethod
    def of(cls, measured: Iterable[Measured], now: float) -> Pace:
        """Return what those of the response times say that are not stale."""
        recent = [one for one in measured if now - one[0] <= STALE + one[1]]
        count = len(recent)
        if count < FEW:
            return cls(count, 0.0, 0.0, {}, math.inf)
        mean = sum(work for _, _, _, work in recent) / count
        squares = 0.0
        longest: dict[int, float] = {}
        until = math.inf
        for at, seconds, then, _ in recent:
            squares += (seconds - then * mean) ** 2 / then
            longest[then] = max(seconds, longest.get(then, 0.0))
            until = min(until, at + STALE + seconds)
        return cls(count, mean, squares / count, longest, until)

    def expected(self, out: int) -> float:
        """Return the seconds to the answer, at most, with this many places taken; 0 if unknown."""
        if self.count < FEW:
            return 0.0
        mean = self.mean * out
        deviation = math.sqrt(self.variance * out * (1 + out / self.count))
        longest = max(seconds * min(1.0, out / then) for then, seconds in self.longest.items())
        # And one more, for what the server may get from others in the meantime.
        return min(mean + DEVIATIONS * deviation, max(longest, mean)) + self.mean
