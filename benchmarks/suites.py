"""The scenarios behind each command."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from functools import partial

from benchmarks.contestants import CONTESTANTS
from benchmarks.runner import Scenario
from benchmarks.work import Work

__all__ = ["SUITES", "make_suite"]

ALL = tuple(CONTESTANTS)
MANY_AT_ONCE = tuple(key for key in ALL if key != "process-per-call")
LEADING = ("direct", "direct-uvloop", "executor", "call", "afor-qos", "floor")
BRIDGES = ("direct", "executor")

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


def _throughput() -> list[Scenario]:
    deep = [
        dataclasses.replace(
            _callers(n),
            key=f"{n} callers, depth 1000",
            group=f"{n} callers",
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
        f"{callers} callers",
        ALL if callers == 1 else MANY_AT_ONCE,
        LEAN,
        callers=callers,
        calls=max(2000, min(1000 * callers, 20_000)),
        metric="rate",
    )


def _services(services: int) -> Scenario:
    return Scenario(
        f"{services} services",
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
    return Scenario(f"answer after {milliseconds} ms", "delay", LEADING, work, calls=500)


def _resting(clients: int) -> Work:
    return Work(idle_clients=clients)


SUITES: dict[str, Callable[[], list[Scenario]]] = {
    "latency": _latency,
    "throughput": _throughput,
    "scale": _scale,
    "idle": partial(_idle, *BRIDGES),
    "memory": partial(_memory, *BRIDGES),
}


def make_suite(
    name: str, *, quick: bool = False, contestants: Collection[str] = ()
) -> list[Scenario]:
    """The scenarios of one command, shortened and narrowed down as asked.

    Raises:
        ValueError: a contestant that does not exist.
    """
    if unknown := set(contestants) - set(CONTESTANTS):
        raise ValueError(
            f"no contestant {', '.join(sorted(unknown))}; there are {', '.join(CONTESTANTS)}"
        )
    suite = [_narrow(scenario, contestants) for scenario in SUITES[name]()]
    suite = [scenario for scenario in suite if scenario.contestants]
    return [_shorten(scenario) for scenario in suite] if quick else suite


def _narrow(scenario: Scenario, contestants: Collection[str]) -> Scenario:
    kept = tuple(key for key in scenario.contestants if not contestants or key in contestants)
    return dataclasses.replace(scenario, contestants=kept)


def _shorten(scenario: Scenario) -> Scenario:
    seconds = 3.0 if scenario.action == "rest" else 1.0
    calls = max(2500, scenario.calls // 4, scenario.callers * 4)
    return dataclasses.replace(
        scenario, seconds=seconds, calls=calls, rounds=1 if scenario.action == "soak" else 1000
    )
