"""The driver of a slow device, as vendors ship them: it blocks, or reports from its own thread."""

import queue
import threading
import time
from collections.abc import Callable

Done = Callable[[str | None], object]
"""Called with what went wrong, or with None."""


class Gripper:
    """A gripper on a serial line: one motion at a time, each takes half a second."""

    def __init__(self, seconds: float = 0.5) -> None:
        self._seconds = seconds
        self._orders: queue.SimpleQueue[tuple[bool, Done] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="gripper")
        self._thread.start()

    def move(self, closed: bool, done: Done) -> None:
        """Order a motion, and return at once; ``done`` is called in the driver's thread."""
        self._orders.put((closed, done))

    def disconnect(self) -> None:
        """Finish the motions that were ordered; blocks."""
        self._orders.put(None)
        self._thread.join()

    def _run(self) -> None:
        closed: bool | None = None
        while (order := self._orders.get()) is not None:
            target, done = order
            time.sleep(self._seconds)
            done("it is already there" if target is closed else None)
            closed = target
