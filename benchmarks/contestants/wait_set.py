"""A bare wait set in the calling thread: the floor for every contestant that sleeps."""

from __future__ import annotations

import time
from typing import Any

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from benchmarks.contestants.base import Tally, make_clients, now
from benchmarks.work import CALL_TIMEOUT, Work, load_type, make_request


class WaitSet:
    patience = CALL_TIMEOUT
    """Seconds after which a call counts as lost."""

    def setup(self, work: Work) -> None:
        rclpy.init()
        self._node = rclpy.create_node("bench")
        self._clients = [client.handle for client in make_clients(self._node, work)]
        self._request = make_request(work)
        self._response_type = load_type(work.srv_type).Response
        self._wait_set = _rclpy.WaitSet(0, 0, 0, work.services, 0, 0, self._node.context.handle)

    def one_at_a_time(self, calls: int, seconds: float) -> Tally:
        return self.at_once(1, calls, seconds)

    def at_once(self, callers: int, calls: int, seconds: float) -> Tally:
        """Keep all calls outstanding from one thread, and send another for each answer."""
        tally = Tally()
        clients = self._clients
        until = now() + round(seconds * 1e9)
        out: dict[tuple[int, int], int] = {}
        sent = 0
        with tally.timed():
            while True:
                while len(out) < callers and sent < calls and (begin := now()) < until:
                    service = sent % len(clients)
                    out[service, clients[service].send_request(self._request)] = begin
                    sent += 1
                if not out:
                    return tally
                self.look(out, tally)

    def look(self, out: dict[tuple[int, int], int], tally: Tally) -> None:
        """Wait, and take the responses."""
        self._wait_set.clear_entities()
        for client in self._clients:
            self._wait_set.add_client(client)
        self._wait_set.wait(round(self.patience * 1e9))
        ready = self._wait_set.get_ready_entities("client")
        if not ready:
            give_up(out, tally, self.patience)
        for service, client in enumerate(self._clients):
            if client.pointer in ready:
                self.take(service, client, out, tally)

    def take(
        self, service: int, client: Any, out: dict[tuple[int, int], int], tally: Tally
    ) -> None:
        while (taken := client.take_response(self._response_type))[0] is not None:
            begin = out.pop((service, taken[0].request_id.sequence_number), None)
            if begin is not None:
                tally.samples.append(now() - begin)

    def rest(self, seconds: float) -> None:
        time.sleep(seconds)

    def close(self) -> None:
        self._wait_set.destroy_when_not_in_use()
        self._node.destroy_node()
        rclpy.shutdown()


def give_up(out: dict[tuple[int, int], int], tally: Tally, patience: float) -> None:
    """Count every call that is outstanding for too long as lost; the first is the oldest."""
    limit = now() - round(patience * 1e9)
    while out and out[oldest := next(iter(out))] < limit:
        del out[oldest]
        tally.lost += 1


CONTESTANTS = {"floor": WaitSet}
