"""Any order of events on one service of the graph in memory, in virtual time.

A loop whose clock only moves when nothing else is left to do, and a server that answers only when
it is told: so hypothesis decides the order of everything, and can shorten a failure.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from rosasync import Limits, Retry, RosasyncError
from rosasync._client.client import Client
from rosasync._client.service import ServicePool
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.overload import VirtualLoop
from tests.support.places import check_places
from tests.support.plain import Echo, echo

MOST = 100.0
"""Virtual seconds after which nothing can be left: more than all deadlines and grace periods."""
ATTEMPTS = 3
"""How often a server may get the request of a call that is sent again."""


class ManualServer(FakeServer):
    """Keeps its requests, and answers one when it is told."""

    def __init__(self, graph: FakeGraph, on_request: Callable[[int], None]) -> None:
        super().__init__(graph, Echo, "/echo", echo)
        self._on_request = on_request
        self.requests: Counter[int] = Counter()

    def receive(self, client: Any, number: int, request: Any) -> None:
        self._on_request(request.value)
        self.requests[request.value] += 1
        self.received.append((client, number, request))

    def answer(self, place: int) -> None:
        client, number, request = self.received.pop(place % len(self.received))
        self.graph.carry_response(client, number, echo(request))


SECONDS = st.sampled_from([None, 0.0, 0.5, 2.0, 10.0])


class Races(RuleBasedStateMachine):
    """One session, one service, and what must hold whatever happens to it."""

    limits = Limits()

    def __init__(self) -> None:
        super().__init__()
        self.loop = VirtualLoop()
        self.reported: list[dict[str, Any]] = []
        self.loop.set_exception_handler(lambda _, context: self.reported.append(context))
        self.graph = FakeGraph()
        self.servers: list[ManualServer] = []
        # Those that have left as well.
        self.all_servers: list[ManualServer] = []
        self.once: set[int] = set()
        self.tasks: dict[int, asyncio.Task[Any]] = {}
        self.in_line: set[int] = set()
        self.sent: dict[int, None] = {}
        self.leases = 0
        self.made = 0
        self.session = self.graph.session(limits=self.limits, timeout=None)
        self._run(self.session.__aenter__())
        pool = self.session.pool
        self.service: ServicePool = self._run(self._do(pool.service, Echo, "/echo", None))
        self.come()

    async def _do(self, function: Callable[..., Any], *args: Any) -> Any:
        return function(*args)

    def _run(self, work: Any) -> Any:
        return self.loop.run_until_complete(work)

    async def _turns(self, count: int) -> None:
        for _ in range(count):
            await asyncio.sleep(0)

    @rule(timeout=SECONDS, wait=st.booleans(), retry=st.booleans(), lease=st.booleans())
    def call(self, timeout: float | None, wait: bool, retry: bool, lease: bool) -> None:
        number, self.made = self.made, self.made + 1
        again = Retry(ATTEMPTS, 1.0, 1.0) if retry else None
        self.leases += lease
        if not retry:
            self.once.add(number)
        if lease:
            work = self._leased(number, timeout, again)
        else:
            request = Echo.Request(number)
            work = self.session.call(
                Echo, "/echo", request, timeout=timeout, wait=wait, retry=again
            )
        self.tasks[number] = self.loop.create_task(work)
        # Calls with a deadline are passed over if they would be answered too late.
        if wait and not lease and timeout is None:
            self.in_line.add(number)
        self._run(self._turns(0))

    def _sent(self, number: int) -> None:
        self.sent.setdefault(number)

    async def _leased(self, number: int, timeout: float | None, retry: Retry | None) -> Any:
        async with self.session.pool.lease(Echo, "/echo", timeout=timeout) as client:
            return await client.call(Echo.Request(number), timeout=timeout, retry=retry)

    @precondition(lambda self: any(server.received for server in self.servers))
    @rule(which=st.integers(0, 100), place=st.integers(0, 100))
    def respond(self, which: int, place: int) -> None:
        servers = [server for server in self.servers if server.received]
        self._run(self._do(servers[which % len(servers)].answer, place))

    @precondition(lambda self: self.tasks)
    @rule(which=st.integers(0, 100))
    def cancel(self, which: int) -> None:
        list(self.tasks.values())[which % len(self.tasks)].cancel()

    @rule(count=st.integers(1, 5))
    def turn(self, count: int) -> None:
        self._run(self._turns(count))

    @rule(seconds=st.sampled_from([0.1, 0.6, 2.5, 11.0]))
    def pass_time(self, seconds: float) -> None:
        self._run(asyncio.sleep(seconds))

    @rule()
    def change_elsewhere(self) -> None:
        """Change the graph, but none of these servers."""
        self._run(self._do(self.graph.changed))

    @precondition(lambda self: len(self.servers) < 3)
    @rule()
    def come(self) -> None:
        server = ManualServer(self.graph, self._sent)
        self.servers.append(server)
        self.all_servers.append(server)
        self.graph.servers.append(server)
        self._run(self._do(self.graph.changed))

    @precondition(lambda self: self.servers)
    @rule(which=st.integers(0, 2))
    def leave(self, which: int) -> None:
        server = self.servers.pop(which % len(self.servers))
        self.graph.servers.remove(server)
        self._run(self._do(self.graph.changed))

    @rule()
    def close(self) -> None:
        self._run(self.session.aclose())
        self._run(self._turns(3))
        assert all(task.done() for task in self.tasks.values())

    @invariant()
    def places_are_neither_lost_nor_doubled(self) -> None:
        check_places(self.service, self.limits, self.leases)
        statistics = self.service.statistics()
        assert statistics.in_flight >= 0
        assert statistics.abandoned >= 0

    @invariant()
    def no_server_gets_a_request_too_often(self) -> None:
        for server in self.all_servers:
            for number, times in server.requests.items():
                assert times <= (1 if number in self.once else ATTEMPTS)

    @invariant()
    def first_come_first_served(self) -> None:
        in_order = [number for number in self.sent if number in self.in_line]
        assert in_order == sorted(in_order)

    @invariant()
    def nothing_is_reported(self) -> None:
        """Completing a future twice would be an InvalidStateError, here or in a callback."""
        assert [context.get("exception", context) for context in self.reported] == []

    @invariant()
    def every_answer_is_its_own(self) -> None:
        for number, task in self.tasks.items():
            if task.done() and not task.cancelled():
                error = task.exception()
                assert error is None or isinstance(error, RosasyncError), error
                assert error is not None or task.result().value == number

    def teardown(self) -> None:
        if not self.session.closed:
            for task in self.tasks.values():
                task.cancel()
            self._run(asyncio.sleep(MOST))
            statistics = self.service.statistics()
            assert (statistics.in_flight, statistics.waiting, statistics.abandoned) == (0, 0, 0)
            assert all(client.window.taken == 0 for client in self.service.clients)
            ended = statistics.completed + statistics.timed_out
            ended += statistics.cancelled + statistics.failed
            # The wait for a lease is not counted.
            assert ended <= self.made if self.leases else ended == self.made
        self._run(self.session.aclose())
        self._run(self._turns(3))
        assert all(task.done() for task in self.tasks.values())
        self.nothing_is_reported()
        self.every_answer_is_its_own()
        self.loop.close()


class ExclusiveRaces(Races):
    """The same with clients that carry one request at a time."""

    limits = Limits(clients=3, in_flight=1, waiting=5, grace=1.0, idle=2.0)


class NarrowRaces(Races):
    """The same with a single place and no grace period."""

    limits = Limits(clients=1, in_flight=1, grace=0.0)


def _settings(examples: int) -> settings:
    return settings(
        max_examples=examples,
        stateful_step_count=60,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )


@pytest.mark.parametrize("machine", [Races, ExclusiveRaces, NarrowRaces])
def test_in_any_order(machine: type[Races], full: bool) -> None:
    run_machine(
        machine,
        settings=settings(_settings(1_000 if full else 40), derandomize=not full),
    )


def test_the_model_finds_a_successor_that_is_asked_again_with_each_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As it once was: the request kept the servers of its first attempt when it was sent again."""
    send = Client.send
    first: dict[Any, Any] = {}

    def send_with_stale_servers(client: Client, call: Any, now: float) -> Any:
        sent = send(client, call, now)
        sent.servers = first.setdefault(call, sent.servers)
        return sent

    monkeypatch.setattr(Client, "send", send_with_stale_servers)
    with pytest.raises(AssertionError) as failed:
        run_machine(Races, settings=settings(_settings(1_000), phases=[Phase.generate]))
    assert failed.traceback[-1].name == "no_server_gets_a_request_too_often"
