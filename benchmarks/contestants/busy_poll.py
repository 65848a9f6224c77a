"""``take_response`` in a tight loop, which keeps a core busy: the limit."""

from __future__ import annotations

from benchmarks.contestants.base import Tally
from benchmarks.contestants.wait_set import WaitSet, give_up


class BusyPoll(WaitSet):
    def look(self, out: dict[tuple[int, int], int], tally: Tally) -> None:
        before = len(out)
        for service in {service for service, _ in out}:
            self.take(service, self._clients[service], out, tally)
        if len(out) == before:
            give_up(out, tally, self.patience)


CONTESTANTS = {"busy": BusyPoll}
