"""The requests for results: their pace, and one that is sent again."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from typing import Any

from test_msgs.action import Fibonacci

from rosasync._actions.results import BURST, PERIOD, ResultRequests
from rosasync.testing import VirtualClock
from rosasync.testing._memory.graph import MemoryNode
from tests.support.fake_graph import FakeGraph

GET = Fibonacci.Impl.GetResultService


class Requests:
    """Requests to a server in memory that holds them all."""

    def __init__(self) -> None:
        self.graph = FakeGraph()
        self.node = MemoryNode(self.graph)
        self.server = self.graph.serve(GET, "/get_result", lambda request: GET.Response())
        self.results: list[bytes] = []
        service = self.node.describe(GET, "/get_result", None)
        self.requests = ResultRequests(
            self.node,
            service,
            GET.Request,
            lambda key, response: self.results.append(key),
        )
        self.requests.open()

    @property
    def sent(self) -> int:
        return len(self.node.clients[0].sent)


def keys(count: int) -> list[bytes]:
    return [bytes([number] * 16) for number in range(count)]


async def test_a_burst_is_paced() -> None:
    clock, held = VirtualClock(), Requests()
    client = held.node.clients[0]
    send, times = client.send, list[float]()

    def note_time(request: Any) -> int:
        times.append(clock.time())
        return send(request)

    client.send = note_time  # type: ignore[method-assign]
    with held.graph.hold_requests():
        for key in keys(4 * BURST):
            held.requests.ask(key)
        assert held.sent == BURST
        await clock.advance(8 * PERIOD)
        assert held.sent == 4 * BURST
    # The clock goes on by itself: on a loaded machine the bursts are further apart.
    assert all(after - before > 0.9 * PERIOD for before, after in pairwise(times[::BURST]))
    held.requests.close()


async def test_each_acceptance_makes_room_for_one_more() -> None:
    clock, held = VirtualClock(), Requests()
    with held.graph.hold_requests():
        for key in keys(3 * BURST):
            held.requests.ask(key, room=True)
        assert held.sent == 3 * BURST
        held.requests.ask(b"another", room=False)
        await clock.advance(PERIOD)
        assert held.sent == 3 * BURST + 1
    held.requests.close()


async def test_a_goal_is_asked_for_twice_and_forgotten() -> None:
    held = Requests()
    (key,) = keys(1)
    with held.graph.hold_requests():
        held.requests.ask(key)
        held.requests.ask(key, room=True)
        assert held.sent == 2
        held.requests.forget(key)
        held.requests.forget(key)
        assert not held.node.clients[0].out
    await asyncio.sleep(0.01)
    assert held.results == []
    held.requests.close()
    held.requests.close()


async def test_requests_wait_for_a_server() -> None:
    clock, held = VirtualClock(), Requests()
    held.server.close()
    for key in keys(2):
        held.requests.ask(key)
    await clock.advance(1.0)
    assert held.sent == 0
    server = held.graph.serve(GET, "/get_result", lambda request: GET.Response())
    await clock.advance(1.0)
    assert (held.sent, held.results) == (2, keys(2))
    server.close()
    held.requests.close()


async def test_a_client_that_was_destroyed_is_replaced() -> None:
    from rosasync._core.ports import PortDestroyed

    held = Requests()
    with held.graph.hold_requests():
        held.requests.ask(keys(1)[0])
        destroyed = held.node.clients[0]

        def fail(*arguments: Any) -> Any:
            raise PortDestroyed

        destroyed.ready = fail  # type: ignore[method-assign]
        assert not held.requests.ready()
        await VirtualClock().advance(1.0)
        assert held.node.clients[-1] is not destroyed
        assert len(held.node.clients[-1].sent) == 1
    held.requests.close()
