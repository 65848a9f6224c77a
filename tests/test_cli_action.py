"""``rosasync action``: the graph, goals that are sent and cancelled, and the stub."""

from __future__ import annotations

import asyncio
import re
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.action_clients import ActionClientProcess, Ended
from tests.support.action_servers import ActionServerProcess, none_runs
from tests.support.command import DISCOVERY, LIMIT, json_lines, rosasync, terminal
from tests.support.process import ROOT, ended

pytestmark = pytest.mark.slow

FIBONACCI = "test_msgs/action/Fibonacci"
QUICK, SLOW = "/cli/quick", "/cli/slow"
SUCCEEDED, CANCELED, ABORTED = 4, 5, 6


@pytest.fixture(scope="module")
def quick() -> Iterator[None]:
    """A server of the action ``/cli/quick``, in another process."""
    options = ("--result", "{sequence: [0, 1]}", "--feedback", "sequence: [0]")
    with terminal("action", "serve", QUICK, FIBONACCI, *options, *options[2:]) as server:
        server.wait_for("Ctrl-C ends it")
        yield


@pytest.fixture(scope="module")
def slow() -> Iterator[None]:
    """A server of ``/cli/slow``, whose goals run until they are cancelled."""
    with terminal("action", "serve", SLOW, FIBONACCI, "--delay", "1000") as server:
        server.wait_for("Ctrl-C ends it")
        yield


def sent(name: str) -> AbstractContextManager[subprocess.Popen[str]]:
    """A command that sends a goal, which is ended with the block."""
    command = (sys.executable, "-m", "rosasync", "action", "send", name)
    pipe = subprocess.PIPE
    return ended(subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, cwd=ROOT))


def wait_for(process: subprocess.Popen[str], text: str) -> None:
    """Wait until the command has printed this to standard error."""
    assert process.stderr is not None
    while text not in (line := process.stderr.readline()):
        assert line, f"it ended without {text!r}"


@pytest.fixture
async def stock() -> Any:
    """A process of stock action clients."""
    async with ActionClientProcess() as child:
        yield child


@pytest.mark.usefixtures("quick")
class TestGraph:
    def test_list(self) -> None:
        command = ("action", "list", "--wait", DISCOVERY)
        assert QUICK in rosasync(*command).stdout.splitlines()
        assert f"{QUICK} [{FIBONACCI}]" in rosasync(*command, "-t").stdout
        listed = json_lines(rosasync(*command, "--json").stdout)
        assert {"name": QUICK, "types": [FIBONACCI]} in listed

    def test_type(self) -> None:
        done = rosasync("action", "type", QUICK)
        assert (done.returncode, done.stdout) == (0, f"{FIBONACCI}\n")
        done = rosasync("action", "type", QUICK, "--json")
        assert json_lines(done.stdout) == [{"name": QUICK, "types": [FIBONACCI]}]
        done = rosasync("action", "type", "/cli/none", "--timeout", "0.5")
        assert (done.returncode, done.stdout) == (3, "")
        assert "no server of this name within 0.5 s. Try: rosasync action list" in done.stderr
        done = rosasync("action", "type", f"{QUICK}_", "--timeout", DISCOVERY)
        assert f"; there are {QUICK} ({FIBONACCI}). Try: rosasync action list" in done.stderr

    def test_info(self) -> None:
        done = rosasync("action", "info", QUICK, "--wait", DISCOVERY)
        assert done.returncode == 0
        assert re.match(rf"{QUICK}\nservers: 1\n  /_rosasync_\d+ \[{FIBONACCI}\]\n", done.stdout)
        assert "clients: 0" in done.stdout
        command = ("action", "info", QUICK, "--wait", DISCOVERY, "--json")
        (server,) = json_lines(rosasync(*command).stdout)
        assert (server["role"], server["type"]) == ("server", FIBONACCI)
        done = rosasync("action", "info", f"{QUICK}_", "--wait", DISCOVERY)
        assert done.returncode == 3
        assert f"; there are {QUICK} ({FIBONACCI})" in done.stderr
        done = rosasync("info", QUICK, "--wait", DISCOVERY)
        assert f"{QUICK}: no server of this name; it is an action" in done.stderr


@pytest.mark.usefixtures("quick")
class TestSend:
    def test_the_result_as_yaml_and_json(self) -> None:
        done = rosasync("action", "send", QUICK, FIBONACCI, "{order: 2}")
        assert (done.returncode, yaml.safe_load(done.stdout)) == (0, {"sequence": [0, 1]})
        assert re.fullmatch(r"goal [-0-9a-f]{36} accepted\n", done.stderr)
        done = rosasync("action", "send", QUICK, "{order: 2}", "--json")
        (line,) = json_lines(done.stdout)
        assert uuid.UUID(line.pop("goal_id")).hex in done.stderr.replace("-", "")
        assert line == {"status": "SUCCEEDED", "result": {"sequence": [0, 1]}}

    def test_feedback(self) -> None:
        # It may be quicker than the middleware finds the subscription of a new client, so late.
        options = ("--delay", "0.5", "--feedback", "sequence: [0]", "--feedback", "sequence: [1]")
        with terminal("action", "serve", "/cli/late", FIBONACCI, *options) as server:
            server.wait_for("Ctrl-C ends it")
            done = rosasync("action", "send", "/cli/late", "--feedback")
            assert list(yaml.safe_load_all(done.stdout)) == [
                {"feedback": {"sequence": [0]}},
                {"feedback": {"sequence": [1]}},
                {"result": {"sequence": []}},
            ]
            done = rosasync("action", "send", "/cli/late", "--feedback", "--json")
            *feedback, end = json_lines(done.stdout)
            assert feedback == [{"feedback": {"sequence": [0]}}, {"feedback": {"sequence": [1]}}]
            assert (end["status"], end["result"]) == ("SUCCEEDED", {"sequence": []})
            # Without the option, only the result.
            done = rosasync("action", "send", "/cli/late")
            assert yaml.safe_load(done.stdout) == {"sequence": []}

    def test_a_template(self) -> None:
        done = rosasync("action", "send", QUICK, "--template")
        assert done.stdout == f"# {FIBONACCI}_Goal\norder: 0  # int32: goal definition\n"

    def test_bad_input(self) -> None:
        done = rosasync("action", "send", QUICK, FIBONACCI, "{ordre: 2}")
        assert (done.returncode, done.stdout) == (2, "")
        assert "ordre" in done.stderr
        done = rosasync("action", "send", QUICK, "test_msgs/action/Fibonaci")
        assert (done.returncode, done.stdout) == (2, "")
        assert "did you mean 'test_msgs/action/Fibonacci'" in done.stderr

    def test_no_server(self) -> None:
        for known in ((), (FIBONACCI,)):
            done = rosasync("action", "send", "/cli/none", *known, "--accept-timeout", "0.5")
            assert (done.returncode, done.stdout) == (3, "")
            assert done.stderr.count("\n") == 1
            assert "rosasync action" in done.stderr


def test_goals_that_are_rejected_and_aborted() -> None:
    with (
        terminal("action", "serve", "/cli/no", FIBONACCI, "--reject-rate", "1") as rejecting,
        terminal(
            *("action", "serve", "/cli/bad", FIBONACCI, "--abort-rate", "1"),
            *("--result", "{sequence: [7]}"),
        ) as aborting,
    ):
        rejecting.wait_for("Ctrl-C ends it")
        aborting.wait_for("Ctrl-C ends it")
        rejected = rosasync("action", "send", "/cli/no")
        assert (rejected.returncode, rejected.stdout) == (1, "")
        assert "reject" in rejected.stderr
        aborted = rosasync("action", "send", "/cli/bad", "--json")
        assert aborted.returncode == 1
        (line,) = json_lines(aborted.stdout)
        assert (line["status"], line["result"]) == ("ABORTED", {"sequence": [7]})
        rejecting.interrupt()
        assert rejecting.end() == 130
    assert "goals: 0 accepted, 1 rejected" in rejecting.screen


@pytest.mark.usefixtures("slow")
class TestCancelling:
    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    def test_a_signal_cancels_the_goal(self, number: signal.Signals) -> None:
        with sent(SLOW) as process:
            wait_for(process, "accepted")
            process.send_signal(number)
            output, errors = process.communicate(timeout=LIMIT)
        assert (process.returncode, output) == (128 + number, "")
        assert "the goal has ended: CANCELED" in errors
        assert "Traceback" not in errors

    def test_a_signal_while_the_server_refuses(self, action_server: ActionServerProcess) -> None:
        action_server.serve_now("/cli/stubborn", hold=True, cancel=False)
        with terminal("action", "send", "/cli/stubborn") as sending:
            sending.wait_for("accepted")
            sending.interrupt()
            assert sending.end() == 130
        assert "the server refuses to cancel the goal, which runs on" in sending.screen
        assert "Traceback" not in sending.screen

    def test_a_signal_before_the_acceptance(self, action_server: ActionServerProcess) -> None:
        action_server.serve_now("/cli/late", hold=True, idle=True, accept_later=True)
        with sent("/cli/late") as process:
            asyncio.run(action_server.asked("/cli/late"))
            process.send_signal(signal.SIGINT)
            wait_for(process, "interrupted before the goal was accepted")
            asyncio.run(action_server.accept("/cli/late"))
            output, errors = process.communicate(timeout=LIMIT)
        assert (process.returncode, output) == (130, "")
        assert "Traceback" not in errors
        asyncio.run(none_runs(action_server, "/cli/late"))

    def test_the_server_vanishes_with_the_goal(self, action_server: ActionServerProcess) -> None:
        action_server.serve_now("/cli/mortal", hold=True)
        with sent("/cli/mortal") as process:
            wait_for(process, "accepted")
            asyncio.run(action_server.stop("/cli/mortal"))
            output, errors = process.communicate(timeout=LIMIT)
        assert (process.returncode, output) == (5, "")
        assert "every server vanished before the goal ended" in errors

    def test_the_deadline_cancels_the_goal(self) -> None:
        done = rosasync("action", "send", SLOW, FIBONACCI, "--timeout", DISCOVERY)
        assert (done.returncode, done.stdout) == (4, "")
        assert f"has not ended within {DISCOVERY} s" in done.stderr
        assert "the goal has ended: CANCELED" in done.stderr

    async def test_by_id_and_all(self, stock: ActionClientProcess) -> None:
        first, second = await stock.send(SLOW), await stock.send(SLOW)
        assert first is not None
        assert second is not None
        done = rosasync("action", "cancel", SLOW, "--id", first)
        assert (done.returncode, done.stdout) == (0, f"{uuid.UUID(first)}\n")
        assert await stock.ended(first) == Ended(CANCELED, [])
        again = rosasync("action", "cancel", SLOW, "--id", first)
        assert again.returncode == 1
        assert "has ended" in again.stderr
        done = rosasync("action", "cancel", SLOW, "--all", "--json")
        assert json_lines(done.stdout) == [{"goal_id": str(uuid.UUID(second))}]
        assert await stock.ended(second) == Ended(CANCELED, [])
        nothing = rosasync("action", "cancel", SLOW, "--all")
        assert (nothing.returncode, nothing.stdout) == (0, "")
        assert "no goal to cancel" in nothing.stderr
        unknown = rosasync("action", "cancel", SLOW, "--id", uuid.uuid4().hex)
        assert unknown.returncode == 1
        assert "knows no goal" in unknown.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--all", "--id", uuid.uuid4().hex),
        ("--id", "nonsense"),
        # It would cancel all.
        ("--id", "0" * 32),
    ],
)
def test_what_to_cancel_has_to_be_said(arguments: tuple[str, ...]) -> None:
    done = rosasync("action", "cancel", SLOW, *arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--id" in done.stderr


def test_a_bad_name_is_one_of_an_action() -> None:
    done = rosasync("action", "type", "/a b")
    assert (done.returncode, done.stdout) == (2, "")
    assert "'/a b' is not a valid action name" in done.stderr


def test_no_server_to_cancel_at() -> None:
    done = rosasync("action", "cancel", "/cli/none", "--all", "--timeout", "0.5")
    assert done.returncode == 3


class TestServe:
    async def test_a_stub_for_a_stock_client(self, stock: ActionClientProcess) -> None:
        options = ("--result", "sequence: [3]", "--json")
        with terminal("action", "serve", "/cli/stub", FIBONACCI, *options) as server:
            server.wait_for("Ctrl-C ends it")
            goal = await stock.send("/cli/stub", 8)
            assert goal is not None
            assert await stock.ended(goal) == Ended(SUCCEEDED, [3])
            server.wait_for('"status": "SUCCEEDED"')
            server.interrupt()
            assert server.end() == 130
        assert '"goal": {"order": 8}' in server.screen.replace("\n", "")
        assert "1 accepted, 0 rejected; 1 succeeded, 0 canceled, 0 aborted" in server.screen

    async def test_the_end_reaches_the_client(self, stock: ActionClientProcess) -> None:
        with terminal("action", "serve", "/cli/end", FIBONACCI, "--delay", "100") as server:
            server.wait_for("Ctrl-C ends it")
            goal = await stock.send("/cli/end", 8)
            assert goal is not None
            server.wait_for("order: 8")
            server.interrupt()
            assert server.end() == 130
        assert await stock.ended(goal) == Ended(CANCELED, [])

    async def test_a_handler(self, stock: ActionClientProcess, tmp_path: Path) -> None:
        (tmp_path / "driving.py").write_text(
            "async def drive(goal):\n    return {'sequence': [goal.request.order]}\n"
        )
        command = ("action", "serve", "/cli/handler", FIBONACCI, "--handler", "driving:drive")
        with terminal(*command, PYTHONPATH=str(tmp_path)) as server:
            server.wait_for("Ctrl-C ends it")
            goal = await stock.send("/cli/handler", 8)
            assert goal is not None
            assert await stock.ended(goal) == Ended(SUCCEEDED, [8])

    @pytest.mark.parametrize(
        ("options", "text"),
        [
            (("--on-busy", "wait"), "'queue', 'reject' or 'replace'"),
            (("--handler", "nonsense:drive"), "Expected MODULE:FUNCTION"),
            # It would print a poem.
            (("--handler", "this"), "Expected MODULE:FUNCTION"),
            (("--handler", "os.path:join"), "must be async"),
            (("--handler", "os.path:join", "--delay", "1"), "leave out the options of the stub"),
            (("--result", "{sequenze: []}"), "sequenze"),
        ],
    )
    def test_bad_options(self, options: tuple[str, ...], text: str) -> None:
        done = rosasync("action", "serve", "/cli/bad", FIBONACCI, *options)
        assert (done.returncode, done.stdout) == (2, "")
        assert text in done.stderr
