"""How a command ends: by SIGTERM as by Ctrl-C, and with streams that cannot be written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rosasync import Session
from tests.support.command import LAMP_TYPE, rosasync, terminal
from tests.support.introspected import NAME as WATCHED
from tests.support.introspected import IntrospectedProcess
from tests.support.process import ROOT, ended
from tests.support.times import LIMIT, until

pytestmark = pytest.mark.slow


@contextmanager
def started(*arguments: str, prefix: tuple[str, ...] = ()) -> Iterator[subprocess.Popen[str]]:
    """Start the command in pipes, and end it with the block."""
    process = subprocess.Popen(
        (*prefix, sys.executable, "-m", "rosasync", *arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    with ended(process):
        yield process


def wait_for(process: subprocess.Popen[str], text: str) -> None:
    """Wait until the command has printed this to standard error."""
    assert process.stderr is not None
    seen = ""
    while text not in seen:
        line = process.stderr.readline()
        assert line, seen
        seen += line


class TestSignals:
    """``kill``, ``timeout``, systemd and a terminal that is closed."""

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
    async def test_a_server_leaves_the_graph(self, number: signal.Signals) -> None:
        async with Session("looking") as session:
            with started("serve", "/stub/ended", LAMP_TYPE) as server:
                wait_for(server, "Ctrl-C ends it")
                await session.wait_for_service(LAMP_TYPE, "/stub/ended", timeout=LIMIT)
                server.send_signal(number)
                # Sooner than the 20 s after which a killed one is missed.
                ready = session.service_is_ready
                await until(lambda: not ready(LAMP_TYPE, "/stub/ended"), LIMIT / 2)
                _, errors = server.communicate(timeout=LIMIT)
        assert server.returncode == 128 + number
        assert "requests: 0, responses: 0" in errors
        assert "Traceback" not in errors

    def test_twice_as_timeout_sends_it(self) -> None:
        with started("serve", "/stub/twice", LAMP_TYPE) as server:
            wait_for(server, "Ctrl-C ends it")
            server.send_signal(signal.SIGTERM)
            server.send_signal(signal.SIGTERM)
            _, errors = server.communicate(timeout=LIMIT)
        assert server.returncode == 143
        assert "requests: 0" in errors

    def test_where_the_parent_ignores_ctrl_c(self) -> None:
        """A shell that starts a job in the background of a script makes it ignore SIGINT."""
        ignoring = ("bash", "-c", 'trap "" INT; exec "$@"', "bash")
        with started("serve", "/stub/job", LAMP_TYPE, prefix=ignoring) as server:
            wait_for(server, "Ctrl-C ends it")
            server.send_signal(signal.SIGINT)
            server.send_signal(signal.SIGTERM)
            _, errors = server.communicate(timeout=LIMIT)
        assert server.returncode == 143
        assert "requests: 0" in errors

    def test_a_watch_sets_introspection_back(self) -> None:
        with IntrospectedProcess() as watched:
            with started("watch", WATCHED) as watch:
                wait_for(watch, "Ctrl-C ends it")
                assert watched.setting == "contents"
                watch.terminate()
                _, errors = watch.communicate(timeout=LIMIT)
            assert watch.returncode == 143
            assert watched.setting == "disabled"
            # Also if it is ended before it could show anything.
            with started("watch", WATCHED) as watch:
                wait_for(watch, "set to 'contents'")
                watch.terminate()
                watch.communicate(timeout=LIMIT)
            assert watched.setting == "disabled"
        assert "is 'disabled' again" in errors

    async def test_a_call_that_waits(self) -> None:
        async with Session("looking") as session:
            with started("call", "/absent", LAMP_TYPE, "--timeout", "100") as call:
                await until(lambda: session.node.count_clients("/absent"))
                call.terminate()
                _, errors = call.communicate(timeout=LIMIT)
        assert call.returncode == 143
        assert "interrupted" in errors
        assert "Traceback" not in errors


class TestStreams:
    """Standard output and error that are closed or full."""

    @pytest.mark.parametrize(
        ("into", "code", "says"),
        [
            (">/dev/full", 1, "standard output cannot be written: No space left on device"),
            (">&-", 1, "standard output cannot be written: Bad file descriptor"),
            ("2>&-", 0, ""),
            (">&- 2>&-", 1, ""),
            ("<&- >/dev/null", 0, ""),
        ],
    )
    @pytest.mark.parametrize("command", ["show std_srvs/srv/SetBool", "--help", "call --help"])
    def test_one_line_and_an_exit_code(self, command: str, into: str, code: int, says: str) -> None:
        done = redirected(command, into)
        assert done.returncode == code, done.stderr
        expected = [f"rosasync: {says}"] if says else []
        assert done.stderr.splitlines() == expected

    def test_remarks_do_not_go_to_standard_output(self) -> None:
        with started("serve", "/stub/quiet", LAMP_TYPE) as server:
            wait_for(server, "Ctrl-C ends it")
            done = redirected(f"call /stub/quiet {LAMP_TYPE} --count 2", "2>&-")
        assert done.returncode == 0
        assert "Ctrl-C" not in done.stdout

    def test_a_server_whose_output_is_full_ends(self) -> None:
        with terminal("serve", "/stub/full", LAMP_TYPE, into=">/dev/full") as server:
            server.wait_for("Ctrl-C ends it")
            assert rosasync("call", "/stub/full", LAMP_TYPE).returncode in (0, 5)
            assert server.end() == 1
        assert "cannot be written: No space left" in server.screen.replace("\n", " ")

    @pytest.mark.parametrize("command", ["--help", "show rcl_interfaces/srv/SetParameters"])
    def test_a_closed_pipe_ends_it_quietly(self, command: str) -> None:
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(
            (sys.executable, "-m", "rosasync", *command.split()),
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            check=False,
        )
        os.close(writer)
        assert (done.returncode, done.stderr) == (141, "")


def redirected(command: str, into: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a shell, with these redirections."""
    line = f'"{sys.executable}" -m rosasync {command} {into}'
    return subprocess.run(
        ("bash", "-c", line), capture_output=True, text=True, cwd=ROOT, timeout=120, check=False
    )
