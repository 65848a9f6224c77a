"""The attempts of a retried call, and the budget that bounds them."""

from __future__ import annotations

import asyncio
import math
import random
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosasync._client.call import Call
    from rosasync._client.client import Client, Counts
    from rosasync.options import Retry

__all__ = ["Attempts", "RetryBudget"]

FAST = 3
"""Answers to later requests of the client, after which a request is sent again at once."""
JITTER = 0.25
"""The largest fraction of a delay that is added to it at random."""
PER_SECOND = 10.0
"""Requests of a service that may be sent again in a second, whatever the share."""
SAVED = 100.0
"""The maximum number of requests for which an unused budget is saved."""


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


class Attempts:
    """Sends the request of one call again while it is unanswered.

    The newest attempt takes the place of the call in the client's window. An earlier one takes a
    place like an abandoned request, until it is known or presumed to have left the server's queue.
    Confined to the loop's thread.

    Attributes:
        call: the call, from `begin` to `end`.
        over_budget: whether the budget was used up when the request was to be sent again.
    """

    __slots__ = (
        "_budget",
        "_client",
        "_delay",
        "_later_answers",
        "_retry",
        "_sent",
        "_timer",
        "call",
        "over_budget",
    )

    call: Call
    _client: Client

    def __init__(self, retry: Retry, budget: RetryBudget) -> None:
        self._retry = retry
        self._budget = budget
        self._delay = retry.after
        # The attempts that the present servers may have, by sequence number, in order.
        self._sent: list[int] = []
        # The number of requests sent after the newest attempt and answered.
        self._later_answers = 0
        # Each attempt except the last starts it, for the next one.
        self._timer: asyncio.TimerHandle | None = None
        self.over_budget = False

    @property
    def sent(self) -> int:
        """How many attempts were sent to the present servers; 0 if all have vanished."""
        return len(self._sent)

    @property
    def needs_room(self) -> bool:
        """Whether the newest attempt may still be in the server's queue."""
        return bool(self._sent) and self._client.answered < self._sent[-1]

    def begin(self, call: Call, client: Client, sequence_number: int) -> None:
        """Start the timer for the second attempt.

        Args:
            call: the call, whose request was just sent.
            client: the client that has sent it, and sends it again.
            sequence_number: the number of the first attempt.
        """
        self.call = call
        self._client = client
        self._sent.append(sequence_number)
        client.add_retried(self)
        self._start_timer()

    def send_again(self, cause: str = "") -> None:
        """Send the request again, if the budget allows it.

        If the newest attempt may still be in the server's queue, it keeps a place as long as there
        is room.

        Args:
            cause: "fast" if later requests were answered.
        """
        self._client.cancel_resend(self)
        if self.call.future.done():
            return
        # A new server has not been asked yet, so this cannot bury it.
        if self._sent and not self._budget.take(self._retry.budget):
            self.over_budget = True
            self._later_answers = 0
            self._wait(max(self._delay, 1 / PER_SECOND))
            return
        if self.needs_room and self._client.capacity > 0:
            self._client.abandon(self._sent[-1], self.call.servers)
        try:
            sequence_number = self._client.send(self.call.request)
        except Exception as error:
            self.call.future.set_exception(error)
            return
        self._sent.append(sequence_number)
        self._later_answers = 0
        self.call.sent_again(sequence_number)
        self._client.counts.retried += 1
        self._client.counts.fast_retries += cause == "fast"
        self._start_timer()

    def note_answer(self, sequence_number: int) -> None:
        """Send the request again at once if this is the third answer to a later request."""
        if not self._sent or sequence_number <= self._sent[-1]:
            return
        self._later_answers += 1
        if self._later_answers == FAST and self.sent < self._retry.attempts:
            self.send_again("fast")

    def lose_servers(self, error: Callable[[], Exception]) -> None:
        """Send the request to the next server, or set the error if it may be sent only once."""
        if self.call.future.done():
            return
        if self._retry.attempts == 1:
            self.call.future.set_exception(error())
            return
        self._stop_timer()
        self._sent.clear()
        self._delay = self._retry.after
        self._client.queue_resend(self)

    def explain_timeout(self) -> str:
        """Describe the attempts, as a clause for the message of an error."""
        if not self._sent:
            return "; its servers have vanished, and no other has come"
        clause = f"; sent {self.sent} times" if self.sent > 1 else ""
        if self.over_budget:
            clause += "; not sent again, because Retry.budget is used up for this service"
        return clause

    def end(self) -> None:
        """Abandon the attempts that are still outstanding."""
        self._stop_timer()
        client = self._client
        client.remove_retried(self)
        for sequence_number in self._sent:
            if client.unanswered.pop(sequence_number, None) is None:
                continue
            if sequence_number == self._sent[-1] or client.has_place(sequence_number):
                client.abandon(sequence_number, self.call.servers)
            else:
                client.expect_late(sequence_number)
        del self.call  # Break the reference cycle.

    def _start_timer(self) -> None:
        if self.sent < self._retry.attempts:
            self._wait(self._delay)
            self._delay *= self._retry.backoff

    def _wait(self, delay: float) -> None:
        self._stop_timer()
        # So that the requests of many callers, lost together, are not sent again together.
        delay *= 1 + random.random() * JITTER
        self._timer = self.call.future.get_loop().call_later(delay, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        if not self.call.future.done():
            self._client.queue_resend(self)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
