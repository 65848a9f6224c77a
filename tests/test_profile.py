"""The Fast DDS profile: its text, the command, and which processes send heartbeats by it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from xml.etree import ElementTree

import pytest

from rosasync._ros import configuration, fastdds, profile
from tests.support.hosts import NoHosts, own_shared_memory
from tests.support.lossy import LossyHosts
from tests.support.process import first_line, own
from tests.support.program import as_root
from tests.support.times import LIMIT, TICK, until

ROOT = Path(__file__).parents[1]
MANY = 30
"""More packets than a second without a profile has: about 4."""
OFTEN = 100
"""More packets than `LIMIT` without a profile has, about 70; with one, two seconds have as many."""
SECOND = 20 * TICK
VARIABLE = profile.profile_variable(profile.is_old())
ONLY_CLIENT = profile.profile_text(profile.is_old(), names=("client",))
OTHERS = ONLY_CLIENT.replace('"client"', '"/chatter"')


@pytest.fixture(scope="module")
def hosts() -> Iterator[LossyHosts]:
    with ExitStack() as stack:
        try:
            entered = stack.enter_context(LossyHosts("server", "client"))
        except NoHosts as exc:
            pytest.skip(str(exc))
        yield entered


@contextmanager
def program(
    hosts: LossyHosts, host: str, kind: str, folder: Path, environment: Mapping[str, str]
) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [*hosts.on(host), sys.executable, "-m", "tests.support.unanswered", kind],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **hosts.environment, **environment},
    ) as process:
        try:
            assert process.stdout is not None
            # What Fast DDS finds wrong in a profile comes before, and is not left out.
            assert first_line(process.stdout) == "ready\n"
            yield process
        finally:
            process.kill()


async def run_client(
    hosts: LossyHosts, kind: str, folder: Path, environment: Mapping[str, str], *, often: bool
) -> str:
    """Check how often a client sends heartbeats for an unanswered request; return its log."""
    off = {profile.SWITCH: "off"}
    with (
        program(hosts, "server", "server", ROOT, off) as server,
        program(hosts, "client", kind, folder, environment) as client,
    ):
        server.send_signal(signal.SIGSTOP)
        await asyncio.sleep(SECOND)
        before = hosts.counts()["frames"]
        assert client.stdin is not None
        client.stdin.write("send\n")
        client.stdin.flush()
        if often:
            await until(lambda: hosts.counts()["frames"] - before >= OFTEN)
        else:
            await asyncio.sleep(SECOND)
            assert hosts.counts()["frames"] - before < MANY
        server.send_signal(signal.SIGCONT)
        return client.communicate("end\n", timeout=LIMIT)[1]


class TestSession:
    @pytest.mark.slow
    async def test_a_session_uses_it(self, hosts: LossyHosts, tmp_path: Path) -> None:
        log = await run_client(hosts, "session", tmp_path, {}, often=True)
        assert "profile" not in log

    @pytest.mark.slow
    async def test_after_a_stock_node(self, hosts: LossyHosts, tmp_path: Path) -> None:
        """Fast DDS reads profile files before the first participant of a process only."""
        log = await run_client(hosts, "late session", tmp_path, {}, often=True)
        assert "profile" not in log

    @pytest.mark.slow
    async def test_switched_off(self, hosts: LossyHosts, tmp_path: Path) -> None:
        off = {profile.SWITCH: "off"}
        log = await run_client(hosts, "session", tmp_path, off, often=False)
        assert "profile" not in log

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("text", "missing"),
        [(OTHERS, "'client' and 'service'"), (ONLY_CLIENT, "'service'")],
        ids=["neither", "one"],
    )
    async def test_the_users_own_wins(
        self, hosts: LossyHosts, tmp_path: Path, text: str, missing: str
    ) -> None:
        file = tmp_path / "mine.xml"
        file.write_text(text)
        given, often = {VARIABLE: str(file)}, text == ONLY_CLIENT
        log = await run_client(hosts, "session", tmp_path, given, often=often)
        assert f"sets no heartbeat period for the publishers {missing}, so" in log

    @pytest.mark.slow
    async def test_the_users_file_in_the_working_directory(
        self, hosts: LossyHosts, tmp_path: Path
    ) -> None:
        name = profile.OLD_FILE if profile.is_old() else profile.NEW_FILE
        (tmp_path / name).write_text(OTHERS)
        log = await run_client(hosts, "session", tmp_path, {}, often=False)
        assert name in log


class TestCommand:
    async def test_a_stock_node_uses_it(self, hosts: LossyHosts, tmp_path: Path) -> None:
        file = tmp_path / "profile.xml"
        file.write_text(print_profile().stdout)
        given = {VARIABLE: str(file)}
        await run_client(hosts, "stock", tmp_path, given, often=True)

    def test_it_says_how_to_use_it_on_stderr(self) -> None:
        assert f"export {VARIABLE}=" in print_profile().stderr
        for name, variable in (("jazzy", "FASTRTPS"), ("kilted", "FASTDDS")):
            done = print_profile("--distribution", name)
            assert f"export {variable}_DEFAULT_PROFILES_FILE=" in done.stderr
            assert profile.missing_heartbeats(done.stdout) == []

    def test_it_does_not_import_rclpy(self) -> None:
        code = "import sys; sys.modules['rclpy'] = None; sys.argv[1:] = ['profile']; "
        code += "from rosasync.__main__ import main; main()"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def print_profile(*options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rosasync", "profile", *options]
    return subprocess.run(command, capture_output=True, text=True, check=True)


@pytest.mark.parametrize("old", [True, False])
def test_nothing_but_services_is_touched(old: bool) -> None:
    root = ElementTree.fromstring(profile.profile_text(old))
    (profiles, *log) = root
    names = [(element.tag.rpartition("}")[2], element.get("profile_name")) for element in profiles]
    assert names == [("publisher", "client"), ("publisher", "service")]
    assert [element.tag.rpartition("}")[2] for element in log] == ["log"] * old


@as_root
def test_the_middleware_reports_errors_on_stderr() -> None:
    code = "import asyncio, rosasync\n"
    code += "async def main():\n async with rosasync.Session(): print('opened')\n"
    code += "asyncio.run(main())"
    command = [*own_shared_memory("16k"), sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout == "opened\n"
    assert "RTPS_TRANSPORT_SHM" in done.stderr


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """The state of a process that has configured nothing."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.delenv(profile.SWITCH, raising=False)
    for name, value in (("loaded", False), ("reported", False), ("offset", None)):
        monkeypatch.setattr(configuration._State, name, value)
    monkeypatch.setattr(configuration._State, "offsets", set())


@pytest.mark.usefixtures("fresh")
def test_an_unreadable_profile_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "mine.xml"
    file.write_text("<profiles>")
    monkeypatch.setenv(VARIABLE, str(file))
    with caplog.at_level("INFO", "rosasync"):
        configuration.configure(0)
    assert f"{file} cannot be read" in caplog.text
    assert not configuration.heartbeats()


@pytest.mark.usefixtures("fresh")
def test_a_middleware_that_loads_no_profile(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fastdds, "LOAD_STRING", "no_such_function")
    fastdds._load.cache_clear()
    try:
        with caplog.at_level("INFO", "rosasync"):
            configuration.configure(0)
            configuration.configure(0)
    finally:
        fastdds._load.cache_clear()
    assert not configuration.heartbeats()
    assert caplog.text.count("does not load rosasync's profile") == 1


@pytest.mark.usefixtures("fresh")
def test_a_users_profile_that_may_have_come_too_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.xml"
    file.write_text(ONLY_CLIENT)
    monkeypatch.setenv(VARIABLE, str(file))
    assert not configuration.heartbeats()
    environ = tmp_path / "environ"
    environ.write_text(f"A=1\0{VARIABLE}={file}\0B=2")
    monkeypatch.setattr(configuration, "INITIAL_ENVIRONMENT", environ)
    assert configuration.heartbeats()
    assert not configuration.heartbeats("service")


OPEN = """
import asyncio, logging, os, sys, tempfile
import rclpy, rosasync
from rosasync._ros import configuration

async def main():
    if "late" in sys.argv:
        # No test is in this domain.
        rclpy.init(domain_id=0)
        rclpy.create_node("before").destroy_node()
        rclpy.shutdown()
    for _ in range(2):
        async with rosasync.Session():
            print(configuration.heartbeats())

before = dict(os.environ)
tempfile.tempdir = "/no/such/folder"
logging.basicConfig(level=logging.INFO, format="%(message)s")
asyncio.run(main())
assert before == dict(os.environ)
"""


@pytest.mark.parametrize(
    ("arguments", "environment", "known"),
    [([], {}, "True"), ([], {profile.SWITCH: "off"}, "False"), (["late"], {}, "True")],
    ids=["first", "off", "late"],
)
def test_a_session_knows_whether_the_profile_was_read(
    arguments: list[str], environment: dict[str, str], known: str
) -> None:
    """The default depth of clients depends on it. No temporary folder is needed."""
    done = subprocess.run(
        [sys.executable, "-c", OPEN, *arguments],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    assert own(done.stdout).split() == [known, known]
    assert "profile" not in done.stderr
