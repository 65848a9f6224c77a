"""``rosasync run`` and ``rosasync profile --fresh``; what doctor says of ports."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree

import pytest

from rosasync._ros import discovery
from rosasync._ros.fresh_ports import FOLDER, port_prefix
from rosasync._ros.profile import (
    SWITCH,
    is_old,
    missing_heartbeats,
    profile_text,
    profile_variable,
    with_offset,
)
from tests.support.command import json_lines, rosasync
from tests.support.process import ROOT, ended, first_line
from tests.support.times import LIMIT, until

pytestmark = pytest.mark.slow

VARIABLE = profile_variable(is_old())
SHOW = (sys.executable, "-c", f"import os; print(open(os.environ['{VARIABLE}']).read())")
NODE = """
import rclpy, sys
from tests.test_fresh_ports import ports_of_process
from std_srvs.srv import Empty
rclpy.init()
node = rclpy.create_node("stock")
node.create_service(Empty, "/fresh", lambda request, response: response)
print(*ports_of_process("self"), flush=True)
sys.stdin.readline()
"""


PARTICIPANT = """
import os, socket, sys
with socket.socket(type=socket.SOCK_DGRAM) as own:
    own.bind(("", int(sys.argv[1])))
    sys.stdin.readline()
"""
"""Has a socket where a participant would listen."""


def offset_in(text: str) -> int:
    [found] = re.findall(r"<(?:\w+:)?offsetd3>(\d+)<", text)
    return int(found)


def processes_with(argument: str) -> list[str]:
    """Return the processes that have this in their command line."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if argument.encode() in file.read_bytes():
                found.append(file.parent.name)
    return found


class TestRun:
    def test_the_program_gets_a_fresh_profile(self) -> None:
        done = rosasync("run", "--", *SHOW)
        assert done.returncode == 0
        assert missing_heartbeats(done.stdout) == []
        assert "<leaseAnnouncement>" in done.stdout
        assert offset_in(done.stdout) >= 11

    def test_a_stock_node_takes_the_port(self) -> None:
        command = (sys.executable, "-m", "rosasync", "run", sys.executable, "-c", NODE)
        with (
            subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
            ) as process,
            ended(process),
        ):
            assert process.stdout is not None
            [port] = map(int, first_line(process.stdout).split())
            environ = Path(f"/proc/{process.pid}/environ").read_text()
            [file] = re.findall(rf"{VARIABLE}=([^\0]+)", environ)
            first = 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"])
            assert (port - first - offset_in(Path(file).read_text())) % 2 == 0
            process.communicate("\n", timeout=LIMIT)

    def test_the_exit_code_is_the_programs(self) -> None:
        assert rosasync("run", "sh", "-c", "exit 7").returncode == 7
        assert rosasync("run", "/no/such/program").returncode == 127
        assert rosasync("run", "/").returncode == 126

    def test_signals_reach_the_program(self) -> None:
        command = ("-m", "rosasync", "run", "sh", "-c", "echo ready; exec sleep 3600")
        with subprocess.Popen((sys.executable, *command), stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            process.terminate()
            assert process.wait(LIMIT) == -signal.SIGTERM

    @pytest.mark.parametrize("prefix", [(), ("sh", "-c", '"$@"; true', "sh")], ids=["it", "child"])
    def test_participants_are_introduced(self, prefix: tuple[str, ...]) -> None:
        """Others announce themselves again to those of the program and of its children."""
        domain = int(os.environ["ROS_DOMAIN_ID"])
        *_, port, other = discovery.ports_of(domain)
        run = (sys.executable, "-m", "rosasync", "run", *prefix)
        with socket.socket(type=socket.SOCK_DGRAM) as listener:
            listener.bind((discovery.LOCALHOST, other))
            listener.settimeout(LIMIT)
            command = (*run, sys.executable, "-c", PARTICIPANT, str(port))
            with subprocess.Popen(command, stdin=subprocess.PIPE, cwd=ROOT) as process:
                address = port.to_bytes(4, "little") + bytes(12) + b"\x7f\x00\x00\x01"
                for _ in range(2):
                    while address not in listener.recv(1 << 16):
                        pass
                process.communicate(b"\n", timeout=LIMIT)

    def test_the_program_gets_no_child(self) -> None:
        program = "import os\ntry: os.wait()\nexcept ChildProcessError: print('none')"
        assert rosasync("run", sys.executable, "-c", program).stdout == "none\n"

    async def test_nothing_runs_after_the_program(self) -> None:
        name = f"rosasync-test-{os.getpid()}"
        assert rosasync("run", "sh", "-c", "exit 0", name).returncode == 0
        await until(lambda: not processes_with(name))

    def test_options_belong_to_the_program(self) -> None:
        assert rosasync("run", "echo", "--help", "-x").stdout == "--help -x\n"

    def test_stdout_is_the_programs(self) -> None:
        done = rosasync("run", "sh", "-c", "echo out; echo err >&2")
        assert (done.stdout, done.stderr) == ("out\n", "err\n")

    @pytest.mark.parametrize(
        "environ", [{SWITCH: "off"}, {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}]
    )
    def test_where_no_profile_is_set(self, environ: dict[str, str]) -> None:
        done = rosasync("run", "sh", "-c", f"echo ${VARIABLE}.", **environ)
        assert done.stdout == ".\n"

    def test_a_copy_of_the_users_profile_gets_the_port(self, tmp_path: Path) -> None:
        file = tmp_path / "mine.xml"
        file.write_text(profile_text(is_old(), names=("client",), heartbeat=0.7))
        done = rosasync("run", *SHOW, **{VARIABLE: str(file)})
        assert missing_heartbeats(done.stdout) == ["service"]
        assert "700000000" in done.stdout
        assert offset_in(done.stdout) >= 11
        assert "offsetd3" not in file.read_text()

    @pytest.mark.parametrize("text", ["<dds", "<profiles/> <x/>"])
    def test_a_profile_that_cannot_be_read_stays(self, tmp_path: Path, text: str) -> None:
        file = tmp_path / "mine.xml"
        file.write_text(text)
        done = rosasync("run", "sh", "-c", f"echo ${VARIABLE}", **{VARIABLE: str(file)})
        assert done.stdout == f"{file}\n"
        assert f"your profile {file} stays as it is: it is not valid XML" in done.stderr

    def test_without_a_temporary_folder(self) -> None:
        code = "import sys, tempfile; tempfile.tempdir = '/proc'; "
        code += "sys.argv[1:] = ['run', 'echo', 'started']; "
        code += "from rosasync.__main__ import main; main()"
        done = subprocess.run(
            (sys.executable, "-c", code), capture_output=True, text=True, check=True, cwd=ROOT
        )
        assert done.stdout == "started\n"
        assert "started without a fresh port" in done.stderr

    def test_a_domain_that_does_not_exist(self) -> None:
        done = rosasync("run", "echo", "started", ROS_DOMAIN_ID="300")
        assert (done.returncode, done.stdout) == (2, "")
        assert "there is no ROS domain 300" in done.stderr

    def test_started_within_another_it_takes_a_port_of_its_own(self) -> None:
        nested = (sys.executable, "-m", "rosasync", "run")
        texts = {rosasync("run", *nested, *SHOW).stdout for _ in range(4)}
        assert all(offset_in(text) for text in texts)
        assert len(texts) > 1


def test_profile_with_a_fresh_port() -> None:
    texts = {rosasync("profile", "--fresh").stdout for _ in range(4)}
    assert all(missing_heartbeats(text) == [] and offset_in(text) for text in texts)
    assert len(texts) > 1
    assert rosasync("profile", "--fresh", ROS_DOMAIN_ID="233").returncode == 1


class TestWithOffset:
    def test_without_a_namespace_and_without_participants(self) -> None:
        text = with_offset('<profiles><publisher profile_name="x"/></profiles>', 31)
        [participant] = ElementTree.fromstring(text).iter("participant")
        assert participant.get("is_default_profile") == "true"
        assert offset_in(text) == 31

    def test_the_default_participant_is_kept(self) -> None:
        text = with_offset(
            '<dds xmlns="http://x"><profiles><participant profile_name="a"/>'
            '<participant profile_name="b" is_default_profile="true"><rtps><name>n</name></rtps>'
            "</participant></profiles></dds>",
            31,
        )
        root = ElementTree.fromstring(text)
        [rtps] = root.iter("{http://x}rtps")
        assert [element.tag for element in rtps] == ["{http://x}name", "{http://x}port"]

    def test_ports_of_the_users_choice_stay(self) -> None:
        with pytest.raises(ValueError, match="chooses the ports already"):
            with_offset(
                '<profiles><participant profile_name="a" is_default_profile="true"><rtps>'
                "<port><portBase>9000</portBase></port></rtps></participant></profiles>",
                31,
            )


def test_doctor_names_the_ports_of_the_dead() -> None:
    number = 7400 + 250 * int(os.environ["ROS_DOMAIN_ID"]) + 249
    files = [FOLDER / f"{port_prefix()}{number}{end}" for end in ("", "_el")]
    try:
        for file in files:
            file.write_bytes(b"\2\0\0\0" + bytes(100))
        [ports] = [
            check
            for check in json_lines(rosasync("doctor", "--json").stdout)
            if check["check"] == "ports"
        ]
    finally:
        for file in files:
            file.unlink()
    assert ports["ok"] is None
    assert ports["todo"].startswith("rm ")
    assert all(str(file) in ports["todo"].split() for file in files)


@pytest.mark.parametrize(
    ("domain", "expected"),
    [
        ("300", "there is no ROS domain 300"),
        ("4294967296", "there is no ROS domain 4294967296"),
        ("-1", "there is no ROS domain"),
        ("some", "ROS_DOMAIN_ID=some is not a number"),
    ],
)
def test_domains_that_do_not_exist(domain: str, expected: str) -> None:
    for command in (("doctor",), ("why", "/lamp/switch")):
        checks = json_lines(rosasync(*command, "--json", ROS_DOMAIN_ID=domain).stdout)
        [found] = [check for check in checks if check["check"] == "domain"]
        assert found["ok"] is False
        assert expected in found["found"]
    done = rosasync("call", "/lamp/switch", "std_srvs/srv/SetBool", ROS_DOMAIN_ID=domain)
    assert done.returncode == 1
    assert expected in done.stderr


def test_a_domain_above_the_safe_ones() -> None:
    checks = json_lines(rosasync("why", "/lamp/switch", "--json", ROS_DOMAIN_ID="102").stdout)
    [found] = [check for check in checks if check["check"] == "domain"]
    assert found["ok"] is None
    assert "outgoing connections" in found["todo"]


def test_profile_as_json() -> None:
    (found,) = json_lines(rosasync("profile", "--distribution", "kilted", "--json").stdout)
    assert found["variable"] == "FASTDDS_DEFAULT_PROFILES_FILE"
    assert found["profile"] == rosasync("profile", "--distribution", "kilted").stdout
