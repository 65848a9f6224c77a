"""``--help`` and its examples, what the command line imports, and the shell's completion."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys

import pytest

from tests.support.command import LAMP, LAMP_TYPE, LIMIT, rosasync
from tests.support.introspected import NAME, IntrospectedProcess
from tests.support.process import ROOT, ended

COMMANDS = [
    *("call", "list", "type", "find", "show", "info", "nodes"),
    *("serve", "watch", "bench", "ping", "why", "doctor", "profile", "run", "demo"),
]
GROUPS = ["action", "param", "lifecycle"]
"""The commands that have commands of their own, tested in test_cli_nodes.py."""

UNTIL_INTERRUPTED = {"serve", "watch", "demo --serve"}
"""The commands that run until Ctrl-C; they then say so."""


def examples_of(command: str) -> list[str]:
    done = rosasync(command, "--help", COLUMNS="200")
    assert (done.returncode, done.stderr) == (0, "")
    return re.findall(r"^\s+\$ (rosasync .*)$", done.stdout, re.MULTILINE)


def test_help_lists_every_command_without_rclpy() -> None:
    code = (
        "import sys; sys.argv[1:] = ['--help']; sys.modules['rclpy'] = None\n"
        "from rosasync._cli.app import main\n"
        "assert main() == 0\n"
        "assert not [name for name in sys.modules if name.startswith('rclpy.')]\n"
        "assert not [name for name in sys.modules if name.startswith('rich')]\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    listed = re.findall(r"^  (\w+)  +\S", done.stdout.partition("Commands:")[2], re.MULTILINE)
    assert listed == COMMANDS + GROUPS


def test_without_arguments_it_prints_the_help() -> None:
    assert rosasync().stdout == rosasync("--help").stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "advice"),
    [
        (("nonsense",), "--help"),
        (("call",), "--help"),
        (("list", "--nonsense"), "--help"),
        (("call", "/lamp/switch", "std_srvs/srv/SetBool", "data:", "true"), "needs quotes"),
        (("call", "/lamp/switch", "data:", "true"), "needs quotes"),
        (("action", "send", "/drive", "order:", "5"), "needs quotes"),
        (("action", "send", "/drive", "{order: 5}", "test_msgs/action/Fibonacci"), "comes last"),
        (("list", "data:"), "--help"),
    ],
)
def test_bad_usage_is_one_line_and_imports_no_rclpy(
    arguments: tuple[str, ...], advice: str
) -> None:
    code = (
        f"import sys; sys.argv[1:] = {arguments!r}; sys.modules['rclpy'] = None\n"
        "from rosasync._cli.app import main\n"
        "assert main() == 2\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.count("\n") == 1
    assert advice in done.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("lamp")
@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_of_the_help_work(command: str) -> None:
    examples = examples_of(command)
    assert len(examples) == 2
    if command == "run":
        # Its programs are the reader's; tests/test_cli_fresh.py runs others.
        return
    for example in examples:
        arguments = shlex.split(example)[1:]
        runs_on = command in UNTIL_INTERRUPTED or " ".join(arguments) in UNTIL_INTERRUPTED
        if not runs_on:
            done = rosasync(*arguments)
            # The example of `doctor` may find something on the machine that runs this.
            assert done.returncode == 0 or command == "doctor", (example, done.stderr)
            assert done.stdout
        else:
            assert run_until_it_serves(arguments) == 130, example


def run_until_it_serves(arguments: list[str]) -> int:
    process = subprocess.Popen(
        (sys.executable, "-m", "rosasync", *arguments),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    with ended(process):
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith(("serving", "watching")):
                process.send_signal(signal.SIGINT)
        return process.wait(LIMIT)


def complete(line: str) -> list[str]:
    # A shell must not hang, so it looks for services for a second only; a busy machine needs more.
    code = (
        "from rosasync._cli import completion\n"
        "from rosasync.__main__ import main\n"
        "completion.WAIT = 60.0\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={
            **os.environ,
            "_ROSASYNC_COMPLETE": "complete_bash",
            "COMP_WORDS": line,
            "COMP_CWORD": str(line.count(" ")),
        },
        check=False,
    )
    return done.stdout.split()


@pytest.mark.slow
def test_completes_commands_and_types() -> None:
    assert complete("rosasync wa") == ["watch"]
    assert LAMP_TYPE in complete("rosasync find std_srvs/")
    assert complete("rosasync show nothing_like_it") == []


@pytest.mark.slow
@pytest.mark.usefixtures("lamp")
def test_completes_names_of_services() -> None:
    assert LAMP in complete("rosasync call /lamp/sw")


@pytest.mark.slow
def test_a_watch_ends_after_a_count() -> None:
    with IntrospectedProcess() as watched:
        process = subprocess.Popen(
            (sys.executable, "-m", "rosasync", "watch", NAME, "--count", "2"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
        )
        with ended(process):
            assert process.stderr is not None
            assert process.stdout is not None
            for line in process.stderr:
                if line.startswith("watching"):
                    watched.call(False)
            lines = process.stdout.read().splitlines()
            assert process.wait(LIMIT) == 0
    assert [line.split()[1] for line in lines] == ["request_received", "response_sent"]
    assert lines[0].endswith('{"data": false}')
