"""Calls while something is wrong with the network or the server: rosasync beside a stock client."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.contestants.base import ANSWERED, LoggedCall
from benchmarks.pages import markdown_table
from benchmarks.server import WorkServer
from benchmarks.sharing import older
from benchmarks.trials import GOALS, Goal, Trials, check
from benchmarks.work import Work
from tests.support.child import Child
from tests.support.lossy import LossyHosts

__all__ = [
    "SITUATIONS",
    "Fault",
    "goals",
    "heading",
    "late_calls",
    "measure",
    "plans",
    "row",
    "section",
]

COMMAND = "faults"
LOST_SHARE, SEED = 0.2, 1
LOSS, DELAY = "20 % loss", "20 % loss and 100 ms"
KILLED, RESTARTED, SLOW = "server killed", "server restarted", "slow server"
STOCK, OURS, RETRY = "call-async", "direct", "direct-retry"
BEFORE, BEFORE_RETRY = "before", "before-retry"
KEYS = {BEFORE: OURS, BEFORE_RETRY: RETRY}
PLAIN, RETRIED = 8, 2
"""The calls beside each other on a slow server."""
SLOW_WORK, WORK = 0.3, 0.001
SLOW_ROUNDS = 3
CALLERS, MANY_CALLERS = 10, 50
TIMEOUT, LONG_TIMEOUT = 2.0, 10.0
NEXT_SERVER = 1.0
"""Seconds from the death of a server to the start of the next one."""
KILL_AFTER = 2.0
RESTART_EVERY = 2.0
SOON = 0.5
"""Seconds after a restart by which the calls of the old server have ended."""
PATIENCE = 20.0


@dataclass(frozen=True)
class Fault:
    """How the calls of one contestant ended in one situation.

    Attributes:
        ended: the number of calls by outcome: ``answered``, or the name of the error.
        first_answer: seconds from the death of a server to the next answer.
        late: calls that were neither answered nor ended soon after a restart; `latest` is the
            longest time of a call that was not answered, from the restart to its end.
        plain_lost: unanswered calls without retries, of those beside retried ones.
    """

    situation: str
    contestant: str
    callers: int
    seconds: float
    ended: Mapping[str, int]
    restarts: int = 0
    first_answer: float | None = None
    late: int | None = None
    latest: float | None = None
    plain_lost: int | None = None

    @property
    def answered(self) -> int:
        return self.ended.get(ANSWERED, 0)

    @property
    def unanswered(self) -> int:
        return sum(self.ended.values()) - self.answered


@dataclass
class Bench:
    """Names the services, and makes the processes of the contestants.

    Attributes:
        prefix: the start of the contestants' commands; `server_prefix` of the servers'.
        environment: for both; `older` is for contestants from another checkout.
    """

    older: Mapping[str, str]
    prefix: Sequence[str] = ()
    server_prefix: Sequence[str] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    _numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def work(self, timeout: float, seconds: float = WORK) -> Work:
        name = f"/bench/fault_{next(self._numbers)}"
        return Work(srv_name=name, timeout=timeout, handling=seconds)

    def server(self, work: Work) -> WorkServer:
        return WorkServer(work, prefix=self.server_prefix, environment=self.environment)

    @contextmanager
    def client(self, contestant: str, work: Work) -> Iterator[Child]:
        """Set a contestant up in a process of its own, and end it."""
        key = KEYS.get(contestant, contestant)
        environment = {**self.environment, **(self.older if contestant in KEYS else {})}
        with Child(
            "benchmarks.worker", key, prefix=self.prefix, environment=environment, quiet=True
        ) as child:
            child.ask_now("setup", work=work.to_json())
            yield child
            child.ask_now("close")


def plans(
    situations: Sequence[str], contestants: Sequence[str], before: Path | None = None
) -> list[tuple[str, str]]:
    """Return the rows to measure: a situation and a contestant each.

    Raises:
        ValueError: a situation or contestant that does not exist, or not without `before`.
    """
    if unknown := {*situations} - {*SITUATIONS}:
        raise ValueError(f"no situation {', '.join(sorted(unknown))}: {', '.join(SITUATIONS)}")
    if unknown := {*contestants} - {*LABELS}:
        raise ValueError(f"no contestant {', '.join(sorted(unknown))}: {', '.join(LABELS)}")
    if before is None and KEYS.keys() & set(contestants):
        raise ValueError(f"{', '.join(KEYS)} need --before")
    return list(itertools.product(situations, contestants))


def measure(
    chosen: Sequence[tuple[str, str]],
    seconds: float,
    before: Path | None = None,
    on_fault: Callable[[Fault], object] = lambda fault: None,
) -> list[Fault]:
    """Measure one row after the other.

    Raises:
        NoHosts: network namespaces cannot be created.
    """
    faults = []
    with older(before) as environment:
        for situation, contestant in chosen:
            faults.append(SITUATIONS[situation](Bench(environment), contestant, seconds))
            on_fault(faults[-1])
    return faults


def _lossy(situation: str, delay: float) -> Callable[[Bench, str, float], Fault]:
    """Return the measurement of calls over a lossy link."""

    def measure_loss(bench: Bench, contestant: str, seconds: float) -> Fault:
        with LossyHosts("server", "client", loss=LOST_SHARE, delay=delay, seed=SEED) as hosts:
            far = Bench(bench.older, hosts.on("client"), hosts.on("server"), hosts.environment)
            work = far.work(TIMEOUT)
            with far.server(work), far.client(contestant, work) as client:
                calls = _log(client, CALLERS, seconds)
        return Fault(situation, contestant, CALLERS, seconds, _ends(calls))

    return measure_loss


def _killed(bench: Bench, contestant: str, seconds: float) -> Fault:
    """Kill the server with calls out; a new one starts a second later."""
    work = bench.work(TIMEOUT)
    first = bench.server(work)
    with bench.client(contestant, work) as client, ThreadPoolExecutor(1) as thread:
        log = thread.submit(_log, client, CALLERS, KILL_AFTER + seconds)
        time.sleep(KILL_AFTER)
        killed = time.monotonic()
        first.kill()
        time.sleep(NEXT_SERVER)
        began = time.monotonic()
        with bench.server(work):
            calls = log.result()
    answers = [call.end - killed for call in calls if call.outcome == ANSWERED if call.end > began]
    return Fault(
        KILLED,
        contestant,
        CALLERS,
        seconds,
        _ends(call for call in calls if call.end > killed),
        first_answer=min(answers, default=None),
    )


def _restarted(bench: Bench, contestant: str, seconds: float) -> Fault:
    """Interrupt the server every two seconds, and start it again once it has ended."""
    work = bench.work(LONG_TIMEOUT)
    server = bench.server(work)
    restarts = []
    with bench.client(contestant, work) as client, ThreadPoolExecutor(1) as thread:
        log = thread.submit(_log, client, MANY_CALLERS, seconds)
        until = time.monotonic() + seconds
        while time.monotonic() + RESTART_EVERY < until:
            time.sleep(RESTART_EVERY)
            restarts.append(time.monotonic())
            server.interrupt()
            server = bench.server(work)
        calls = log.result()
    server.close()
    delays = late_calls(calls, restarts)
    return Fault(
        RESTARTED,
        contestant,
        MANY_CALLERS,
        seconds,
        _ends(calls),
        restarts=len(restarts),
        late=sum(delay > SOON for delay in delays),
        latest=max(delays, default=None),
    )


def late_calls(calls: Iterable[LoggedCall], restarts: Sequence[float]) -> list[float]:
    """Return for each unanswered call the seconds from the restart that ended it to its end.

    That is the first restart while the call was out, or the last one before it began.
    """
    delays = []
    for call in calls:
        if call.outcome != ANSWERED:
            during = [at for at in restarts if call.begin <= at <= call.end]
            earlier = [at for at in restarts if at < call.begin]
            at = during[0] if during else earlier[-1] if earlier else call.begin
            delays.append(call.end - at)
    return delays


def _slow(bench: Bench, contestant: str, seconds: float) -> Fault:
    """Make plain calls beside retried ones, together as many as the server queues."""
    ended: Counter[str] = Counter()
    lost = 0
    for _ in range(SLOW_ROUNDS):
        work = bench.work(LONG_TIMEOUT, SLOW_WORK)
        with bench.server(work), bench.client(contestant, work) as client:
            if KEYS.get(contestant, contestant) != RETRY:
                outcomes = _ends(_log(client, PLAIN, 0.001))
                ended.update(outcomes)
                lost += sum(outcomes.values()) - outcomes.get(ANSWERED, 0)
                continue
            calls = client.ask_now("beside", plain=PLAIN, retried=RETRIED)
            ended.update(ANSWERED if answered else "unanswered" for _, answered in calls)
            lost += sum(not retried and not answered for retried, answered in calls)
    return Fault(
        SLOW,
        contestant,
        ended.total() // SLOW_ROUNDS,
        LONG_TIMEOUT,
        dict(ended),
        plain_lost=lost,
    )


def _log(client: Child, callers: int, seconds: float) -> list[LoggedCall]:
    patience = seconds + LONG_TIMEOUT + PATIENCE
    calls = client.ask_now("log", callers=callers, seconds=seconds, patience=patience)
    return [LoggedCall(*call) for call in calls]


def _ends(calls: Iterable[LoggedCall]) -> dict[str, int]:
    return dict(Counter(call.outcome for call in calls))


SITUATIONS: Mapping[str, Callable[[Bench, str, float], Fault]] = {
    LOSS: _lossy(LOSS, 0.0),
    DELAY: _lossy(DELAY, 0.1),
    KILLED: _killed,
    RESTARTED: _restarted,
    SLOW: _slow,
}


# Tables and goals.

heading = ["", "contestant", "callers", "answered", "not answered", "remarks"]

LABELS = {
    STOCK: "stock call_async",
    OURS: "rosasync",
    RETRY: "rosasync, Retry",
    BEFORE: "rosasync before",
    BEFORE_RETRY: "rosasync before, Retry",
}


def row(fault: Fault) -> list[str]:
    """Return the fault as a row of the table."""
    missed = [f"{n:,} {name}" for name, n in sorted(fault.ended.items()) if name != ANSWERED]
    return [
        fault.situation,
        LABELS[fault.contestant],
        str(fault.callers),
        f"{fault.answered:,}",
        ", ".join(missed) or "0",
        "; ".join(_remarks(fault)),
    ]


def _remarks(fault: Fault) -> Iterator[str]:
    if fault.situation == KILLED:
        first = fault.first_answer
        yield "no answer" if first is None else f"next answer after {first:.1f} s"
    if fault.restarts:
        yield f"{fault.restarts} restarts"
    if fault.late is not None:
        yield f"{fault.late:,} ended more than {SOON:g} s after the restart"
    if fault.latest is not None:
        yield f"the latest after {fault.latest:.2f} s"
    if fault.plain_lost is not None:
        yield f"{fault.plain_lost} of {PLAIN * SLOW_ROUNDS} plain calls lost"


def goals(faults: Sequence[Fault]) -> list[Goal]:
    """Compare the faults with the goals of the documentation."""
    by = {(fault.situation, fault.contestant): fault for fault in faults}

    def figure(
        situation: str, contestant: str, of: Callable[[Fault], float | None]
    ) -> float | None:
        fault = by.get((situation, contestant))
        return None if fault is None else of(fault)

    return [
        *(
            check(f"{situation}: answered / stock", _to_stock(by, situation), ">=", 1.0)
            for situation in (LOSS, DELAY)
        ),
        check(
            f"{KILLED}: QueueTimeout",
            figure(KILLED, OURS, lambda fault: fault.ended.get("QueueTimeout", 0)),
            "<=",
            0,
        ),
        check(
            f"{RESTARTED}: neither answered nor ended within {SOON:g} s",
            figure(RESTARTED, OURS, lambda fault: fault.late),
            "<=",
            0,
        ),
        check(
            f"{RESTARTED}: unanswered with Retry",
            figure(RESTARTED, RETRY, lambda fault: fault.unanswered),
            "<=",
            0,
        ),
        check(
            f"{SLOW}: plain calls lost beside retried ones",
            figure(SLOW, RETRY, lambda fault: fault.plain_lost),
            "<=",
            0,
        ),
    ]


def _to_stock(by: Mapping[tuple[str, str], Fault], situation: str) -> float | None:
    ours, stock = by.get((situation, OURS)), by.get((situation, STOCK))
    return ours.answered / stock.answered if ours and stock and stock.answered else None


def section(trials: Trials) -> str:
    """Return the section of the documentation's page."""
    faults = [Fault(**found) for found in trials.rows]
    order = list(SITUATIONS)
    faults.sort(key=lambda fault: order.index(fault.situation))
    return "\n".join(
        (
            "## Faults\n",
            f"`python -m benchmarks faults`. {_sentence(trials)}\n",
            f"{trials.conditions}\n",
            markdown_table(GOALS, [goal.row() for goal in goals(faults)]),
            markdown_table(heading, [row(fault) for fault in faults]),
        )
    )


def _sentence(trials: Trials) -> str:
    return (
        f"Lossy network: two network namespaces, UDP, {CALLERS} callers, {TIMEOUT:g} s for a call. "
        f"Server killed: SIGKILL with {CALLERS} calls out, a new server after {NEXT_SERVER:g} s. "
        f"In the rows below, a call has {LONG_TIMEOUT:g} s. Server restarted: SIGINT every "
        f"{RESTART_EVERY:g} s, and the next one starts as soon as it has ended; {MANY_CALLERS} "
        f"callers. Slow server: {SLOW_WORK:g} s for each request, {PLAIN} plain calls, and "
        f"{RETRIED} with `Retry(10, 0.2, 1)` beside them; {SLOW_ROUNDS} times. The server is "
        f"stock, and its callback sleeps for {1000 * WORK:g} ms elsewhere."
    )
