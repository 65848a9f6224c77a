"""Floods one service until the runner stops it: ``python -m benchmarks.flood``."""

from __future__ import annotations

import threading
from typing import Any

from benchmarks.contestants.base import Tally
from benchmarks.contestants.wait_set import WaitSet, give_up
from benchmarks.pipes import answer_lines
from benchmarks.work import Work

TURN = 1.0
"""Seconds between checks for the end."""
PATIENCE = 0.1
"""Seconds after which a request counts as lost and the next one is sent."""


class Flooding(WaitSet):
    """Gives a lost request up early, to send the next one."""

    patience = PATIENCE

    def look(self, out: dict[tuple[int, int], int], tally: Tally) -> None:
        super().look(out, tally)
        give_up(out, tally, self.patience)


class Flood:
    """Answers the runner's requests: ``start`` and ``stop``."""

    def __init__(self) -> None:
        self._clients = Flooding()
        self._enough = threading.Event()
        self._thread = threading.Thread(target=lambda: None)

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        answer: dict[str, Any] = getattr(self, "do_" + message.pop("do"))(**message)
        return answer

    def do_start(self, work: dict[str, Any], callers: int) -> dict[str, Any]:
        """Start, and return after the first turn, when the server is busy."""
        self._clients.setup(Work.from_json(work))
        self._enough.clear()
        self._turn(callers)
        self._thread = threading.Thread(target=self._run, args=(callers,))
        self._thread.start()
        return {}

    def do_stop(self) -> dict[str, Any]:
        self._enough.set()
        self._thread.join()
        self._clients.close()
        return {}

    def _run(self, callers: int) -> None:
        while not self._enough.is_set():
            self._turn(callers)

    def _turn(self, callers: int) -> None:
        self._clients.at_once(callers, 1 << 30, TURN)


if __name__ == "__main__":
    answer_lines(Flood().answer)
