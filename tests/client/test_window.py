"""The window in tables: what takes a place, and when it comes back. No loop, port or future."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from copy import deepcopy
from typing import Any

import pytest

from rosasync._client.pace import RECENT, STALE
from rosasync._client.response_times import PATIENCE_INITIAL, PATIENCE_MIN, ResponseTimes
from rosasync._client.sent import Sent
from rosasync._client.window import Window

GRACE = 100.0


class Bench:
    """A window, a clock, and the server names that the graph shows, ``"AB"`` for A and B."""

    def __init__(self, size: int = 3, grace: float = GRACE, servers: str = "A") -> None:
        self.window = Window(size, grace)
        self.now = 0.0
        self.see(servers)

    def see(self, servers: str, ended: str = "") -> None:
        self.window.on_servers(frozenset(servers), self.now, frozenset(ended))

    def send(self, count: int = 1, *, leased: bool = False, servers: str | None = None) -> Sent:
        """Send requests of callers that wait, and return the last one."""
        seen = self.window.servers if servers is None else frozenset(servers)
        caller: Any = object()
        for _ in range(count):
            sent = Sent(self.window.last + 1, seen, self.now, caller, leased)
            self.window.add(sent)
        return sent

    def leave(self, *numbers: int) -> None:
        for number in numbers:
            self.window.leave(self.window.sent[number], self.now)

    def answer(self, *numbers: int) -> None:
        for number in numbers:
            self.window.on_answer(number, self.now)

    def wait(
        self, seconds: float, *, callers: bool = True, resend: Sent | None = None
    ) -> list[int]:
        """Let time pass, as the timer of a client does, and return what was forgotten."""
        end, forgotten = self.now + seconds, []
        while (due := self.window.due(callers, resend)) <= end:
            self.now = max(self.now, due)
            forgotten += [sent.number for sent in self.window.on_time(self.now, callers, resend)]
        self.now = end
        return forgotten

    def expected(self) -> float:
        """The estimate of a copy of the window, so that this one stays as it is."""
        return deepcopy(self.window).expected(self.now)

    @property
    def places(self) -> str:
        """The requests with a place, in order; those that are abandoned in brackets."""
        window = self.window
        return " ".join(
            f"({number})" if number in window.abandoned else f"{number}"
            for number, sent in window.sent.items()
            if sent.place
        )


Event = Callable[[Bench], object]

TABLE: list[tuple[str, str, Iterable[Event]]] = [
    ("requests of callers take places", "1 2 3", [lambda b: b.send(3)]),
    ("an answer gives its place back", "1 3", [lambda b: b.send(3), lambda b: b.answer(2)]),
    (
        "an answer says nothing of those that are waited for",
        "1",
        [lambda b: b.send(3), lambda b: b.answer(2, 3)],
    ),
    (
        "abandoned requests keep their places",
        "(1) 2 (3)",
        [lambda b: b.send(3), lambda b: b.leave(1, 3)],
    ),
    (
        "an answer gives back the places of earlier abandoned requests",
        "1 (4)",
        [lambda b: b.send(4), lambda b: b.leave(2, 4), lambda b: b.answer(3)],
    ),
    (
        "what has left the queue takes no place when it is abandoned",
        "",
        [lambda b: b.send(2), lambda b: b.answer(2), lambda b: b.leave(1)],
    ),
    (
        "a late answer gives a place back",
        "(2)",
        [lambda b: b.send(2), lambda b: b.leave(1, 2), lambda b: b.answer(1)],
    ),
    (
        "an answer to what was never sent says nothing",
        "(1) (2)",
        [lambda b: b.send(2), lambda b: b.leave(1, 2), lambda b: b.answer(2**62)],
    ),
    (
        "a new server has none of the abandoned requests",
        "2",
        [lambda b: b.send(2), lambda b: b.leave(1), lambda b: b.see("AB")],
    ),
    (
        "what was sent before a new server came takes no place when it is abandoned",
        "(2)",
        [
            lambda b: b.send(),
            lambda b: b.see("AB"),
            lambda b: b.send(),
            lambda b: b.leave(1, 2),
        ],
    ),
    (
        "requests whose servers were not known have gone to those seen next",
        "(1)",
        [lambda b: b.send(servers=""), lambda b: b.leave(1), lambda b: b.see("AB")],
    ),
    (
        "a server that goes leaves the places of what the other has",
        "(1)",
        [lambda b: b.see("AB"), lambda b: b.send(), lambda b: b.leave(1), lambda b: b.see("B")],
    ),
    (
        "what is waited for keeps its place while the old server answers",
        "5",
        [
            lambda b: b.send(5),
            lambda b: b.see("AB"),
            *[
                event
                for number in (1, 2, 3, 4)
                for event in (
                    lambda b: b.wait(0.8 * PATIENCE_MIN),
                    lambda b, n=number: b.answer(n),
                )
            ],
        ],
    ),
    (
        "a server that is silent after the next has come is taken for dead, with all its requests",
        "",
        [lambda b: b.send(3), lambda b: b.see("AB"), lambda b: b.wait(PATIENCE_INITIAL)],
    ),
    (
        "not before the patience is over",
        "1 2 3",
        [lambda b: b.send(3), lambda b: b.see("AB"), lambda b: b.wait(0.9 * PATIENCE_INITIAL)],
    ),
    (
        "nor while no caller waits",
        "1 2 3",
        [
            lambda b: b.send(3),
            lambda b: b.see("AB"),
            lambda b: b.wait(9 * PATIENCE_INITIAL, callers=False),
        ],
    ),
    (
        "what the new server has keeps its place meanwhile",
        "2",
        [
            lambda b: b.send(),
            lambda b: b.see("AB"),
            lambda b: b.send(),
            lambda b: b.wait(2 * PATIENCE_INITIAL),
        ],
    ),
    (
        "in a silence one place is given up, the oldest",
        "(2) (3)",
        [lambda b: b.send(3), lambda b: b.leave(1, 2, 3), lambda b: b.wait(PATIENCE_INITIAL)],
    ),
    (
        "and one more in each further one",
        "",
        [lambda b: b.send(3), lambda b: b.leave(1, 2, 3), lambda b: b.wait(3 * PATIENCE_INITIAL)],
    ),
    (
        "what is waited for keeps its place in a silence",
        "2",
        [lambda b: b.send(2), lambda b: b.leave(1), lambda b: b.wait(9 * PATIENCE_INITIAL)],
    ),
    (
        "an answer begins the silence again",
        "(2) (3)",
        [
            lambda b: b.send(3),
            lambda b: b.leave(2, 3),
            lambda b: b.wait(0.9 * PATIENCE_INITIAL),
            lambda b: b.answer(1),
            lambda b: b.wait(0.9 * PATIENCE_INITIAL),
        ],
    ),
    (
        "while no caller waits the places are kept",
        "(1) (2)",
        [lambda b: b.send(2), lambda b: b.leave(1, 2), lambda b: b.wait(50.0, callers=False)],
    ),
    (
        "but not beyond the grace period",
        "",
        [lambda b: b.send(2), lambda b: b.leave(1, 2), lambda b: b.wait(GRACE, callers=False)],
    ),
]


@pytest.mark.parametrize(
    ("places", "events"), [(p, e) for _, p, e in TABLE], ids=[t[0] for t in TABLE]
)
def test_places(places: str, events: Iterable[Event]) -> None:
    bench = Bench(size=5)
    for event in events:
        event(bench)
    assert bench.places == places
    window = bench.window
    assert window.taken == len(places.split())
    assert window.free == 5 - window.taken


def test_leases_and_their_requests_take_one_place_each() -> None:
    bench = Bench(size=2)
    window = bench.window
    window.lease()
    sent = bench.send(leased=True)
    assert (window.taken, window.free, bench.places) == (1, 1, "")
    bench.leave(sent.number)
    # Its next call waits while this is negative.
    window.lease()
    assert (window.free, bench.places) == (-1, "(1)")
    bench.answer(sent.number)
    assert window.free == 0
    window.release()
    window.release()
    assert (window.taken, window.leases) == (0, 0)


def test_a_window_that_shrinks_has_no_free_place_until_enough_came_back() -> None:
    bench = Bench(size=4)
    bench.send(4)
    bench.window.size = 2
    assert bench.window.free == -2
    bench.answer(1, 2, 3)
    assert bench.window.free == 1


@pytest.mark.parametrize(("leased", "lease"), [(False, 0), (True, 1)])
class TestSentAgain:
    """A window of two places: one is the call's, and another request may take the other."""

    def test_with_room_the_earlier_attempt_keeps_a_place(self, leased: bool, lease: int) -> None:
        bench, first = self.bench(leased)
        assert bench.window.may_send_again(first, leased)
        bench.window.supersede(first)
        bench.send(leased=leased)
        assert (bench.places, bench.window.free) == ("(1)" if leased else "(1) 2", 0)
        bench.answer(2)
        assert (bench.places, bench.window.free) == ("", 2 - lease)

    def test_without_room_it_waits(self, leased: bool, lease: int) -> None:
        bench, first = self.bench(leased)
        other = bench.send()
        assert not bench.window.may_send_again(first, leased)
        bench.answer(other.number)
        assert bench.window.may_send_again(first, leased)

    def test_what_has_left_the_queue_needs_no_room(self, leased: bool, lease: int) -> None:
        bench, first = self.bench(leased)
        bench.send()
        bench.answer(2)
        bench.send()
        assert bench.window.free == 0
        assert bench.window.may_send_again(first, leased)
        bench.window.supersede(first)
        bench.send(leased=leased)
        assert bench.window.free == 0

    def test_in_a_silence_it_takes_the_place_of_its_earlier_attempt(
        self, leased: bool, lease: int
    ) -> None:
        bench, first = self.bench(leased)
        bench.send()
        bench.wait(0.9 * PATIENCE_INITIAL, resend=first)
        assert not bench.window.may_send_again(first, leased)
        bench.wait(0.2 * PATIENCE_INITIAL, resend=first)
        assert bench.window.may_send_again(first, leased)
        bench.window.supersede(first)
        bench.send(leased=leased)
        assert bench.window.free == 0
        # Once for each attempt.
        assert bench.window.due(True, first) == math.inf

    def test_abandoned_requests_give_up_their_places_first(self, leased: bool, lease: int) -> None:
        bench, first = self.bench(leased)
        bench.leave(bench.send().number)
        bench.wait(1.1 * PATIENCE_INITIAL, resend=first)
        assert (bench.window.abandoned, first.lost) == ({}, False)

    def test_without_servers_it_has_no_place_but_its_leases(self, leased: bool, lease: int) -> None:
        bench, first = self.bench(leased)
        assert bench.window.find_lost(frozenset()) == [first]
        bench.window.remove(first)
        assert bench.window.free == 2 - lease
        bench.send(2 - lease)
        assert bench.window.may_send_again(None, leased) == leased

    @staticmethod
    def bench(leased: bool) -> tuple[Bench, Sent]:
        bench = Bench(size=2)
        if leased:
            bench.window.lease()
        return bench, bench.send(leased=leased)


@pytest.mark.parametrize(("ended", "free"), [("", 0), ("A", 1), ("AB", 3)])
def test_requests_at_servers_that_have_ended_take_no_place_beside_a_new_one(
    ended: str, free: int
) -> None:
    bench = Bench()
    bench.send()
    bench.see("AB")
    bench.send(2)
    bench.see("ABC", ended)
    assert bench.window.free == free


def test_what_each_server_has() -> None:
    bench = Bench(size=9)
    bench.send()
    bench.see("AB")
    bench.send()
    bench.see("BC")
    bench.send()
    bench.send(servers="")
    window = bench.window

    def lost(servers: str) -> list[int]:
        return [sent.number for sent in window.find_lost(frozenset(servers))]

    assert lost("AB") == []
    assert lost("B") == lost("BC") == [1]
    assert lost("C") == [1, 2]
    assert lost("D") == [1, 2, 3]
    assert lost("") == [1, 2, 3, 4]


def test_late_responses_are_expected_for_the_grace_period() -> None:
    bench = Bench(size=9)
    bench.send(3)
    bench.leave(1)
    bench.answer(2)
    assert bench.places == "3"
    bench.wait(GRACE / 2)
    bench.leave(3)
    assert bench.window.due(False, None) == GRACE
    assert bench.wait(GRACE / 2 - 1.0) == []
    assert bench.wait(1.0) == [1]
    assert bench.wait(GRACE) == [3]
    assert (bench.window.sent, bench.window.due(True, None)) == ({}, math.inf)


def test_what_was_answered_late_is_not_forgotten_again() -> None:
    bench = Bench()
    bench.send()
    bench.leave(1)
    bench.answer(1, 1)
    assert bench.window.due(True, None) == math.inf
    assert bench.wait(2 * GRACE) == []


@pytest.mark.parametrize("grace", [0.0, 1e-9])
def test_without_a_grace_period(grace: float) -> None:
    bench = Bench(grace=grace)
    bench.send(3)
    bench.leave(1, 2, 3)
    assert bench.wait(grace) == [1, 2, 3]


def test_a_silence_begins_with_the_first_request() -> None:
    bench = Bench()
    bench.send()
    bench.answer(1)
    patience = bench.window.times.patience
    bench.wait(1000.0)
    bench.send()
    bench.leave(2)
    assert bench.window.due(True, None) == bench.now + patience


def test_a_slow_response_makes_a_client_patient_although_its_caller_has_left() -> None:
    bench = Bench()
    bench.send()
    bench.leave(1)
    bench.wait(6.0, callers=False)
    bench.answer(1)
    assert bench.window.times.patience > PATIENCE_INITIAL


def test_clear_leaves_only_the_leases() -> None:
    bench = Bench()
    bench.window.lease()
    bench.send(2)
    bench.leave(2)
    bench.window.clear()
    assert repr(bench.window) == "<Window 1/3 places, 1 leases, 0 abandoned>"
    assert bench.window.due(True, None) == math.inf


def test_a_request_says_whose_place_it_takes() -> None:
    bench = Bench()
    bench.window.lease()
    bench.send(leased=True)
    bench.send(2)
    bench.leave(3)
    bench.wait(PATIENCE_INITIAL)
    assert list(map(repr, bench.window.sent.values())) == [
        "<Sent #1 waited for, its lease's place>",
        "<Sent #2 waited for, a place>",
        "<Sent #3 abandoned, no place>",
    ]


class TestPatience:
    """`ResponseTimes`: how long a client waits without any answer."""

    def test_it_is_a_multiple_of_the_lowest_response_time(self) -> None:
        times = ResponseTimes()
        assert times.patience == PATIENCE_INITIAL
        times.add(0.125)
        assert times.patience == 0.5
        times.add(0.0625)
        assert times.patience == 0.25

    def test_a_slow_server_makes_a_client_patient(self) -> None:
        times = ResponseTimes()
        for _ in range(15):
            times.add(3.0)
        assert 6.0 < times.patience < 12.0

    def test_it_has_a_minimum(self) -> None:
        times = ResponseTimes()
        times.add(0.0001)
        assert times.patience == PATIENCE_MIN

    def test_losses_that_are_repaired_late_do_not_make_a_client_patient(self) -> None:
        times = ResponseTimes()
        for _ in range(100):
            times.add(3.0)
            times.add(0.001)
            times.add(0.001)
        times.add(1.0)
        assert times.patience < 0.5


class TestExpected:
    """How long a request takes that is sent now."""

    def test_nothing_is_known_at_first(self) -> None:
        bench = Bench(size=10)
        assert bench.window.expected(0.0) == 0.0
        self.serve(bench, [0.1] * 2, at_once=1)
        assert bench.window.expected(bench.now) == 0.0

    def test_one_after_another(self) -> None:
        bench = Bench(size=10)
        self.serve(bench, [0.1] * 10, at_once=10)
        # A further place is counted for what others send in the meantime.
        for out in range(9):
            assert bench.window.expected(bench.now) == pytest.approx(0.1 * (out + 2))
            bench.send()

    def test_it_is_known_before_a_request_has_met_a_full_window(self) -> None:
        bench = Bench(size=10)
        bench.send(10)
        for number in (1, 2, 3):
            bench.now += 0.1
            bench.answer(number)
        assert bench.window.expected(bench.now) == pytest.approx(0.9)

    def test_all_at_once(self) -> None:
        bench = Bench(size=10)
        for _ in range(8):
            bench.send(10)
            bench.now += 0.1
            bench.answer(*range(bench.window.last - 9, bench.window.last + 1))
        bench.send(9)
        assert 0.1 <= bench.window.expected(bench.now) <= 0.15

    def test_it_follows_a_server_that_becomes_quick_again(self) -> None:
        bench = Bench(size=10)
        self.serve(bench, [1.0] * 20, at_once=10)
        self.serve(bench, [0.01] * RECENT, at_once=1)
        assert bench.window.expected(bench.now) < 0.05

    def test_whether_an_answer_comes_in_time_is_what_the_estimate_says(self) -> None:
        choose = random.Random(1)
        bench = Bench(size=10)
        for _ in range(20):
            # From 1 ms to 10 s, so that old response times are stale.
            scale = 10 ** choose.uniform(-3, 1)
            at_once = choose.randint(1, 10)
            self.serve(bench, [choose.expovariate(1 / scale) for _ in range(30)], at_once)
            bench.window.clear()
            for _ in range(30):
                if bench.window.free and choose.random() < 0.3:
                    bench.send()
                bench.now += choose.choice([0.0, 0.0, scale, STALE])
                needed = bench.expected()
                for seconds in (0.0, 0.5 * needed, 0.99 * needed, 1.01 * needed, 3.0 * needed):
                    assert bench.window.answers_in(seconds, bench.now) == (seconds >= needed)

    def test_a_full_window_is_expected_to_take_longer_than_every_answer_so_far(self) -> None:
        bench = Bench(size=10)
        self.serve(bench, [0.1] * 3, at_once=1)
        bench.send(9)
        assert bench.window.expected(bench.now) == pytest.approx(1.1)
        assert not bench.window.answers_in(1.0, bench.now)
        assert bench.window.answers_in(1.2, bench.now)

    def test_it_is_forgotten_with_the_server_and_after_some_time(self) -> None:
        bench = Bench(size=10)
        self.serve(bench, [0.1] * 10, at_once=1)
        assert bench.window.expected(bench.now) > 0
        assert bench.window.expected(bench.now + STALE + 1.0) == 0.0
        bench.see("B")
        assert bench.window.expected(bench.now) == 0.0

    @staticmethod
    def serve(bench: Bench, seconds: list[float], at_once: int) -> None:
        """Answer requests one after another, with a number of them out at once."""
        bench.send(at_once)
        first = bench.window.last - at_once + 1
        for number, work in enumerate(seconds, first):
            bench.now += work
            bench.answer(number)
            if number + at_once < first + len(seconds):
                bench.send()
