"""When the request of a call is sent again, and the budget that bounds it for one service."""

from __future__ import annotations

import enum
import math
import random
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rosasync._client.counts import Counts
    from rosasync.options import Retry

__all__ = ["Action", "Plan", "RetryBudget"]

FAST = 3
"""Answers to later requests of the client, after which a request is sent again at once."""
JITTER = 0.25
"""The largest fraction of a delay that is added to it at random."""
PER_SECOND = 10.0
"""Requests of a service that may be sent again in a second, whatever the share."""
SAVED = 100.0
"""The maximum number of requests for which an unused budget is saved."""


class Action(enum.Enum):
    """What a call does after an event.

    Attributes:
        SEND: it is sent again, as soon as there are a server and a place.
        WAIT: it goes on waiting.
        FAIL: it ends with an error.
    """

    SEND = enum.auto()
    WAIT = enum.auto()
    FAIL = enum.auto()


class RetryBudget:
    """Bounds how many requests of one service are sent again: a token bucket.

    It starts with the tokens of one second. Confined to the loop's thread.

    Args:
        counts: counts the calls that were sent.
        clock: returns the time in seconds.
    """

    def __init__(self, counts: Counts, clock: Callable[[], float]) -> None:
        self._counts = counts
        self._clock = clock
        self._tokens = PER_SECOND
        # The time, and the number of calls, up to which tokens were added.
        self._time = clock()
        self._calls = counts.sent

    def take(self, share: float) -> bool:
        """Take a token, and return whether there was one.

        Args:
            share: the tokens to add for each call that was sent since.
        """
        if share == math.inf:
            return True
        now, calls = self._clock(), self._counts.sent
        earned = (now - self._time) * PER_SECOND + (calls - self._calls) * share
        self._time, self._calls = now, calls
        self._tokens = min(SAVED, self._tokens + earned)
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True


class Plan:
    """Decides when the request of one call is sent again. It has no loop, timer or port.

    The call reports what happens, and does what the plan answers. Its servers get the request at
    most `Retry.attempts` times, because every send asks `begin` first.

    Attributes:
        sent: how many attempts were sent to the present servers; 0 if all have vanished.
        over_budget: whether the budget was used up when the request was to be sent again.
        overloaded: whether the service was overloaded then.
    """

    __slots__ = (
        "_budget",
        "_delay",
        "_dice",
        "_later_answers",
        "_retry",
        "over_budget",
        "overloaded",
        "sent",
    )

    def __init__(
        self, retry: Retry, budget: RetryBudget, dice: Callable[[], float] | None = None
    ) -> None:
        self._retry = retry
        self._budget = budget
        # Looked up here, so that a test can replace it.
        self._dice = dice or random.random
        self._delay = retry.after
        # The number of requests sent after the newest attempt and answered.
        self._later_answers = 0
        self.sent = 0
        self.over_budget = False
        self.overloaded = False

    @property
    def verify(self) -> Callable[[], Awaitable[Any]] | None:
        """Finds out, before the request is sent again, whether it has run."""
        return self._retry.verify

    def begin(self, overloaded: bool = False) -> Action:
        """Return SEND if an attempt may be sent now, and WAIT if not.

        Args:
            overloaded: whether the service has callers that it cannot answer in time. Sending
                again would add to that.
        """
        if self.sent >= self._retry.attempts:
            return Action.WAIT
        if self.sent and overloaded:
            self.overloaded = True
            self._later_answers = 0
            return Action.WAIT
        # Servers that have not been asked yet cannot be buried.
        if self.sent and not self._budget.take(self._retry.budget):
            self.over_budget = True
            self._later_answers = 0
            return Action.WAIT
        self.sent += 1
        self._later_answers = 0
        return Action.SEND

    def next_delay(self) -> float | None:
        """Return the seconds until the next attempt is due, after one was sent.

        None if there is none.
        """
        if self.sent >= self._retry.attempts:
            return None
        delay = self._delay
        self._delay *= self._retry.backoff
        return self._spread(delay)

    def refused_delay(self) -> float | None:
        """Return the seconds until the next attempt is due, after `begin` has refused one.

        None if there is none.
        """
        if self.sent >= self._retry.attempts:
            return None
        return self._spread(max(self._delay, 1 / PER_SECOND))

    def on_due(self) -> Action:
        """Decide as the delay has passed."""
        return Action.SEND if self.sent < self._retry.attempts else Action.WAIT

    def on_later_answer(self) -> Action:
        """Decide as a request was answered that was sent after the newest attempt."""
        self._later_answers += 1
        if self._later_answers == FAST and self.sent < self._retry.attempts:
            return Action.SEND
        return Action.WAIT

    def on_servers_lost(self) -> Action:
        """Decide as no server is left that has had an attempt.

        The attempts start anew with the next server.
        """
        if self._retry.attempts == 1:
            return Action.FAIL
        self.sent = 0
        self._later_answers = 0
        self._delay = self._retry.after
        return Action.SEND

    def explain_timeout(self) -> str:
        """Describe the attempts, as a clause for the message of an error."""
        if not self.sent:
            return "; its servers have vanished, and no other has come"
        clause = f"; sent {self.sent} times" if self.sent > 1 else ""
        if self.over_budget:
            clause += "; not sent again, because Retry.budget is used up for this service"
        if self.overloaded:
            clause += "; not sent again, because the server is slower than its callers"
        return clause

    def _spread(self, delay: float) -> float:
        # So that the requests of many callers, lost together, are not sent again together.
        return delay * (1 + self._dice() * JITTER)
