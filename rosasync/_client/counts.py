"""The counters of one service."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Counts"]


@dataclass(slots=True)
class Counts:
    """The counters of one service, over all its clients.

    Shared by `Call`, `Client`, `Clients`, `RetryBudget` and `ServicePool`, which count what they
    see happen. All of them run on the loop's thread.
    """

    in_flight: int = 0
    sent: int = 0
    peak: int = 0
    created: int = 0
    completed: int = 0
    timed_out: int = 0
    cancelled: int = 0
    failed: int = 0
    late: int = 0
    retried: int = 0
    fast_retries: int = 0
