"""Latencies: a histogram of the durations of a service's calls, and its percentiles."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable
from itertools import accumulate
from operator import add

from rosasync.statistics import LatencyStatistics

__all__ = ["LatencyHistogram", "summarize"]

BITS = 5
"""Bits of a duration that tell its bucket, after the highest bit. So a bucket is at most 1/32 as
wide as its lowest duration, and its middle at most 1/64 (1.6 %) off."""
BUCKETS = 1 << BITS


def _buckets() -> array[int]:
    return array("Q", bytes(8 * BUCKETS))


class LatencyHistogram:
    """Counts durations in buckets whose width grows with the duration, like an HDR histogram.

    `response_times.ResponseTimes` cannot carry this: it follows the lowest response times, and only
    a sample of them. Memory is only taken for each new power of two of a duration: 0.3 kB, usually
    ten times.

    Attributes:
        octaves: for each number of bits of a duration, the counters of its buckets.
        longest: the longest duration, in ns.
    """

    __slots__ = ("longest", "octaves")

    def __init__(self) -> None:
        self.octaves: defaultdict[int, array[int]] = defaultdict(_buckets)
        self.longest = 0

    def add(self, nanoseconds: int) -> None:
        """Count a duration."""
        bits = nanoseconds.bit_length()
        dropped = bits - BITS - 1
        kept = nanoseconds >> dropped if dropped > 0 else nanoseconds
        # Without the highest bit, which is the same in the whole octave.
        self.octaves[bits][kept & BUCKETS - 1] += 1
        if nanoseconds > self.longest:
            self.longest = nanoseconds

    def include(self, other: LatencyHistogram) -> None:
        """Count the durations of another histogram as well."""
        # A copy, because the loop may count another response meanwhile.
        for bits, counts in other.octaves.copy().items():
            self.octaves[bits] = array("Q", map(add, self.octaves[bits], counts))
        self.longest = max(self.longest, other.longest)


def summarize(histograms: Iterable[LatencyHistogram]) -> LatencyStatistics:
    """Return the percentiles of all durations in several histograms."""
    total = LatencyHistogram()
    for histogram in histograms:
        total.include(histogram)
    if not total.octaves:
        return LatencyStatistics()
    octaves = sorted(total.octaves.items())
    up_to = list(accumulate(count for _, counts in octaves for count in counts))
    # The rank of a percentile is rounded up.
    ranks = (-(-up_to[-1] * percent // 100) for percent in (50, 90, 99))
    places = (divmod(bisect_left(up_to, rank), BUCKETS) for rank in ranks)
    p50, p90, p99 = (
        min(_middle(octaves[octave][0], bucket), total.longest) / 1e9 for octave, bucket in places
    )
    return LatencyStatistics(count=up_to[-1], p50=p50, p90=p90, p99=p99, max=total.longest / 1e9)


def _middle(bits: int, bucket: int) -> float:
    """Return the middle of a bucket of the durations with so many bits, in ns."""
    if bits <= BITS:
        return bucket
    dropped = bits - BITS - 1
    return ((BUCKETS + bucket) << dropped) + ((1 << dropped) - 1) / 2
