"""The callers that wait for a place, and who of them goes next."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._client.patience import Patience

if TYPE_CHECKING:
    from rosasync._client.client import Client
    from rosasync._client.clients import Clients
    from rosasync._client.probes import Probes
    from rosasync._client.window import Window

__all__ = ["TURNS", "Order", "Waiter"]

OVERLOAD = 1.0
"""Minimum number of seconds for which a service counts as overloaded, after a caller was passed
over. Callers whose deadlines pass together come back together, and would fill the window again."""
PERSISTENCE = 4
"""The same as a number of response times, for a slow server."""
TURNS = 8
"""While callers leave, every eighth turn goes to one that has waited longer than those that left.
As with a server, see `Backlog`."""


class Waiter(Protocol):
    """A caller in the queue: a `Call` or a `LeaseWaiter`.

    Attributes:
        future: done when the caller has left.
        deadline: the loop time by which the caller needs its answer; None if that is not known.
        passed: the seconds until the server answers, and the seconds that were left, when the
            caller was passed over.
    """

    future: asyncio.Future[Any]
    deadline: float | None
    passed: tuple[float, float] | None

    @property
    def gone(self) -> bool:
        """Whether nothing may be sent for the caller any more."""

    def start(self, client: Client, now: float) -> None:
        """Go on with this client, which has a free place."""


class Order:
    """The callers that wait for a place of one service, and who of them goes next.

    Args:
        clients: the clients of the service.
        probes: when to find out how quick the server is.

    Attributes:
        queue: the callers that wait for a place, in their order. With each, the loop time since
            which it has waited; infinite if it does not leave without notice.
        passed: the callers that were passed over, in their order, as in the queue: they would be
            answered too late, unless the server becomes quicker.
        patience: how long callers wait that leave without notice.
        overloaded_until: the loop time until which the service counts as overloaded, because a
            caller was passed over. Until then no call is sent without a look at its deadline.
    """

    def __init__(self, clients: Clients, probes: Probes) -> None:
        self.queue: dict[Waiter, float] = {}
        self.passed: dict[Waiter, float] = {}
        self.patience = Patience()
        self.overloaded_until = 0.0
        self._clients = clients
        self._probes = probes
        # The latest deadline of those passed over since there were none.
        self._latest = 0.0
        # Callers that were let go since a patient one was.
        self._turn = 0

    def next(self, window: Window, now: float) -> Waiter | None:
        """Take the first caller who can be answered in time, and pass over those before.

        A call that is passed over is not ended: it costs nothing, and the server may become quick
        again before its deadline.

        While callers leave without notice, each has as much time as nearly all of them have waited.
        One that has waited for longer than all of them is *patient*. Patient callers get every
        eighth turn, and those that no other caller can use.
        """
        short = long = math.inf
        if now < self.patience.until:
            short, long = self.patience.waits(now)
        waiter = self._take_passed(window, short, long, now) if self.passed else None
        if waiter is not None:
            return waiter
        queue = self.queue
        while queue:
            # As few calls as possible, because every caller that waits comes here.
            waiter = next(iter(queue))
            since = queue[waiter]
            del queue[waiter]
            if waiter.gone:
                continue
            deadline = math.inf if waiter.deadline is None else waiter.deadline
            ends = since + short
            ends = deadline if deadline < ends else ends
            if ends == math.inf or window.answers_in(ends - now, now):
                self._turn += 1
                return waiter
            needed = window.expected(now)
            if deadline - now < needed:
                waiter.passed = (needed, deadline - now)
            self.overloaded_until = now + max(OVERLOAD, PERSISTENCE * needed)
            self._latest = max(self._latest, deadline) if self.passed else deadline
            self.passed[waiter] = since
        return self._take_late(window, short, long, now) if self.passed else None

    # Each takes one of those passed over, if one may go. For `short` and `long`, see
    # `Patience.waits`: both are infinite if no callers leave without notice.

    def _take_passed(self, window: Window, short: float, long: float, now: float) -> Waiter | None:
        """Take the first who can be answered in time after all, or a patient one if it is due."""
        if not window.answers_in(self._latest - now, now):
            return None
        needed = window.expected(now)
        if short < math.inf:
            if self._turn >= TURNS - 1:
                waiter = self._take_patient(needed, long, now)
                if waiter is not None:
                    return waiter
            # The last to come would be the first to be in time again.
            if next(reversed(self.passed.values())) + short - now < needed:
                return None
        for waiter in tuple(self.passed):
            if waiter.gone or self._ends_at(waiter, short) - now >= needed:
                del self.passed[waiter]
                if not waiter.gone:
                    self._turn += 1
                    return waiter
        return None

    def _take_patient(self, needed: float, long: float, now: float) -> Waiter | None:
        """Take the first who is patient and whose deadline leaves time enough."""
        for waiter, since in self.passed.items():
            if now - since <= long:
                return None
            if not waiter.gone and _deadline_of(waiter) - now >= needed:
                del self.passed[waiter]
                self._turn = 0
                return waiter
        return None

    def _take_late(self, window: Window, short: float, long: float, now: float) -> Waiter | None:
        """Take one although no caller is sure to be answered in time.

        That is the first who is patient, or the last to come who may still be there. The latter
        only if those that come next can be answered in time, too.
        """
        if short < math.inf and window.answers_in(self._latest - now, now):
            needed = window.expected(now)
            patient = self._take_patient(needed, long, now)
            if patient is not None:
                return patient
            for waiter, since in reversed(self.passed.items()):
                if needed > short or since + long - now < needed:
                    break
                if not waiter.gone and _deadline_of(waiter) - now >= needed:
                    del self.passed[waiter]
                    return waiter
        if not self._clients.nothing_out or not self._probes.may_send(now):
            return None
        # Nothing else is out, so one that has hardly time enough finds out how quick the server is.
        # Nothing of any client, or with many clients of one place each, all of them would find out.
        waiter = max(self.passed, key=lambda waiter: self._ends_at(waiter, short))
        ends = self._ends_at(waiter, short)
        del self.passed[waiter]
        if waiter.gone:
            return None
        self._probes.send(now, ends - now)
        return waiter

    def _ends_at(self, waiter: Waiter, short: float) -> float:
        """Return the time until which one of those passed over waits."""
        return -math.inf if waiter.gone else min(_deadline_of(waiter), self.passed[waiter] + short)


def _deadline_of(waiter: Waiter) -> float:
    """Return the deadline of a caller; infinite if it is not known."""
    return math.inf if waiter.deadline is None else waiter.deadline
