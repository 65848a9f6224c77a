"""The benchmarks' ratios, verdicts, tables and report, from given measurements."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from benchmarks import (
    actions,
    callers,
    cold,
    commands,
    crash,
    faults,
    goodput,
    overload,
    pages,
    profile,
    sharing,
    status,
    topics,
)
from benchmarks.contestants import CONTESTANTS, make_contestant
from benchmarks.contestants.base import LoggedCall
from benchmarks.meter import Usage
from benchmarks.names import check_names
from benchmarks.report import write_report
from benchmarks.results import Results, Turn
from benchmarks.runner import Scenario
from benchmarks.suites import SUITES, make_suite
from benchmarks.tables import rows
from benchmarks.targets import PEERS, TARGETS, judge
from benchmarks.trials import Trials
from tests.support import hosts, process
from tests.support.child import ROOT

MACHINE = {"cpu": "a CPU", "cores": 2, "load": 0.0, "kernel": "6", "python": "3", "middleware": "m"}
SETTINGS = {"rounds": 2, "quick": True, "pin": False}


def results_of(scenario: Scenario, times: dict[str, list[int]], **options: Any) -> Results:
    """Return results of one scenario: each contestant's samples in µs, the same in two rounds."""
    results = Results(SETTINGS, machine={**MACHINE, "versions": {"rclpy": "7"}})
    results.scenarios[scenario.key] = scenario.to_json()
    for contestant, samples in times.items():
        for number in range(2):
            taken = [us * 1000 for us in samples]
            results.turns.append(
                Turn(
                    scenario.key,
                    contestant,
                    number,
                    "ok",
                    samples=taken,
                    elapsed=sum(taken),
                    client=Usage(cpu=100),
                    **options,
                )
            )
    return results


def suites() -> dict[str, Scenario]:
    return {scenario.key: scenario for name in SUITES for scenario in make_suite(name)}


@pytest.mark.parametrize("key", CONTESTANTS)
def test_every_contestant_can_be_made(key: str) -> None:
    assert make_contestant(key)


def test_a_suite_measures_both_sides_of_every_target() -> None:
    found = suites()
    for target in TARGETS:
        for scenario, contestant in target.sides:
            wanted = PEERS.get(contestant, (contestant,))
            assert set(wanted) & set(found[scenario].contestants), (target.name, scenario)


def test_a_suite_can_be_narrowed_and_shortened() -> None:
    full, quick = make_suite("throughput"), make_suite("throughput", quick=True)
    assert all(short.seconds < long.seconds for short, long in zip(quick, full, strict=True))
    chosen = make_suite("throughput", contestants=["direct"])
    assert {scenario.contestants for scenario in chosen} == {("direct",)}
    with pytest.raises(ValueError, match="no contestant dirct"):
        make_suite("throughput", contestants=["dirct"])


def test_a_verdict_names_the_peer_that_was_best() -> None:
    one = suites()["one at a time"]
    results = results_of(one, {"direct": [50], "call": [120], "pool": [100], "polled": [60]})
    (verdict,) = [v for v in judge(results) if "does not burn a core" in v.name]
    assert verdict.met
    assert verdict.text == "0.5, 0.50 to 0.50 in 2; pool"


def test_what_was_not_measured_is_not_met() -> None:
    one = suites()["one at a time"]
    verdicts = list(judge(results_of(one, {"direct": [50]})))
    assert verdicts
    assert all(v.met is None and "not in this run" in v.text for v in verdicts)


def test_one_lost_call_in_any_round_is_seen() -> None:
    many = suites()["512 callers"]
    results = results_of(many, {"direct": [50] * 99})
    (good,) = [v for v in judge(results) if "lost" in v.name]
    results.turns.append(Turn(many.key, "direct", 2, "ok", samples=[50_000] * 99, lost=1))
    (bad,) = [v for v in judge(results) if "lost" in v.name]
    assert (good.met, bad.met) == (True, False)
    assert bad.row()[1].startswith("missed: 1")
    assert "lost 1 of 298" in rows(results, many.key)[1][0][-1]


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    results = results_of(suites()["flood"], {"direct": [1, 2]}, server=Usage(cpu=7), lost=3)
    results.skipped["another host"] = "no root"
    results.scenarios = json.loads(json.dumps(results.scenarios))
    results.save(tmp_path / "deep" / "results.json")
    again = Results.read([tmp_path / "deep" / "results.json"])
    assert (again.turns, again.scenarios) == (results.turns, results.scenarios)
    assert (again.machine, again.settings) == (results.machine, SETTINGS)
    assert again.skipped == {"another host": "no root"}


def test_a_file_of_the_former_format_of_suites_is_read(tmp_path: Path) -> None:
    results = results_of(suites()["one at a time"], {"direct": [5, 6]})
    former = {
        "format": 1,
        "machine": results.machine,
        "settings": SETTINGS,
        "scenarios": json.loads(json.dumps(results.scenarios)),
        "turns": [turn.to_json() for turn in results.turns],
        "skipped": {},
        "allocations": [{"clients": {"direct": {"peak": 700.0, "growth": -0.5}}}],
    }
    (tmp_path / "former.json").write_text(json.dumps(former))
    again = Results.read([tmp_path / "former.json"])
    assert again.turns[:-1] == results.turns
    assert rows(again, "allocations, clients")[1][0][:3] == ["direct", "700", "-0.50"]


def test_a_report_is_of_suites_only(tmp_path: Path) -> None:
    file = tmp_path / "cold.json"
    Trials("cold", {}, MACHINE).save(file)
    with pytest.raises(ValueError, match="use `publish`"):
        Results.read([file])


@pytest.mark.slow
def test_the_report_shows_also_what_hung_was_lost_or_skipped(tmp_path: Path) -> None:
    flood, idle, other = (suites()[key] for key in ("flood", "idle, 50 clients", "another host"))
    results = results_of(flood, {"direct-retry": list(range(1, 100)), "spin-until": []}, lost=5)
    results.scenarios[idle.key] = idle.to_json()
    results.turns.append(Turn(idle.key, "direct", 0, "ok", elapsed=10**9, client=Usage(10**6)))
    results.turns.append(Turn(idle.key, "executor", 0, "hung", error="no answer"))
    results.scenarios[other.key] = other.to_json()
    results.skipped[other.key] = "network namespaces need root"
    page = write_report(results, tmp_path).read_text()
    assert "Skipped: network namespaces need root." in page
    assert "hung 1 of 1 rounds; no answer" in page
    assert "lost 10 of 10" in page
    pictures = {path.name for path in (tmp_path / "benchmarks").iterdir()}
    assert pictures == {"flood.svg", "idle-50-clients.svg"}
    assert all(f"benchmarks/{name}" in page for name in pictures)


def test_no_hosts_without_the_tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(hosts.NoHosts, match="iproute2"), hosts.Hosts():
        pass


def test_a_page_is_updated_between_its_marks() -> None:
    stage = profile.Stage("rosasync", "does something")
    found = profile.Profile({stage: 1.5}, stamped=3.0, plain=2.5, calls=1000, off_path=1)
    page = "before\n<!-- profile -->\nold\n<!-- /profile -->\nafter\n"
    new = profile.updated(page, found, MACHINE)
    assert new.startswith("before\n<!-- profile -->\n")
    assert new.endswith("<!-- /profile -->\nafter\n")
    assert "| does something | rosasync | 1.5 |" in new
    assert "old" not in new
    assert profile.updated(new, found, MACHINE) == new
    with pytest.raises(ValueError, match="has no"):
        profile.updated("a page", found, MACHINE)


def cell(contestant: str, answers: list[int], **options: Any) -> sharing.Cell:
    """Return a cell of the command `sharing`: by default one of 1 ms of work, and nothing lost."""
    options = {"work": 1.0, "flooded": False, "seconds": 1.0, "lost": 0, "failed": 0, **options}
    return sharing.Cell(contestant, len(answers), answers=answers, median=1.0, p99=2.0, **options)


def test_jains_index() -> None:
    assert sharing.jain([7, 7, 7]) == 1.0
    assert sharing.jain([5, 0, 0, 0]) == 0.25
    assert sharing.jain([0, 0]) == 0.0


def test_the_cells_of_a_command_are_checked(tmp_path: Path) -> None:
    found = sharing.plans(["direct", "call"], [1, 4], [0.0, 5.0], mixed=True)
    assert len(found) == 9
    assert [plan.contestant for plan in found if plan.flooded] == ["direct"]
    with pytest.raises(ValueError, match="no contestant dirct"):
        sharing.plans(["dirct"], [1], [1.0], mixed=False)
    with pytest.raises(ValueError, match="needs --before"):
        sharing.plans(["before"], [1], [1.0], mixed=False)
    with pytest.raises(ValueError, match="no negative work"):
        sharing.plans(["direct"], [0], [1.0], mixed=False)
    with pytest.raises(ValueError, match="no situation flood"):
        faults.plans(["flood"], ["direct"])
    with pytest.raises(ValueError, match="need --before"):
        faults.plans([faults.SLOW], ["before"])
    assert faults.plans([faults.SLOW], ["before"], tmp_path) == [(faults.SLOW, "before")]
    with pytest.raises(ValueError, match="no program stock"):
        check_names("program", ["stock"], cold.PROGRAMS)
    with pytest.raises(ValueError, match="no contestant rclpy; there are stock, "):
        crash.check_contestants(["stock", "rclpy"], None)
    with pytest.raises(ValueError, match="no place Mars; there are LOCALHOST, "):
        check_names("place", ["SUBNET", "Mars"], crash.PLACES)


def test_the_goals_of_sharing() -> None:
    cells = [
        cell("direct", [90, 90]),
        cell("semaphore", [100, 100]),
        cell("call", [500, 500], lost=1),
        cell("direct", [100]),
        cell("before", [200], seconds=2.0),
        cell("direct-retry", [5] * 16, lost=2),
    ]
    outcomes = {goal.name.rpartition(" ")[0]: goal for goal in sharing.goals(cells)}
    assert [(name.split(",")[0], goal.met, goal.text) for name, goal in outcomes.items()] == [
        ("calls lost", True, "0"),
        ("Jain's index", True, "1"),
        ("answers/s in all", False, "0.9"),
        ("one process", True, "1"),
        ("calls lost with Retry", False, "2"),
        ("calls lost with Retry", None, ""),
    ]


def test_labels_are_spread() -> None:
    assert sharing.spread([0.5, 0.0, 0.0], 0.1) == pytest.approx([0.5, 0.0, 0.1])
    assert sharing.spread([0.5, 0.5], 0.1) == pytest.approx([0.45, 0.55])
    assert sharing.spread([], 0.1) == []


def test_unanswered_calls_end_late_after_their_restart() -> None:
    calls = [
        LoggedCall(1.0, 2.2, "ServerGone"),  # out at the restart
        LoggedCall(2.5, 3.0, "ServerGone"),  # begun after it
        LoggedCall(1.0, 9.0, "ResponseTimeout"),
        LoggedCall(0.0, 1.0, "ResponseTimeout"),  # before any
        LoggedCall(1.0, 2.0, "answered"),
    ]
    assert faults.late_calls(calls, [2.0, 4.0]) == pytest.approx([0.2, 1.0, 7.0, 1.0])


def test_the_goals_of_faults() -> None:
    found = [
        faults.Fault(faults.LOSS, "direct", 10, 1.0, {"answered": 30}),
        faults.Fault(faults.LOSS, "call-async", 10, 1.0, {"answered": 20, "TimeoutError": 3}),
        faults.Fault(faults.KILLED, "direct", 10, 1.0, {"QueueTimeout": 2}, first_answer=1.5),
        faults.Fault(faults.RESTARTED, "direct", 50, 1.0, {"ServerGone": 2}, 1, late=0),
        faults.Fault(faults.SLOW, "direct-retry", 10, 1.0, {"answered": 8}, plain_lost=2),
    ]
    met = [goal.met for goal in faults.goals(found)]
    assert met == [True, None, False, True, None, False]
    assert "next answer after 1.5 s" in faults.row(found[2])[-1]


def figure(what: str, client: str, value: float | None, server: str = "stock") -> actions.Figure:
    """Return a figure of the command `actions`."""
    return actions.Figure(what, client, server, value, "" if value else "never ended")


def test_the_goals_of_actions() -> None:
    found = [
        figure(actions.ONE, "rosasync", 3.0),
        figure(actions.ONE, "stock", 6.0),
        figure(actions.TEN, "rosasync", 200.0),
        figure(actions.TEN, "rosasync", 400.0, "rosasync"),
        figure(actions.TEN, "stock", 200.0),
        figure(actions.FIFTY, "rosasync", 200.0),
        figure(actions.FIFTY, "stock", None),
    ]
    met = {goal.name: goal.met for goal in actions.goals(found)}
    assert met["goal to result, ms: ours / rclpy's, server of stock <= 0.9"] is True
    assert met["10 at once, goals/s: ours / rclpy's, server of stock >= 1.3"] is False
    assert met["10 at once, goals/s: our server / rclpy's, our client >= 1.5"] is True
    assert met["50 at once, goals/s: ours / rclpy's, server of stock >= 1.3"] is None
    assert actions.row(found[-1])[3] == "never ended"


@pytest.mark.slow
def test_actions_are_measured() -> None:
    found = actions.measure(1, 0.02)
    assert len(found) == actions.total(1)
    assert all(figure.value is not None for figure in found if figure.client == "rosasync")


def test_trials_are_published_between_their_marks(tmp_path: Path) -> None:
    machine = {**MACHINE, "versions": {"rclpy": "7"}}
    starts = [cold.Start("rosasync script", 0.5), cold.Start("rosasync script", None)]
    restarts = [crash.Restart("client", "stock", seconds) for seconds in (2.5, None)]
    restarts.append(crash.Restart("server", "stock", 0.5, "SUBNET"))
    kinds: list[tuple[str, list[Any]]] = [
        ("sharing", [cell("direct", [5]), cell("direct", [5, 4])]),
        ("faults", [faults.Fault(faults.SLOW, "direct", 8, 1.0, {"answered": 24}, plain_lost=0)]),
        ("cold", starts),
        ("crash", restarts),
        ("actions", [figure(actions.ONE, "rosasync", 3.0), figure(actions.ONE, "stock", 6.0)]),
    ]
    files: list[Path] = []
    for command, rows_of in kinds:
        trials = Trials(command, {"callers": 16, "seconds": 1.0, "processes": 2}, machine)
        trials.rows = [dataclasses.asdict(row) for row in rows_of]
        files.append(tmp_path / f"{command}.json")
        trials.save(files[-1])
    (again,) = Trials.load(files[-1:] * 2)
    assert len(again.rows) == 4
    page = tmp_path / "benchmarks.md"
    marks = [f"<!-- {command} -->\nformer\n<!-- /{command} -->\n" for command, _ in kinds]
    page.write_text("".join(("# Title\n", *marks)))
    commands.publish(files, tmp_path)
    text = page.read_text()
    assert "former" not in text
    assert "| rosasync script | 2 | 0.50 | 0.50 | 0.50 | 1 |" in text
    assert "| rosasync | 2 | 1 | 0 | 0.00 | 9.00 | 4 | 0.99 | 1.00 | 2.00 |  |" in text
    written = {path.name for path in (tmp_path / "benchmarks").iterdir()}
    assert "| stock | client | 2 | 2.50 | 2.50 | 1 | 1 |" in text
    assert "| stock | server, SUBNET | 1 | 0.50 | 0.50 | 0 | 0 |" in text
    assert written == {"sharing.svg", "cold.svg"}
    assert "| goal to result, ms | stock | 3 | 6 | 0.5 |" in text
    assert len(pages.marked_sections(text)) == 5
    page.write_text("{}")
    with pytest.raises(ValueError, match="not the trials"):
        Trials.load([page])


def test_a_report_keeps_the_marked_sections(tmp_path: Path) -> None:
    page = tmp_path / "benchmarks.md"
    page.write_text("former\n<!-- cold -->\nkept\n<!-- /cold -->\n")
    write_report(results_of(suites()["one at a time"], {"direct": [5]}), tmp_path)
    assert "<!-- cold -->\nkept\n<!-- /cold -->\n" in page.read_text()
    assert "former" not in page.read_text()


@pytest.mark.slow
def test_a_report_opens_with_its_conclusions(tmp_path: Path) -> None:
    one = suites()["one at a time"]
    page = write_report(results_of(one, {"direct": [50], "call": [200]}), tmp_path).read_text()
    said = "- With a stock server, one at a time, median µs: 50 on asyncio; `client.call` 200."
    assert page.startswith(f"# Benchmarks\n\n{said}\n")
    assert page.index("diagrams/benchmark.svg") < page.index("## Method") < page.index("## Machine")
    assert (tmp_path / "diagrams" / "benchmark.svg").exists()


SMALL_RUNS = {
    "sharing": ("--contestants=direct,semaphore", "--processes=2", "--work=1", "--seconds=1"),
    "faults": ("--situations=slow server", "--contestants=direct-retry"),
    "cold": ("--processes=1",),
    "crash": (
        *("--after-crash", "--processes=1", "--programs=rosasync"),
        "--places=LOCALHOST,SUBNET",
    ),
}


@pytest.mark.slow
def test_the_window_is_drawn(tmp_path: Path) -> None:
    plot = tmp_path / "window.svg"
    command = ("window", "--seconds=0.3", f"--plot={plot}")
    subprocess.run([sys.executable, "-m", "benchmarks", *command], cwd=ROOT, check=True)
    assert "server killed" in plot.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("command", SMALL_RUNS)
def test_a_small_run(command: str, tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    with ExitStack() as stack:
        # A long lease, except where the end of a lease is measured.
        variables = {} if command == "crash" else stack.enter_context(process.profile())
        subprocess.run(
            [
                *(sys.executable, "-m", "benchmarks", "cold" if command == "crash" else command),
                *(*SMALL_RUNS[command], f"--json={file}"),
            ],
            cwd=ROOT,
            env=os.environ | variables,
            check=True,
            stdout=subprocess.DEVNULL,
        )
    (trials,) = Trials.load([file])
    assert trials.command == command
    if command == "sharing":
        cells = [sharing.Cell(**row) for row in trials.rows]
        assert [c.contestant for c in cells] == ["direct", "direct", "semaphore"]
        assert all(len(c.answers) == 2 and c.total for c in cells)
    elif command == "faults":
        assert faults.Fault(**trials.rows[0]).answered
    else:
        assert all(row["seconds"] for row in trials.rows)
    if command == "crash":
        assert {row["place"] for row in trials.rows} == {"LOCALHOST", "SUBNET"}
        assert {row["side"] for row in trials.rows} == {*crash.SIDES}


def overload_cell(
    kind: str, client: str, server: str, load: float, **options: Any
) -> overload.Cell:
    """Return a cell of the command `overload`: 4 s of a server that can do 100/s."""
    return overload.Cell(
        *(kind, client, server, 10.0, False, load, "0.5", 1),
        **{
            "seconds": 4.0,
            "capacity": 100.0,
            "sent": round(400 * load),
            "answered": 400,
            "within": options.get("answered", 400),
            "served": 400,
            "median": 20.0,
            "p99": 30.0,
            **options,
        },
    )


def test_the_plans_of_overload() -> None:
    arguments: dict[str, Any] = {
        "clients": ["stock", "rosasync"],
        "servers": ["stock", "rosasync"],
        "loads": [0.5, 4.0],
        "works": [10.0],
        "spread": ["constant"],
        "timeouts": ["0.5"],
        "processes": [1],
        "kept": [50],
        "polite": True,
        "recovery": True,
    }
    found = overload.plans(**arguments)
    kinds = [plan.kind for plan in found]
    assert [kinds.count(kind) for kind in ("offered", "kept", "recovery", "polite")] == [8, 4, 4, 2]
    for name, wrong in (("clients", "stok"), ("servers", "lean"), ("timeouts", "3")):
        with pytest.raises(ValueError, match=f"no .* {wrong}"):
            overload.plans(**{**arguments, name: [wrong]})
    with pytest.raises(ValueError, match="positive"):
        overload.plans(**{**arguments, "loads": [0.0]})


def test_the_goals_of_overload() -> None:
    cells = [
        overload_cell("offered", "stock", "stock", 4.0, answered=380),
        overload_cell("offered", "stock", "rosasync", 4.0, answered=390, served=400),
        overload_cell("offered", "rosasync", "stock", 4.0, answered=300),
        overload_cell("offered", "rosasync", "rosasync", 0.9, sent=360, answered=360),
        overload_cell("polite", "stock", "rosasync", 500, sent=20, answered=20, median=30.0),
        overload_cell("recovery", "stock", "rosasync", 4.0, sent=80, answered=79),
    ]
    assert (cells[1].goodput, cells[1].wanted) == (0.975, 0.975)
    assert cells[1].waste == 0.025
    assert (cells[3].goodput, cells[3].wanted) == (0.9, 1.0)
    met = [goal.met for goal in overload.goals(cells)]
    assert met == [False, False, True, None, True, True, True, True]
    assert overload.row(cells[2])[7:9] == ["0.75", "0.75"]


def test_what_comes_after_an_overload_does_not_count() -> None:
    plan = overload.Plan("offered", "rosasync", "stock", 10.0, False, 4.0, "2")
    ended = {"outcomes": {"answered": 3, "QueueTimeout": 1}}
    calls = [(0.0, 0.02), (3.5, 0.1), (3.5, 1.5), (3.6, None)]
    cell = overload.summarize(plan, 1.0, 4.0, 3, [{**ended, "calls": calls}])
    assert (cell.sent, cell.answered, cell.within) == (4, 3, 2)
    assert cell.goodput == 0.5
    assert cell.waste == pytest.approx(1 / 3)

    recovery = dataclasses.replace(plan, kind="recovery")
    cell = overload.summarize(recovery, 1.0, 3.5, 3, [{**ended, "calls": calls}])
    assert (cell.seconds, cell.sent, cell.answered) == (1.0, 3, 2)


def test_the_arrivals_of_overload() -> None:
    times = list(callers.arrivals([(100.0, 10.0), (10.0, 10.0)], seed=1))
    assert times == sorted(times)
    assert sum(at < 10.0 for at in times) == pytest.approx(1000, rel=0.1)
    assert sum(at >= 10.0 for at in times) == pytest.approx(100, rel=0.3)


def test_the_section_of_overload(tmp_path: Path) -> None:
    cells = [overload_cell("offered", "stock", "stock", load) for load in (0.5, 4.0)]
    trials = Trials("overload", {"seconds": 4.0}, {**MACHINE, "versions": {}}, "2026-11-30")
    trials.rows = [dataclasses.asdict(cell) for cell in cells]
    text = commands.section(trials, tmp_path)
    assert "](../benchmarks/overload.svg)" in text
    assert (tmp_path / "benchmarks" / "overload.svg").exists()
    assert "| stock → stock |" in text


@pytest.mark.slow
def test_a_small_run_of_overload() -> None:
    chosen = overload.plans(
        clients=["stock", "rosasync", "afor"],
        servers=["rosasync", "rosasync-async"],
        loads=[2.0],
        works=[10.0],
        spread=["exponential"],
        timeouts=["mixed"],
        processes=[2],
        kept=[],
        polite=False,
        recovery=True,
    )
    cells = overload.measure(chosen, 1.0)
    assert [cell.kind for cell in cells].count("offered") == 6
    assert all(cell.sent for cell in cells)


def test_the_section_of_goodput(tmp_path: Path) -> None:
    cells = [
        overload_cell("offered", *pair, 2.0, answered=380 if "status" in pair[1] else 40)
        for pair in goodput.PAIRS
    ]
    assert [goal.met for goal in goodput.goals(cells)] == [True]
    trials = Trials("goodput", {"seconds": 4.0}, {**MACHINE, "versions": {}}, "2026-11-30")
    trials.rows = [dataclasses.asdict(cell) for cell in cells]
    text = commands.section(trials, tmp_path)
    assert "](../benchmarks/goodput.svg)" in text
    assert (tmp_path / "benchmarks" / "goodput.svg").exists()
    assert "| rosasync without status | 2 | 800 | 40 | 0.10 |" in text


def test_the_section_of_status(tmp_path: Path) -> None:
    trials = Trials("status", {"calls": 2}, {**MACHINE, "versions": {}}, "2026-11-30")
    found = [status.Times("failed", [0.002, 0.004]), status.Times("answered", [0.001, 0.002])]
    trials.rows = [dataclasses.asdict(times) for times in found]
    text = commands.section(trials, tmp_path)
    assert "| failed | 2 | 3.000 | 4.000 | 2.00 |" in text
    assert "met: 0.003" in text


@pytest.mark.slow
def test_a_small_run_of_goodput() -> None:
    cells = goodput.measure(goodput.plans([0.5]), 1.0)
    assert [(cell.client, cell.server) for cell in cells] == list(goodput.PAIRS)
    assert all(cell.sent for cell in cells)


@pytest.mark.slow
def test_the_topics_of_status_are_matched() -> None:
    assert [found["endpoints"] for found in topics.measure(3)] == [6, 6]


@pytest.mark.slow
def test_a_small_run_of_status() -> None:
    found = status.measure(10)
    assert [(times.kind, len(times.seconds)) for times in found] == [
        ("failed", 10),
        ("answered", 10),
    ]
    assert all(seconds > 0 for times in found for seconds in times.seconds)
    assert [row[0] for row in status.rows(found)] == ["failed", "answered"]
