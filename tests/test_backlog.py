"""The backlog of a server as a pure data structure: tables, and random runs against a model."""

from __future__ import annotations

import heapq
import itertools
import random
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosasync._server.backlog import INTERVAL, TARGET, Backlog
from rosasync._server.turns import GUARANTEE

NO_LIMIT = 10**9
STANDING = TARGET + INTERVAL
"""The age from which the oldest request makes a backlog stand."""


def filled(names: str, *, limit: int = 1000, by_arrival: bool = False) -> Backlog[str]:
    """A backlog with requests such as ``a1``, of client ``a``, which arrived at time 0."""
    backlog = Backlog[str](limit, NO_LIMIT, by_arrival=by_arrival)
    for name in names.split():
        backlog.put(name, name[0], 1, 0.0)
    return backlog


def drain(backlog: Backlog[str], now: float) -> str:
    """Pop everything at one time."""
    return " ".join(backlog.pop(now) for _ in range(len(backlog)))


@pytest.mark.parametrize(
    ("waiting", "age", "by_arrival", "served"),
    [
        ("", STANDING, False, ""),
        ("a1 a2 b1 a3", 0.0, False, "a1 a2 b1 a3"),
        # Older than the target, but not for an interval.
        ("a1 a2 b1 a3", STANDING - 0.001, False, "a1 a2 b1 a3"),
        ("a1 a2 a3 a4", STANDING, False, "a4 a3 a2 a1"),
        # The newest of each first, and each client once in a round.
        ("a1 a2 b1 a3", STANDING, False, "a3 b1 a2 a1"),
        ("a1 b1 b2 c1 c2 c3", STANDING, False, "c3 b2 a1 c2 b1 c1"),
        ("c1 c2 c3 b1 b2 a1", STANDING, False, "a1 b2 c3 b1 c2 c1"),
        ("a1 a2 b1 a3", 100 * STANDING, True, "a1 a2 b1 a3"),
    ],
)
def test_who_is_served(waiting: str, age: float, by_arrival: bool, served: str) -> None:
    backlog = filled(waiting, by_arrival=by_arrival)
    assert drain(backlog, age) == served
    assert not backlog.standing
    assert backlog.oldest_age(age) == 0.0


@pytest.mark.parametrize(
    ("waiting", "limit", "dropped", "left"),
    [
        ("a1 a2 a3", 3, "", "a1 a2 a3"),
        ("a1 a2 a3", 2, "a1", "a2 a3"),
        ("a1 a2 a3", 1, "a1 a2", "a3"),
        ("a1 a2", 0, "a1 a2", ""),
        # Of the client that has most, so that it does not push another one's request out.
        ("b1 a1 a2", 2, "a1", "b1 a2"),
        ("b1 a1 a2 a3 a4", 2, "a1 a2 a3", "b1 a4"),
        # The oldest, if several have as many.
        ("b1 a1 c1", 2, "b1", "a1 c1"),
        ("b1 a1 a2 b2 c1", 4, "b1", "a1 a2 b2 c1"),
    ],
)
def test_what_is_dropped(waiting: str, limit: int, dropped: str, left: str) -> None:
    backlog = Backlog[str](limit, NO_LIMIT)
    gone = [other for name in waiting.split() for other in backlog.put(name, name[0], 1, 0.0)]
    assert " ".join(gone) == dropped
    assert drain(backlog, 0.0) == left


def test_the_limit_in_bytes() -> None:
    backlog = Backlog[str](1000, 100)
    assert not backlog.put("large", "a", 1000, 0.0)
    assert backlog.put("b1", "b", 60, 0.0) == ["large"]
    assert not backlog.put("c1", "c", 40, 0.0)
    # Of the client whose requests are largest, although another has more of them.
    assert backlog.put("c2", "c", 10, 0.0) == ["b1"]
    # A request that is too large for all others to stay.
    assert backlog.put("d1", "d", 10**6, 0.0) == ["d1"]
    assert drain(backlog, 0.0) == "c1 c2"


def test_room_for_those_who_are_about_to_pop() -> None:
    backlog = Backlog[str](0, NO_LIMIT)
    assert backlog.put("a1", "a", 1, 0.0, room=1) == ()
    assert backlog.put("a2", "a", 1, 0.0, room=1) == ["a1"]


def test_time_spent_elsewhere_counts() -> None:
    backlog = Backlog[str](1000, NO_LIMIT)
    backlog.put("a1", "a", 1, 10.0, waited=STANDING)
    backlog.put("a2", "a", 1, 10.0)
    assert backlog.standing
    assert drain(backlog, 10.0) == "a2 a1"
    assert backlog.last_age == pytest.approx(STANDING)


def test_it_stands_until_nothing_old_waits() -> None:
    backlog = filled("a1 a2")
    backlog.put("a3", "a", 1, STANDING)
    assert backlog.standing
    assert backlog.pop(STANDING) == "a3"
    assert backlog.last_age == 0.0
    assert backlog.pop(STANDING) == "a2"
    assert backlog.last_age == STANDING
    assert backlog.standing
    backlog.put("a4", "a", 1, STANDING)
    backlog.put("a5", "a", 1, STANDING)
    assert backlog.pop(STANDING) == "a5"
    assert backlog.pop(STANDING) == "a4"
    assert backlog.pop(STANDING) == "a1"
    assert not backlog.standing
    for name in ("a6", "a7"):
        backlog.put(name, "a", 1, STANDING)
    assert drain(backlog, STANDING + TARGET) == "a6 a7"


def test_a_burst_that_is_worked_off_in_time_is_served_in_order() -> None:
    backlog = filled(" ".join(f"a{number}" for number in range(25)))
    now = 0.0
    order = []
    while backlog:
        now += 0.01
        order.append(backlog.pop(now))
        assert not backlog.standing
    assert order == [f"a{number}" for number in range(25)]


def test_a_few_requests_to_a_slow_handler_do_not_stand() -> None:
    """Ten callers that call again after each answer, and a handler that takes a second."""
    backlog = Backlog[str](1000, NO_LIMIT)
    expected = [f"a{number}" for number in range(100)]
    names = iter(expected)
    for _ in range(9):
        backlog.put(next(names), "a", 1, 0.0)
    served = []
    for number in range(80):
        served.append(backlog.pop(float(number)))
        backlog.put(next(names), "a", 1, float(number))
    assert served[20:] == sorted(served[20:], key=expected.index)
    assert not backlog.standing


def test_a_full_backlog_stands_although_its_requests_are_young() -> None:
    """What arrives faster than it gets old is dropped, and what is served was nearly dropped."""
    backlog = Backlog[int](10, NO_LIMIT)
    for number in range(200):
        backlog.put(number, "a", 1, number / 1000)
    assert backlog.standing
    assert backlog.pop(0.2) == 199


@pytest.mark.parametrize(
    ("arrivals", "served"),
    [
        # Letters arrive, dots are pops.
        ("a b c ...", "c b a"),
        # A client has one turn in a round, even if its next request is the newest.
        ("a b . b ..", "b a b"),
        ("a b b b ....", "b a b b"),
        # Those at the end of a fixed round would be as old as the round is long.
        ("a b c . d ...", "c d b a"),
        # One that has nothing left keeps its turn in the round.
        ("a b . . a b ..", "b a b a"),
        ("a a a a b . a a . . .", "b a a a"),
    ],
)
def test_the_turns_of_fresh_requests(arrivals: str, served: str) -> None:
    backlog = filled("_1")
    order = []
    for step in arrivals.replace(" ", ""):
        if step == ".":
            order.append(backlog.pop(STANDING))
        else:
            backlog.put(step, step, 1, STANDING)
    assert " ".join(order) == served


def test_clients_without_fresh_requests_take_turns_after_the_others() -> None:
    backlog = filled("a1 a2 b1")
    backlog.put("b2", "b", 1, STANDING)
    backlog.put("c1", "c", 1, STANDING)
    assert drain(backlog, STANDING) == "c1 b2 a2 b1 a1"


def test_the_first_requests_of_clients_that_have_left_do_not_delay_a_new_one() -> None:
    left = " ".join(f"{chr(ord('A') + number)}1" for number in range(40))
    backlog = filled(left)
    now = 10.0
    waited: Counter[bool] = Counter()
    for number in range(40):
        backlog.put(f"z{number}", "z", 1, now)
        waited[backlog.pop(now).startswith("z")] += 1
        now += 0.01
    # All but the turns that are guaranteed to the others.
    assert waited[False] == 40 // GUARANTEE


def test_an_empty_one_has_nothing_to_pop() -> None:
    with pytest.raises(IndexError):
        Backlog[str](10, NO_LIMIT).pop(0.0)


def test_clear_returns_the_order_of_arrival() -> None:
    backlog = filled("a1 b1 a2")
    backlog.put("b2", "b", 1, STANDING)
    assert backlog.clear() == ["a1", "b1", "a2", "b2"]
    assert len(backlog) == 0
    assert not backlog.standing
    backlog.put("a3", "a", 1, STANDING)
    assert drain(backlog, STANDING) == "a3"


def test_clients_that_come_once_leave_nothing_behind() -> None:
    backlog = filled("a1")
    for number in range(1000):
        backlog.put("x", f"client {number}", 1, STANDING)
        backlog.pop(STANDING)
    turns = backlog._turns
    assert turns is not None
    assert len(turns._served) < 100


class BacklogMachine(RuleBasedStateMachine):
    """Random operations. The model is a plain list of what waits."""

    @initialize(
        limit=st.integers(0, 30),
        limit_bytes=st.integers(0, 60),
        by_arrival=st.booleans(),
    )
    def start(self, limit: int, limit_bytes: int, by_arrival: bool) -> None:
        self.limit, self.limit_bytes, self.by_arrival = limit, limit_bytes, by_arrival
        self.backlog = Backlog[tuple[str, int]](limit, limit_bytes, by_arrival=by_arrival)
        self.now = 0.0
        self.dropped_at = -1.0
        self.numbers = itertools.count()
        # (client, number): (arrived, size)
        self.waiting: dict[tuple[str, int], tuple[float, int]] = {}
        # How many turns others have had since this client has waited without one.
        self.passed: dict[str, int] = {}

    @rule(client=st.sampled_from("abcdef"), size=st.integers(0, 9), count=st.integers(1, 5))
    def put(self, client: str, size: int, count: int) -> None:
        for _ in range(count):
            request = (client, next(self.numbers))
            self.waiting[request] = (self.now, size)
            self.passed.setdefault(client, 0)
            for dropped in self.backlog.put(request, client, size, self.now):
                others = [number for owner, number in self.waiting if owner == dropped[0]]
                assert dropped[1] == min(others), "not the oldest of its client"
                self.dropped_at = self.now
                del self.waiting[dropped]
            self.forget_idle()

    @rule(count=st.integers(1, 20))
    def pop(self, count: int) -> None:
        for _ in range(min(count, len(self.waiting))):
            oldest = min(self.waiting, key=lambda request: request[1])
            request = self.backlog.pop(self.now)
            client, number = request
            own = [n for c, n in self.waiting if c == client]
            assert number in (min(own), max(own))
            young = self.now - self.waiting[oldest][0] < TARGET
            if self.by_arrival or (young and self.now - self.dropped_at >= INTERVAL):
                assert request == oldest, "not in the order of arrival"
            arrived, _ = self.waiting.pop(request)
            assert self.backlog.last_age == self.now - arrived
            for other in self.passed:
                self.passed[other] += other != client
            self.passed[client] = 0
            self.forget_idle()
            clients = {owner for owner, _ in self.waiting}
            for other in clients if not self.by_arrival and self.backlog.standing else ():
                # Six clients, each of which the guaranteed turns reach, after a queue that was
                # served in the order of arrival before.
                assert self.passed[other] <= 6 * GUARANTEE + 30, "starved"

    @rule(request_age=st.sampled_from([0.0, 0.01, TARGET / 2, TARGET, STANDING]))
    def wait(self, request_age: float) -> None:
        self.now += request_age

    @rule()
    def clear(self) -> None:
        cleared = self.backlog.clear()
        assert cleared == sorted(self.waiting, key=lambda request: request[1])
        self.waiting.clear()
        self.forget_idle()

    def forget_idle(self) -> None:
        waiting = {client for client, _ in self.waiting}
        self.passed = {
            client: passed for client, passed in self.passed.items() if client in waiting
        }

    @invariant()
    def nothing_is_lost_or_doubled(self) -> None:
        if hasattr(self, "backlog"):
            assert len(self.backlog) == len(self.waiting) <= self.limit
            size = sum(size for _, size in self.waiting.values())
            assert size <= self.limit_bytes or len(self.waiting) == 1
            oldest = min((arrived for arrived, _ in self.waiting.values()), default=self.now)
            assert self.backlog.oldest_age(self.now) == self.now - oldest


SETTINGS = settings(
    max_examples=80, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck)
)
TestBacklog = BacklogMachine.TestCase
TestBacklog.settings = SETTINGS


@dataclass
class Result:
    """What a simulated server did: answered in time, served too late, and for how long it ran."""

    answered: int = 0
    late: int = 0
    latencies: Sequence[float] = ()

    @property
    def goodput(self) -> float:
        """The share of the work that was for a caller who still waited."""
        return self.answered / (self.answered + self.late)


class Simulation:
    """A server that works on one request at a time, and its callers, in virtual time."""

    def __init__(self, work: float, *, seed: int = 1) -> None:
        self.choose = random.Random(seed)
        self.backlog = Backlog[Any](1000, NO_LIMIT)
        self.work = work
        self.results: dict[str, Result] = {}
        self.sent = 0
        # When each call was sent and served, in the order in which they were served.
        self.served: list[tuple[float, float]] = []
        self._latencies: dict[str, list[float]] = {}
        self._busy = False
        self._events: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self._numbers = itertools.count()

    def at(self, time: float, callback: Callable[..., None], *arguments: Any) -> None:
        heapq.heappush(self._events, (time, next(self._numbers), callback, arguments))

    def run(self, until: float) -> None:
        while self._events and self._events[0][0] <= until:
            now, _, callback, arguments = heapq.heappop(self._events)
            callback(now, *arguments)

    def call(self, now: float, client: str, timeout: float, again: bool = False) -> None:
        """Send a request. ``again``: call again after the answer, or after the timeout."""
        call = [now, client, timeout, again, False]
        self.results.setdefault(client, Result(latencies=self._latencies.setdefault(client, [])))
        self.backlog.put(call, client, 1, now)
        self.sent += 1
        if again:
            self.at(now + timeout, self._give_up, call)
        self._serve(now)

    def poisson(self, now: float, clients: str, timeout: float, rate: float, end: float) -> None:
        """Call at random times, from one of the clients."""
        if now < end:
            self.call(now, self.choose.choice(clients), timeout)
            following = now + self.choose.expovariate(rate)
            self.at(following, self.poisson, clients, timeout, rate, end)

    def _give_up(self, now: float, call: list[Any]) -> None:
        if not call[4]:
            call[4] = True
            self.call(now, call[1], call[2], True)

    def _serve(self, now: float) -> None:
        if not self._busy and self.backlog:
            self._busy = True
            self.at(now + self.work, self._served, self.backlog.pop(now))

    def _served(self, now: float, call: list[Any]) -> None:
        self._busy = False
        self.served.append((call[0], now))
        result = self.results[call[1]]
        if now - call[0] <= call[2]:
            result.answered += 1
            self._latencies[call[1]].append(now - call[0])
            if call[3] and not call[4]:
                self.call(now, call[1], call[2], True)
            call[4] = True
        else:
            result.late += 1
        self._serve(now)

    @property
    def total(self) -> Result:
        """The result of all clients together."""
        results = self.results.values()
        return Result(sum(r.answered for r in results), sum(r.late for r in results))


@pytest.mark.parametrize("clients", ["one for all", "one each"])
@pytest.mark.parametrize("callers", [50, 100, 200])
@pytest.mark.parametrize("timeout", [0.2, 0.5, 2.0])
def test_callers_in_closed_loops_are_answered_in_time(
    callers: int, timeout: float, clients: str
) -> None:
    simulation = Simulation(work=0.01)
    for number in range(callers):
        client = "all" if clients == "one for all" else f"client {number}"
        simulation.at(0.0, simulation.call, client, timeout, True)
    simulation.run(10.0)
    assert simulation.total.goodput >= 0.97
    assert simulation.total.answered >= 0.97 * 1000


@pytest.mark.parametrize("work", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("load", [1.5, 4, 10])
def test_callers_that_come_at_random_are_answered_in_time(load: float, work: float) -> None:
    simulation = Simulation(work)
    simulation.poisson(0.0, "abcd", 10 * work + 0.5, load / work, 1000 * work)
    simulation.run(1000 * work)
    assert simulation.total.goodput >= 0.93


@pytest.mark.parametrize("flood", ["abcd", "a"])
@pytest.mark.parametrize("kind", ["outstanding", "rate"])
def test_a_flood_does_not_starve_a_polite_caller(flood: str, kind: str) -> None:
    simulation = Simulation(work=0.01)
    for number in range(500):
        if kind == "outstanding":
            simulation.at(0.0, simulation.call, flood[number % len(flood)], 2.0, True)
    if kind == "rate":
        simulation.poisson(0.0, flood, 2.0, 1000.0, 10.0)
    for number in range(40):
        simulation.at(1.0 + number / 5, simulation.call, "polite", 1.0)
    simulation.run(10.0)
    polite = simulation.results["polite"]
    assert (polite.answered, polite.late) == (40, 0)
    assert sorted(polite.latencies)[20] <= 4 * 0.01
    assert simulation.total.goodput >= 0.97


@pytest.mark.parametrize("clients", ["a", "abcd"])
def test_the_first_second_after_an_overload(clients: str) -> None:
    simulation = Simulation(work=0.01)
    simulation.poisson(0.0, clients, 0.5, 400.0, 5.0)
    simulation.run(5.0)
    sent = simulation.sent
    # At 0.8 of what the server can do.
    simulation.poisson(5.0, clients, 0.5, 80.0, 6.0)
    simulation.run(7.0)
    answered = [s for s, served in simulation.served if s >= 5.0 and served - s <= 0.5]
    assert len(answered) >= 0.95 * (simulation.sent - sent)


def test_up_to_its_load_a_server_serves_in_order_and_drops_nothing() -> None:
    simulation = Simulation(work=0.01)
    simulation.poisson(0.0, "ab", 2.0, 80.0, 50.0)
    simulation.run(60.0)
    sent = [sent for sent, _ in simulation.served]
    assert sent == sorted(sent)
    assert len(sent) == simulation.sent > 3500
