"""What has happened to the calls of a server, in numbers."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CallCounts"]


@dataclass(slots=True)
class CallCounts:
    """What has happened to the calls of a server.

    The first five are changed on the loop's thread, the others under the sender's lock.
    """

    taken: int = 0
    rejected: int = 0
    abandoned: int = 0
    deferred: int = 0
    failed: int = 0
    responded: int = 0
    undeliverable: int = 0
    dropped: int = 0
    failed_unanswered: int = 0

    @property
    def unanswered(self) -> int:
        """How many calls are neither answered nor given up."""
        settled = self.responded + self.undeliverable + self.dropped + self.failed_unanswered
        return self.taken - settled
