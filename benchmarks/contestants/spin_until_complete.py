"""``rclpy.spin_until_future_complete``, as in the ROS 2 tutorials."""

from __future__ import annotations

import time

import rclpy

from benchmarks.contestants.base import Blocking, Tally, make_clients, now
from benchmarks.work import CALL_TIMEOUT, Work, make_request


class SpinUntilComplete(Blocking):
    def setup(self, work: Work) -> None:
        self.services, self._busy = work.services, work.busy
        rclpy.init()
        self._node = rclpy.create_node("bench")
        self._clients = make_clients(self._node, work)
        self._request = make_request(work)

    def call(self, service: int) -> None:
        self._complete(self._clients[service].call_async(self._request), CALL_TIMEOUT)

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        """Send the calls in batches of one for each caller, because only one thread may spin."""
        tally = Tally()
        until = now() + round(seconds * 1e9)
        with tally.timed():
            for first in range(0, calls, callers):
                if now() > until:
                    break
                batch = [
                    (now(), self._clients[i % self.services].call_async(self._request))
                    for i in range(first, min(first + callers, calls))
                ]
                time.sleep(self._busy)
                for begin, future in batch:
                    try:
                        self._complete(future, CALL_TIMEOUT - (now() - begin) / 1e9)
                    except Exception as exc:
                        tally.miss(exc)
                    else:
                        tally.samples.append(now() - begin)
        return tally

    def rest(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self._node, timeout_sec=left)

    def close(self) -> None:
        self._node.destroy_node()
        rclpy.shutdown()

    def _complete(self, future: rclpy.task.Future, seconds: float) -> None:
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=max(seconds, 0.0))
        if not future.done():
            raise TimeoutError("no response")
        future.result()


CONTESTANTS = {"spin-until": SpinUntilComplete}
