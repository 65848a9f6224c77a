"""Prints how many calls are answered in an overload, in virtual time.

::

    python -m tests.support.overload_table --timeouts 0.1,mixed --processes 1,4

Beside the clients stands a mark to compare with, though not a bound: a server that knows the
callers, and always works for the one who has the most time left.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace

from rosasync import Limits
from tests.support.overload import Case, Result, Timeouts, simulate, simulate_best

TIMEOUTS: dict[str, Timeouts] = {
    "0.1": (0.1,),
    "0.5": (0.5,),
    "2": (2.0,),
    "mixed": (0.1, 0.5, 2.0),
    "none": (None,),
}
GOODPUT, LATE = 0.95, 0.05


def cases(arguments: argparse.Namespace) -> Iterator[tuple[str, Case]]:
    """Yield the cases that were asked for, each with the name of its timeouts."""
    for work, shape, timeouts, load, processes in itertools.product(
        arguments.work, arguments.spread, arguments.timeouts, arguments.loads, arguments.processes
    ):
        yield (
            timeouts,
            Case(
                server=arguments.server,
                work=float(work) / 1000,
                exponential=shape == "exponential",
                load=float(load),
                timeouts=TIMEOUTS[timeouts],
                processes=int(processes),
            ),
        )


def meets(result: Result) -> bool:
    """Return whether a result meets the targets."""
    return result.goodput >= GOODPUT and result.late <= LATE


def row(timeouts: str, case: Case, columns: Iterable[Result]) -> str:
    """Return a line of the table."""
    shape = "exp." if case.exponential else "const."
    place = f"{case.work * 1000:>5g} {shape:6} {timeouts:>5} {case.load:>4g} {case.processes:>2}"
    return place + "".join(
        f"   {result.goodput:4.2f} {result.late:4.0%}{' ' if meets(result) else '*'}"
        for result in columns
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, default in (
        ("work", "1,10,100"),
        ("spread", "constant,exponential"),
        ("timeouts", "0.1,0.5,2,mixed,none"),
        ("loads", "1.5,4,10"),
        ("processes", "1"),
    ):
        parser.add_argument(f"--{name}", default=default, type=lambda text: text.split(","))
    parser.add_argument("--server", default="stock", choices=("stock", "rosasync"))
    parser.add_argument("--in-flight", default=10, type=int, help="Limits.in_flight")
    parser.add_argument("--seed", default=1, type=int)
    arguments = parser.parse_args()
    limits = Limits(in_flight=arguments.in_flight)
    print("goodput, late; * misses a target")
    print(f"{'work':>5} {'':6} {'limit':>5} load  n   best          stock         rosasync")
    for timeouts, case in cases(arguments):
        found = (
            simulate_best(case, seed=arguments.seed),
            simulate(replace(case, client="stock"), seed=arguments.seed),
            simulate(case, seed=arguments.seed, limits=limits),
        )
        print(row(timeouts, case, found), flush=True)


if __name__ == "__main__":
    main()
