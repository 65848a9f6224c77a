"""The scenarios of each command."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Collection
from functools import partial

from benchmarks.contestants import CONTESTANTS
from benchmarks.names import check_names
from benchmarks.runner import Scenario
from benchmarks.targets import PEERS, TARGETS
from benchmarks.ticks import make_ticks
from benchmarks.work import SERVERS, Work
from rosasync._core.text import count

__all__ = ["SUITES", "make_suite"]

FOR_FAULTS = ("direct-retry", "call-async", "semaphore")
ALL = tuple(
    key for key, entry in CONTESTANTS.items() if key not in FOR_FAULTS and entry.kind != "leaf"
)
MANY_AT_ONCE = tuple(key for key in ALL if key != "process-per-call")
LEADING = ("direct", "direct-uvloop", "executor", "call", "afor-qos", "floor")
POLLING = (*LEADING, "direct-busy", "busy")
BRIDGES = ("direct", "executor")
HEADLINE = ("direct-uvloop", "direct", "call", "to-thread", "call-multi")

LEAN = Work(server="lean")
SOAK = Work(server="lean", services=2, delays=(0.0, 0.003))


def _latency() -> list[Scenario]:
    return [
        Scenario("one at a time", "one at a time", ALL),
        _callers(8),
        Scenario(
            "server inside",
            "server inside",
            ("direct", "direct-uvloop", "executor", "call", "afor-qos"),
            Work(server="inside"),
        ),
        *(_idle_clients(n) for n in (0, 300)),
        *_idle("direct"),
        *_memory("direct"),
    ]


def _headline() -> list[Scenario]:
    """Return what the README shows: one call and eight at once, to each of two servers."""
    eight = dataclasses.replace(_callers(8), key="8 callers, stock server", work=Work())
    every = [Scenario("one at a time", "one at a time", ALL), _callers(1), eight, _callers(8)]
    return [dataclasses.replace(scenario, contestants=HEADLINE) for scenario in every]


def _throughput() -> list[Scenario]:
    deep = [
        dataclasses.replace(
            _callers(n),
            key=f"{n} callers, depth 1000",
            work=dataclasses.replace(LEAN, depth=1000),
        )
        for n in (64, 512)
    ]
    return [*(_callers(n) for n in (1, 8, 64, 512)), *deep]


def _scale() -> list[Scenario]:
    return [
        *(_services(n) for n in (1, 10, 100, 500)),
        *(_idle_clients(n) for n in (0, 50, 300)),
        *(_payload(name, size) for name, size in _SIZES.items()),
        *(_delay(n) for n in (0, 1, 10)),
    ]


def _idle(*sessions: str) -> list[Scenario]:
    rest = Scenario("idle", "idle", (), action="rest", seconds=10.0, metric="share")
    return [
        dataclasses.replace(rest, key="idle, 50 clients", contestants=sessions, work=_resting(50)),
        dataclasses.replace(rest, key="idle, one client", contestants=("call",), work=_resting(0)),
    ]


def _memory(*sessions: str) -> list[Scenario]:
    return [Scenario("memory", "memory", sessions, SOAK, action="soak", rounds=3, metric="growth")]


def _callers(callers: int) -> Scenario:
    key = "1 caller, lean server" if callers == 1 else f"{callers} callers"
    return Scenario(
        key,
        "callers",
        ALL if callers == 1 else MANY_AT_ONCE,
        LEAN,
        callers=callers,
        calls=max(2000, min(1000 * callers, 20_000)),
        metric="rate",
    )


def _services(services: int) -> Scenario:
    return Scenario(
        count(services, "service"),
        "services",
        LEADING,
        dataclasses.replace(LEAN, services=services),
        callers=8,
        calls=8000,
        metric="rate",
    )


def _idle_clients(clients: int) -> Scenario:
    work = Work(idle_clients=clients)
    return Scenario(f"{clients} idle clients", "idle clients", ("direct", "executor", "call"), work)


_SIZES = {"a bool": 1, "1 kB": 1_000, "64 kB": 64_000, "1 MB": 1_000_000}


def _payload(name: str, size: int) -> Scenario:
    srv_type = "std_srvs/srv/SetBool" if size == 1 else "nav_msgs/srv/GetMap"
    work = dataclasses.replace(LEAN, srv_type=srv_type, payload=size)
    return Scenario(name, "payload", LEADING, work, calls=1000)


def _delay(milliseconds: int) -> Scenario:
    work = dataclasses.replace(LEAN, delays=(milliseconds / 1000,))
    return Scenario(f"answer after {milliseconds} ms", "delay", POLLING, work, calls=500)


def _hosts() -> list[Scenario]:
    one = Scenario("another host", "another host", POLLING, LEAN, host="other")
    eight = dataclasses.replace(
        one, key="another host, 8 callers", contestants=LEADING, callers=8, metric="rate"
    )
    return [one, eight]


def _flood() -> list[Scenario]:
    beside = Scenario(
        "flood",
        "flood",
        ("direct-retry", "direct", "executor", "spin-until"),
        Work(busy=0.05),
        callers=10,
        calls=400,
        flood=8,
        metric="lost",
    )
    deep = dataclasses.replace(
        beside,
        key="flood, depth 1000",
        contestants=("spin-until",),
        work=dataclasses.replace(beside.work, depth=1000),
    )
    return [beside, deep]


def _servers() -> list[Scenario]:
    one = [
        Scenario(f"{name}, one", "servers, one at a time", ("floor",), Work(server=name))
        for name in ("stock", "stock-async", *SERVERS)
    ]
    eight = [
        dataclasses.replace(
            scenario,
            key=f"{scenario.work.server}, eight",
            group="servers, eight at once",
            contestants=("direct-uvloop",),
            callers=8,
            calls=16_000,
            metric="rate",
        )
        for scenario in one
    ]
    return [*one, *eight]


def _resting(clients: int) -> Work:
    return Work(idle_clients=clients)


def _targets() -> list[Scenario]:
    """Return the fewest scenarios that show whether the targets are met."""
    needed: defaultdict[str, set[str]] = defaultdict(set)
    for scenario, contestant in (side for target in TARGETS for side in target.sides):
        needed[scenario].update(PEERS.get(contestant, (contestant,)))
    every = {s.key: s for name, make in SUITES.items() if name != "targets" for s in make()}
    return [
        dataclasses.replace(
            scenario, contestants=tuple(c for c in scenario.contestants if c in needed[key])
        )
        for key, scenario in every.items()
        if needed[key]
    ]


SUITES: dict[str, Callable[[], list[Scenario]]] = {
    "headline": _headline,
    "latency": _latency,
    "throughput": _throughput,
    "scale": _scale,
    "hosts": _hosts,
    "flood": _flood,
    "ticks": make_ticks,
    "targets": _targets,
    "servers": _servers,
    "idle": partial(_idle, *BRIDGES),
    "memory": partial(_memory, *BRIDGES),
}


def make_suite(
    name: str, *, quick: bool = False, contestants: Collection[str] = ()
) -> list[Scenario]:
    """Return the scenarios of one command, shortened and narrowed as requested.

    Raises:
        ValueError: a contestant that does not exist.
    """
    check_names("contestant", contestants, CONTESTANTS)
    suite = [_narrow(scenario, contestants) for scenario in SUITES[name]()]
    suite = [scenario for scenario in suite if scenario.contestants]
    return [_shorten(scenario) for scenario in suite] if quick else suite


def _narrow(scenario: Scenario, contestants: Collection[str]) -> Scenario:
    kept = tuple(key for key in scenario.contestants if not contestants or key in contestants)
    return dataclasses.replace(scenario, contestants=kept)


def _shorten(scenario: Scenario) -> Scenario:
    if scenario.action == "tick":
        return dataclasses.replace(scenario, calls=max(50, scenario.calls // 4))
    seconds = 3.0 if scenario.action == "rest" else 1.0
    calls = max(2500, scenario.calls // 2, scenario.callers * 4)
    return dataclasses.replace(
        scenario, seconds=seconds, calls=calls, rounds=1 if scenario.action == "soak" else 1000
    )
