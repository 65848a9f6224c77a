"""The command line: the real demo, how it ends, and the message if an extra is missing."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version

import psutil
import pytest

from rosasync._demo.run import TURNS, Report, Samples
from rosasync._demo.stock import READY
from tests.support.hosts import own_shared_memory
from tests.support.process import ended
from tests.support.program import as_root

LIMIT = 120.0
ROSASYNC = (sys.executable, "-m", "rosasync")


def run(*command: str, **environ: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=LIMIT,
        env={**os.environ, **environ},
        check=False,
    )


def run_without(module: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in an interpreter that cannot import the module."""
    code = f"import sys; sys.modules[{module!r}] = None; sys.argv[1:] = {arguments!r}; "
    return run(sys.executable, "-c", code + "from rosasync.__main__ import main; main()")


def test_version() -> None:
    try:
        expected = f"rosasync {version('rosasync')}\n"
    except PackageNotFoundError:
        expected = "rosasync, not installed: run from a source tree\n"
    done = run(*ROSASYNC, "--version")
    assert (done.returncode, done.stdout) == (0, expected)


@pytest.mark.parametrize("module", ["rich", "typer"])
def test_without_the_cli_extra_it_says_so(module: str) -> None:
    done = run_without(module, "--version")
    assert done.returncode == 2
    assert done.stderr == f"The rosasync command needs {module}: pip install 'rosasync[cli]'\n"


def test_demo_without_rclpy_says_which_extra() -> None:
    done = run_without("rclpy", "demo")
    assert done.returncode == 1
    assert "rosasync[jazzy]" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_demo_prints_json_alone() -> None:
    done = run(*ROSASYNC, "demo", "--json", "--calls", "200", "--seconds", "600")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["bridge"] in {"direct", "executor"}
    for contests in (report["contests"], report["bare_server"]):
        assert [contest["at_once"] for contest in contests] == [1, 10]
    for contest in (*report["contests"], *report["bare_server"]):
        ours, stock = contest["rosasync"], contest["client.call"]
        assert ours["calls"] == stock["calls"] == 200
        for figures in (ours, stock):
            assert 0 < figures["median_us"] <= figures["p99_us"]
        assert contest["ratio"]["median"] == pytest.approx(ours["median_us"] / stock["median_us"])


@pytest.mark.slow
@as_root
def test_demo_works_although_the_middleware_logs_errors() -> None:
    command = (*ROSASYNC, "demo", "--json", "--calls", "20", "--seconds", "60")
    done = run(*own_shared_memory("16k"), *command)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["contests"]) == 2


@pytest.mark.slow
def test_demo_shows_table_and_histogram_where_stdout_knows_no_unicode() -> None:
    done = run(*ROSASYNC, "demo", "--calls", "20", "--seconds", "60", PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    for text in ("median", "99 %", "calls/s", "CPU/call", "ratio", "Latency", "480 calls"):
        assert text in done.stdout


@pytest.mark.slow
def test_demo_stops_measuring_when_its_seconds_are_over() -> None:
    done = run(*ROSASYNC, "demo", "--json", "--calls", "1000000", "--seconds", "0.5")
    assert done.returncode == 0, done.stderr
    for contest in json.loads(done.stdout)["contests"]:
        assert 0 < contest["rosasync"]["calls"] < 1_000_000
        assert 0 < contest["client.call"]["calls"] < 1_000_000


@contextmanager
def terminal() -> Iterator[tuple[int, int]]:
    """Open a pseudo-terminal; yield the end to read from and the end to hand to a process."""
    ours, theirs = pty.openpty()
    try:
        yield ours, theirs
    finally:
        os.close(ours)


def read_until(fd: int, text: bytes) -> bytes:
    seen = b""
    while text not in seen:
        seen += os.read(fd, 4096)
    return seen


def read_to_end(fd: int) -> bytes:
    seen = b""
    with suppress(OSError):  # raised when the other end of the terminal has been closed
        while chunk := os.read(fd, 4096):
            seen += chunk
    return seen


def test_ctrl_c_ends_a_command_whose_loop_sleeps() -> None:
    """The signal comes on another thread, so it does not interrupt the sleep by itself."""
    code = (
        "import asyncio, signal, threading, time\n"
        "from rosasync._cli.run import run\n"
        "def strike():\n"
        "    time.sleep(0.2)\n"
        "    signal.pthread_kill(threading.get_ident(), signal.SIGINT)\n"
        "async def command():\n"
        "    threading.Thread(target=strike).start()\n"
        "    await asyncio.Event().wait()\n"
        "run(command())\n"
    )
    done = run(sys.executable, "-c", code)
    assert "Exit: 130" in done.stderr.splitlines()[-1]


def test_ctrl_c_ends_the_demo_and_its_servers() -> None:
    command = (*ROSASYNC, "demo", "--json", "--calls", "1000000", "--seconds", "60")
    with terminal() as (screen, stderr):
        demo = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stderr, start_new_session=True
        )
        os.close(stderr)
        try:
            read_until(screen, b"at once")  # the progress bar: calls are being made
            servers = psutil.Process(demo.pid).children()
            assert len(servers) == 2
            os.killpg(demo.pid, signal.SIGINT)
            stdout, _ = demo.communicate(timeout=LIMIT)
        finally:
            demo.kill()
            demo.wait()
        shown = read_to_end(screen)
    assert demo.returncode == 130
    assert not any(server.is_running() for server in servers)
    assert stdout == b""
    assert b"Traceback" not in shown
    assert b"Exception" not in shown


def test_stock_server_ends_with_its_standard_input() -> None:
    command = (sys.executable, "-m", "rosasync._demo.stock", "/rosasync_test/echo")
    with ended(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)) as server:
        assert server.stdin is not None
        assert server.stdout is not None
        assert READY in server.stdout
        server.stdin.close()
        assert server.wait(LIMIT) == 0


@pytest.mark.parametrize("kind", [(), ("--bare",)])
def test_stock_server_whose_standard_input_has_ended_before(kind: tuple[str, ...]) -> None:
    done = run(sys.executable, "-m", "rosasync._demo.stock", *kind, "/rosasync_test/echo")
    assert done.returncode == 0, done.stderr


def test_figures() -> None:
    figures = Samples([1e-4 * n for n in range(1, 201)], wall=2.0, cpu=1.0).figures()
    assert figures.median_us == pytest.approx(10_050)
    assert figures.p99_us == pytest.approx(19_800)
    assert figures.calls_per_s == 100
    assert figures.cpu_us_per_call == 5_000


def test_report_of_equal_latencies() -> None:
    samples = Samples([1e-3], wall=1e-3, cpu=1e-3)
    report = Report("direct", dict.fromkeys(TURNS, samples))
    (first, _) = json.loads(report.as_json())["contests"]
    assert set(first["ratio"].values()) == {1.0}
    assert report.as_text().renderables
