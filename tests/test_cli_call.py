"""``rosasync call`` against stock servers: input, output, exit codes, Ctrl-C."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support.command import DISCOVERY, LAMP, LAMP_TYPE, json_lines, rosasync, terminal
from tests.support.process import ROOT, ended, own
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT

pytestmark = pytest.mark.usefixtures("lamp")

ON = "{data: true}"
TEXT, TEXT_TYPE = "/lamp/text", "diagnostic_msgs/srv/AddDiagnostics"


def test_prints_the_response_as_yaml() -> None:
    done = rosasync("call", LAMP, LAMP_TYPE, ON)
    assert (done.returncode, done.stderr) == (0, "")
    assert yaml.safe_load(done.stdout) == {"success": True, "message": "True"}


def test_infers_the_type_and_prints_json() -> None:
    done = rosasync("call", LAMP, ON, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json_lines(done.stdout) == [{"success": True, "message": "True"}]


@pytest.mark.slow
def test_without_a_request_it_sends_the_defaults() -> None:
    done = rosasync("call", LAMP, "--field", "message")
    assert (done.returncode, done.stdout) == (0, "False\n")


@pytest.mark.slow
def test_a_plain_text_is_sent_as_it_is_written() -> None:
    done = rosasync("call", TEXT, TEXT_TYPE, "load_namespace: on", "--field", "message")
    assert (done.returncode, done.stdout) == (0, "on\n")


@pytest.mark.slow
def test_several_documents_of_a_file_and_of_standard_input(tmp_path: Path) -> None:
    file = tmp_path / "requests.yaml"
    file.write_text("data: true\n---\ndata: false\n")
    from_file = rosasync("call", LAMP, f"@{file}", "--field", "message")
    assert (from_file.returncode, from_file.stdout) == (0, "True\nFalse\n")
    done = rosasync("call", LAMP, LAMP_TYPE, "-", stdin=file.read_text())
    assert done.returncode == 0
    responses = list(yaml.safe_load_all(done.stdout))
    assert [response["message"] for response in responses] == ["True", "False"]
    assert "2 answered, 0 failed" in done.stderr


@pytest.mark.slow
def test_answers_each_document_before_the_input_ends() -> None:
    command = (sys.executable, "-m", "rosasync", "call", LAMP, LAMP_TYPE, "-", "--json")
    with ended(
        subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write("data: true\n---\n")
        process.stdin.flush()
        assert json.loads(process.stdout.readline()) == {"success": True, "message": "True"}
        process.stdin.close()
        (summary,) = json_lines(process.stdout.read())
        assert process.wait(LIMIT) == 0
    assert summary["summary"]["answered"] == 1


@pytest.mark.slow
def test_count_concurrency_and_rate_end_with_a_summary() -> None:
    done = rosasync("call", LAMP, ON, "--count", "30", "--concurrency", "5", "--rate", "1000")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("30 answered, 0 failed in ")
    assert "p50" in done.stdout
    assert "p99" in done.stdout


@pytest.mark.slow
def test_json_of_several_calls_has_a_line_each_and_a_summary() -> None:
    done = rosasync("call", LAMP, ON, "--count", "3", "--json")
    *responses, summary = json_lines(done.stdout)
    assert responses == 3 * [{"success": True, "message": "True"}]
    assert summary["summary"]["answered"] == 3
    assert summary["summary"]["failed"] == {}


@pytest.mark.slow
def test_template_is_a_request_to_edit_and_send() -> None:
    done = rosasync("call", LAMP, "--template")
    assert done.returncode == 0
    assert "# std_srvs/srv/SetBool_Request" in done.stdout
    assert "# bool" in done.stdout
    edited = done.stdout.replace("false", "true")
    sent = rosasync("call", LAMP, LAMP_TYPE, "-", "--field", "message", stdin=edited)
    assert (sent.returncode, sent.stdout) == (0, "True\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        pytest.param((LAMP, "dta: true"), 2, "did you mean 'data'", id="field"),
        pytest.param((LAMP, LAMP_TYPE, "data: 1"), 2, "expected bool", id="value"),
        pytest.param((LAMP, LAMP_TYPE, "data: ["), 2, "not YAML", id="yaml"),
        pytest.param((LAMP, LAMP_TYPE, "@/no/such/file"), 2, "cannot read", id="file"),
        pytest.param((LAMP, "no_msgs/srv/Type", "{}"), 2, "ros-<distribution>-no-msgs", id="type"),
        pytest.param(("not a name", LAMP_TYPE), 2, "'not_a_name' is a valid one", id="name"),
        pytest.param((LAMP_TYPE, LAMP), 2, "give the name first, and then the type", id="order"),
        pytest.param((LAMP, "--count", "0"), 2, "rosasync call --help", id="usage"),
        pytest.param((LAMP, "--field", "nothing"), 2, "there is success, message", id="path"),
        pytest.param(("/lamp/none", LAMP_TYPE, "--timeout", "1"), 3, "rosasync why", id="none"),
        pytest.param(
            ("/lamp/swich", "--timeout", DISCOVERY),
            3,
            f"there are {LAMP} ({LAMP_TYPE})",
            id="no type",
        ),
        pytest.param(("/lamp/silent", "--timeout", DISCOVERY), 4, "--timeout", id="timeout"),
    ],
)
def test_a_failure_has_an_exit_code_and_one_line(
    arguments: tuple[str, ...], code: int, says: str
) -> None:
    done = rosasync("call", *arguments)
    assert (done.returncode, done.stdout) == (code, "")
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_another_type_is_a_warning_before_it_is_an_error() -> None:
    done = rosasync("call", LAMP, "std_srvs/srv/Trigger", "--timeout", DISCOVERY)
    assert done.returncode == 3
    *warnings, error = done.stderr.splitlines()
    # The name of the server's node may be discovered later, and is then in a second one.
    assert len(warnings) in (1, 2)
    for warning in warnings:
        assert "callers wait for a server of type std_srvs/srv/Trigger" in warning
    assert f"this name is served as {LAMP_TYPE}" in error


@pytest.mark.slow
def test_failures_of_several_calls_are_counted_by_kind() -> None:
    options = ("--count", "2", "--timeout", DISCOVERY, "--json")
    done = rosasync("call", "/lamp/silent", LAMP_TYPE, *options)
    assert done.returncode == 4
    first, _, summary = json_lines(done.stdout)
    assert first["error"]["kind"] == "ResponseTimeout"
    assert summary["summary"]["failed"] == {"ResponseTimeout": 2}


@pytest.mark.slow
def test_the_server_goes_away() -> None:
    with ServerProcess() as server:
        server.serve_now("/leaving", LAMP_TYPE, delay="never")
        with terminal("call", "/leaving", LAMP_TYPE, "--timeout", "60") as command:
            server.ask_now("received", name="/leaving", at_least=1)
            server.close()
            assert command.end() == 5
    assert "Call again" in command.screen.replace("\n", " ")


@pytest.mark.slow
def test_ctrl_c_while_it_waits(lamp: ServerProcess) -> None:
    received = len(lamp.ask_now("received", name="/lamp/silent", at_least=0))
    with terminal("call", "/lamp/silent", LAMP_TYPE, "--timeout", "60") as command:
        lamp.ask_now("received", name="/lamp/silent", at_least=received + 1)
        command.interrupt()
        assert command.end() == 130
    assert "interrupted before the response came" in command.screen
    assert "Traceback" not in command.screen


@pytest.mark.slow
def test_ctrl_c_shows_the_summary_of_what_ran() -> None:
    with terminal("call", LAMP, ON, "--count", "1000000", "--rate", "200") as command:
        command.wait_for(r"[1-9]\d* of 1000000 calls made")
        command.interrupt()
        assert command.end() == 130
    assert "answered, 0 failed in" in command.screen
    assert "Traceback" not in command.screen


@pytest.mark.slow
def test_progress_is_drawn_on_a_terminal_only() -> None:
    with terminal("call", LAMP, ON, "--count", "3") as command:
        assert command.end() == 0
    assert b"\x1b[" in command.raw
    assert command.screen.startswith("3 answered")
    assert "\x1b" not in rosasync("call", LAMP, ON, "--count", "3").stderr


@pytest.mark.slow
def test_responses_go_to_the_file_while_progress_is_on_the_terminal(tmp_path: Path) -> None:
    file = tmp_path / "responses"
    with terminal("call", LAMP, ON, "--count", "3", "--json", into=f"> {file}") as command:
        assert command.end() == 0
    assert len(json_lines(file.read_text())) == 4
    assert b"of 3 calls made" in command.raw
    assert command.screen == ""


@pytest.mark.slow
def test_a_closed_pipe_ends_it_quietly() -> None:
    command = f"{sys.executable} -m rosasync call {LAMP} --count 100000 --rate 500 --json | head -1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 141
    assert len(json_lines(done.stdout)) == 1
    assert own(done.stderr) == ""


BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)]
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stdin", "message"),
    [
        (b"\xff\xfe\x00\x01", "standard input is not text in UTF-8"),
        (b"{data: 2024-99-99}", "expected bool"),
        (b"{data: !!int x}", "expected bool"),
        (BOMB.encode(), "the aliases of this YAML stand for too much"),
        (b"[" * 100_000, "YAML"),
        (b"{data: " + b"x" * 20_000_000 + b"}", "expected bool"),
        (b"x" * (64 * 1024**2 + 2**17), "larger than 64 MiB"),
    ],
    ids=["binary", "date", "tag", "bomb", "deep", "long", "large"],
)
def test_standard_input_that_is_no_request(stdin: bytes, message: str) -> None:
    done = subprocess.run(
        (sys.executable, "-m", "rosasync", "call", LAMP, LAMP_TYPE, "-"),
        capture_output=True,
        input=stdin,
        cwd=ROOT,
        check=False,
    )
    stderr = own(done.stderr.decode())
    assert (done.returncode, done.stdout) == (2, b"")
    assert message in stderr
    assert stderr.count("\n") == 1
    assert len(stderr) < 1000
