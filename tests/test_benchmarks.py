"""The benchmarks' ratios, verdicts, tables and report, from given measurements."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import hosts, profile
from benchmarks.contestants import CONTESTANTS, make_contestant
from benchmarks.meter import Usage
from benchmarks.report import write_report
from benchmarks.results import Results, Turn
from benchmarks.runner import Scenario
from benchmarks.suites import SUITES, make_suite
from benchmarks.tables import rows
from benchmarks.targets import PEERS, TARGETS, judge

MACHINE = {"cpu": "a CPU", "cores": 2, "load": 0.0, "kernel": "6", "python": "3", "middleware": "m"}
SETTINGS = {"rounds": 2, "quick": True, "pin": False}


def results_of(scenario: Scenario, times: dict[str, list[int]], **options: Any) -> Results:
    """Return results of one scenario: each contestant's samples in µs, the same in two rounds."""
    results = Results({**MACHINE, "versions": {"rclpy": "7"}}, SETTINGS)
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
    (verdict,) = [v for v in judge(results) if "does not burn a core" in v.target.name]
    assert verdict.met
    assert verdict.text == "met: 0.50, 0.50 to 0.50 in 2; pool"


def test_what_was_not_measured_is_not_met() -> None:
    one = suites()["one at a time"]
    verdicts = list(judge(results_of(one, {"direct": [50]})))
    assert verdicts
    assert all(v.met is None and "not in this run" in v.text for v in verdicts)


def test_one_lost_call_in_any_round_is_seen() -> None:
    many = suites()["512 callers"]
    results = results_of(many, {"direct": [50] * 99})
    (good,) = [v for v in judge(results) if "lost" in v.target.name]
    results.turns.append(Turn(many.key, "direct", 2, "ok", samples=[50_000] * 99, lost=1))
    (bad,) = [v for v in judge(results) if "lost" in v.target.name]
    assert (good.met, bad.met) == (True, False)
    assert bad.text.startswith("missed: 1.00 > 0.00")
    assert "lost 1 of 298" in rows(results, many.key)[1][0][-1]


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    results = results_of(suites()["flood"], {"direct": [1, 2]}, server=Usage(cpu=7), lost=3)
    results.skipped["another host"] = "no root"
    results.scenarios = json.loads(json.dumps(results.scenarios))
    results.save(tmp_path / "deep" / "results.json")
    assert Results.load([tmp_path / "deep" / "results.json"]) == results


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
