"""``serve``, ``bench``, ``watch`` and ``demo --serve``, with stock clients and servers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from rosasync import Session
from tests.support.clients import ClientProcess
from tests.support.command import DISCOVERY, LAMP, LAMP_TYPE, json_lines, rosasync, terminal
from tests.support.introspected import NAME as WATCHED
from tests.support.introspected import IntrospectedProcess
from tests.support.servers import ServerProcess
from tests.support.times import until

ECHO = "diagnostic_msgs/srv/AddDiagnostics"


async def test_serve_echoes_to_a_stock_client(client_process: ClientProcess) -> None:
    with terminal("serve", "/stub", ECHO, "--echo") as server:
        server.wait_for("Ctrl-C ends it")
        tally = await client_process.run("/stub", 3, tag="stock")
        server.interrupt()
        assert server.end() == 130
    assert tally.answered == 3
    assert "load_namespace: stock-0-1" in server.screen
    assert "requests: 3, responses: 3" in server.screen
    assert "Traceback" not in server.screen


@pytest.mark.slow
def test_serve_answers_with_a_response_after_a_delay() -> None:
    options = ("--response", "{success: true, message: hello}", "--delay", "0.01", "--json")
    with terminal("serve", "/stub/hello", LAMP_TYPE, *options) as server:
        server.wait_for("Ctrl-C ends it")
        assert rosasync("call", "/stub/hello", "--field", "message").stdout == "hello\n"
        server.wait_for('{"data": false}')
        server.interrupt()
        assert server.end() == 130


@pytest.mark.slow
def test_serve_fails_and_drops() -> None:
    with (
        terminal("serve", "/stub/fails", LAMP_TYPE, "--echo", "--fail-rate", "1") as failing,
        terminal("serve", "/stub/drops", LAMP_TYPE, "--drop-rate", "1") as dropping,
    ):
        failing.wait_for("Ctrl-C ends it")
        dropping.wait_for("Ctrl-C ends it")
        failed = rosasync("call", "/stub/fails", "data: true", "--field", "success")
        assert failed.stdout == "false\n"
        assert rosasync("call", "/stub/drops", "--timeout", DISCOVERY).returncode == 4
        dropping.interrupt()
        assert dropping.end() == 130
    assert "responses: 0" in dropping.screen


@pytest.mark.slow
def test_serve_ends_while_it_delays_a_response() -> None:
    with terminal("serve", "/stub/late", LAMP_TYPE, "--delay", "100") as server:
        server.wait_for("Ctrl-C ends it")
        with terminal("call", "/stub/late", LAMP_TYPE, "--timeout", "60") as call:
            server.wait_for("data: false")
            server.interrupt()
            assert server.end() == 130
            assert call.end() == 5
    assert "Traceback" not in server.screen


HANDLERS = """
def pair(request, response):
    response.message = "pair"
    return response

async def one(call):
    call.response.message = "one"
    return call.response
"""


@pytest.mark.slow
@pytest.mark.parametrize("function", ["pair", "one"])
def test_serve_with_a_handler(function: str, tmp_path: Path) -> None:
    (tmp_path / "handlers.py").write_text(HANDLERS)
    name, path = f"/stub/{function}", {"PYTHONPATH": f"{Path.cwd()}:{tmp_path}"}
    with terminal("serve", name, LAMP_TYPE, "--handler", f"handlers:{function}", **path) as server:
        server.wait_for("Ctrl-C ends it")
        assert rosasync("call", name, "--field", "message").stdout == f"{function}\n"
        server.wait_for("data: false")
        server.interrupt()
        assert server.end() == 130


@pytest.mark.slow
def test_serve_reports_what_a_handler_raises(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text("def fail(call):\n    raise LookupError('no lamp')\n")
    path = {"PYTHONPATH": f"{Path.cwd()}:{tmp_path}"}
    options = ("--handler", "failing:fail", "--status")
    with terminal("serve", "/stub/told", LAMP_TYPE, *options, **path) as server:
        server.wait_for("Ctrl-C ends it")
        done = rosasync("call", "/stub/told", LAMP_TYPE, "--timeout", "60")
        server.interrupt()
        assert server.end() == 130
    assert (done.returncode, done.stdout) == (1, "")
    assert "the handler failed: LookupError: no lamp. The server's log" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
async def test_serve_reports_that_it_closes() -> None:
    options = ("--status", "--delay", "1000")
    async with Session("looking") as session:
        with terminal("serve", "/stub/closing", LAMP_TYPE, *options) as server:
            server.wait_for("Ctrl-C ends it")
            with terminal("call", "/stub/closing", LAMP_TYPE, "--timeout", "60") as call:
                server.wait_for("data: false")
                await until(lambda: listens_to_departures(session))
                server.interrupt()
                assert server.end() == 130
                assert call.end() == 5
    assert "the server closed before it answered" in " ".join(call.screen.split())


def listens_to_departures(session: Session) -> bool:
    """Return whether a server does so: once a caller is matched with the topic of its reports."""
    node = session.node
    topics = [name for name, _ in node.get_topic_names_and_types() if "departures" in name]
    return any(map(node.count_subscribers, topics))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "says"),
    [
        pytest.param(("--response", "sucess: true"), "did you mean 'success'", id="response"),
        pytest.param(("--handler", "nowhere:function"), "MODULE:FUNCTION", id="module"),
        pytest.param(("--handler", "os:nothing"), "MODULE:FUNCTION", id="function"),
        pytest.param(("--handler", "os:getcwd"), "handler", id="arguments"),
        pytest.param(("--handler", "os:getcwd", "--echo"), "leave out", id="both"),
    ],
)
def test_serve_refuses(options: tuple[str, ...], says: str) -> None:
    done = rosasync("serve", "/stub", LAMP_TYPE, *options)
    assert (done.returncode, done.stdout) == (2, "")
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.slow
def test_demo_serves_the_tutorials_lamp(lamp: ServerProcess) -> None:
    with terminal("demo", "--serve") as server:
        server.wait_for("serving /lamp/switch")
        server.interrupt()
        assert server.end() == 130


def test_bench_in_a_pipe(lamp: ServerProcess) -> None:
    options = ("--duration", "0.5", "--timeout", DISCOVERY)
    done = rosasync("bench", LAMP, *options, "--callers", "3")
    assert (done.returncode, done.stderr) == (0, "")
    assert "answered, 0 failed in" in done.stdout
    assert "from " in done.stdout
    (figures,) = json_lines(
        rosasync("bench", LAMP, LAMP_TYPE, *options, "--rate", "100", "--json").stdout
    )
    assert figures["answered"] > 0
    assert figures["failed"] == {}
    assert 0 < figures["p50_ms"] <= figures["p99_ms"] <= figures["max_ms"]


@pytest.mark.slow
def test_bench_counts_losses(lamp: ServerProcess) -> None:
    options = ("--duration", "0.1", "--timeout", DISCOVERY, "--callers", "1", "--json")
    done = rosasync("bench", "/lamp/silent", LAMP_TYPE, *options)
    assert done.returncode == 4
    (figures,) = json_lines(done.stdout)
    assert figures["answered"] == 0
    assert figures["failed"] == {"ResponseTimeout": 1}


@pytest.mark.slow
def test_ctrl_c_ends_a_bench_with_its_summary(lamp: ServerProcess) -> None:
    options = ("--duration", "1000", "--rate", "500", "--timeout", DISCOVERY)
    with terminal("bench", LAMP, *options) as command:
        command.wait_for(r"[1-9]\d* answered, 0 failed")
        command.interrupt()
        assert command.end() == 130
    assert "from " in command.screen
    assert "Traceback" not in command.screen


@pytest.fixture(scope="module")
def watched() -> Iterator[IntrospectedProcess]:
    with IntrospectedProcess() as process:
        yield process


@pytest.mark.slow
def test_watch_switches_introspection_on_and_off_again(watched: IntrospectedProcess) -> None:
    with terminal("watch", WATCHED) as command:
        command.wait_for("set to 'contents'")
        command.wait_for("Ctrl-C ends it")
        assert watched.setting == "contents"
        watched.call(True)
        command.wait_for('"success": true')
        command.interrupt()
        assert command.end() == 130
    assert '{"data": true}' in command.screen
    assert "Traceback" not in command.screen
    assert watched.setting == "disabled"


def test_watch_prints_json(watched: IntrospectedProcess) -> None:
    with terminal("watch", WATCHED, "--json", "--count", "2") as command:
        command.wait_for("Ctrl-C ends it")
        watched.call(True)
        assert command.end() == 0
    lines = [line for line in command.raw.decode().splitlines() if line.startswith("{")]
    received, sent = json_lines("\n".join(lines))
    assert (received["event"], received["request"]) == ("request_received", {"data": True})
    assert (sent["event"], sent["response"]["success"]) == ("response_sent", True)
    assert received["sequence"] == sent["sequence"]


@pytest.mark.slow
def test_watch_says_how_to_switch_introspection_on(lamp: ServerProcess) -> None:
    with terminal("watch", LAMP) as command:
        command.wait_for("configure_introspection")
        command.wait_for("Ctrl-C ends it")
        command.interrupt()
        assert command.end() == 130
    assert "0 events" in command.screen
