"""A session takes a port in shared memory that no dead process has left behind."""

from __future__ import annotations

import asyncio
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import rosasync
from rosasync._ros import configuration, fresh_ports
from rosasync._ros.fresh_ports import LEASE, dead_ports, fresh_offset, port_prefix
from rosasync._ros.profile import SWITCH
from tests.support.process import ROOT, ended, first_line
from tests.support.servers import ServerProcess
from tests.support.times import LIMIT, TICK, until

EMPTY = "std_srvs/srv/Empty"
DOMAIN = 3
FIRST = 7400 + 250 * DOMAIN
METATRAFFIC, NUMBERS = FIRST + 10, range(FIRST + 11, FIRST + 250, 2)
AGO = time.time() - 2 * LEASE


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder instead of the shared memory, on a machine without UDP sockets."""
    monkeypatch.setattr(fresh_ports, "FOLDER", tmp_path)
    use_udp(monkeypatch)
    return tmp_path


def use_udp(monkeypatch: pytest.MonkeyPatch, *ports: int) -> None:
    monkeypatch.setattr(fresh_ports, "udp_sockets", lambda: iter([(port, "1") for port in ports]))


def leave(folder: Path, number: int, *, lock: bool = True, created: float | None = None) -> Path:
    """Leave a port behind, as a killed process does."""
    files = [folder / f"{port_prefix()}{number}"]
    files += [folder / f"{port_prefix()}{number}_el"] * lock
    for file in files:
        file.touch()
        if created is not None:
            os.utime(file, (created, created))
    return files[-1]


def close(folder: Path, number: int) -> None:
    """Leave what a process leaves that has closed its port."""
    (folder / f"sem.{port_prefix()}{number}_mutex").touch()


def chosen(domain: int = DOMAIN, times: int = 200) -> set[int]:
    """Return the ports that are chosen."""
    offsets = {fresh_offset(domain) for _ in range(times)}
    assert None not in offsets
    return {7400 + 250 * domain + (offset or 0) for offset in offsets}


@pytest.mark.usefixtures("folder")
def test_any_number_of_the_domain() -> None:
    ports = chosen()
    assert ports <= set(NUMBERS)
    assert len(ports) > 10
    # A process that chooses the same at the same time gets the next.
    assert max(ports) + 2 <= NUMBERS[-1]


@pytest.mark.usefixtures("folder")
def test_it_follows_the_metatraffic_port(monkeypatch: pytest.MonkeyPatch) -> None:
    use_udp(monkeypatch, METATRAFFIC, METATRAFFIC + 2, METATRAFFIC + 6, *NUMBERS[:-1])
    assert fresh_offset(DOMAIN) == NUMBERS[-1] - (METATRAFFIC + 4) + 10


@pytest.mark.parametrize("domain", [0, 232])
@pytest.mark.usefixtures("folder")
def test_the_first_and_the_last_domain(domain: int) -> None:
    ports = chosen(domain)
    assert min(ports) >= 7411 + 250 * domain
    assert max(ports) <= min(65535, 7399 + 250 * (domain + 1))


@pytest.mark.parametrize("lock", [True, False])
def test_numbers_that_were_left_behind_come_last(folder: Path, lock: bool) -> None:
    for number in NUMBERS[3:]:
        leave(folder, number, lock=lock, created=AGO)
    close(folder, NUMBERS[0])
    close(folder, NUMBERS[1])
    assert chosen() == {NUMBERS[2]}
    close(folder, NUMBERS[2])
    # Of these two, the next one is there as well.
    assert chosen() == {NUMBERS[0], NUMBERS[1]}


def test_other_domains_and_distributions_do_not_count(folder: Path) -> None:
    for number in NUMBERS:
        leave(folder, number + 250)
        (folder / f"fast_port{number}").touch()
    assert len(chosen()) > 10


def test_the_number_that_died_first_comes_into_use_again(folder: Path) -> None:
    for number in NUMBERS:
        leave(folder, number, created=AGO)
    with leave(folder, NUMBERS[5], created=AGO - 2).open() as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        leave(folder, NUMBERS[7], created=AGO - 1)
        assert chosen(times=2) == {NUMBERS[7]}


def test_when_none_is_left_the_middleware_chooses(folder: Path) -> None:
    for number in NUMBERS:
        leave(folder, number)
    assert fresh_offset(DOMAIN) is None


def test_a_good_offset_is_kept(folder: Path) -> None:
    for number in NUMBERS:
        assert fresh_offset(DOMAIN, number - METATRAFFIC + 10) == number - METATRAFFIC + 10
    leave(folder, NUMBERS[0])
    assert fresh_offset(DOMAIN, 11) != 11


@pytest.mark.usefixtures("folder")
def test_without_shared_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fresh_ports, "FOLDER", Path("/no/such/folder"))
    assert fresh_offset(DOMAIN) is None
    assert dead_ports(DOMAIN) == []


def test_the_ports_of_the_dead(folder: Path) -> None:
    left = leave(folder, NUMBERS[0])
    unlocked = leave(folder, 7001, lock=False)
    shared = leave(folder, NUMBERS[2], lock=False)
    shared.with_name(f"{shared.name}_sl").touch()
    close(folder, NUMBERS[4])
    with leave(folder, NUMBERS[1]).open() as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        leave(folder, NUMBERS[0] + 250)
        assert dead_ports(DOMAIN) == [unlocked, left.with_name(left.name.removesuffix("_el")), left]


CLIENT = f"""
import asyncio, rosasync
async def main():
    async with rosasync.Session("mortal", timeout=None) as session:
        await session.call("{EMPTY}", "/left", {{}})
        print("answered", flush=True)
        await asyncio.sleep(3600)
asyncio.run(main())
"""
SERVER = f"""
import asyncio, rosasync
async def main():
    async with rosasync.Session("mortal") as session:
        session.serve("{EMPTY}", "/mortal", lambda request, response: response)
        print("serving", flush=True)
        await asyncio.sleep(3600)
asyncio.run(main())
"""
TWO = """
import asyncio, rosasync, rclpy, sys
from tests.test_fresh_ports import ports_of_process
async def main():
    if "stock" in sys.argv:
        rclpy.init()
        node = rclpy.create_node("stock")
    async with rosasync.Session("one"), rosasync.Session("two"):
        if "after" in sys.argv:
            rclpy.init()
            node = rclpy.create_node("stock")
        print(len(ports_of_process("self")), flush=True)
    if rclpy.ok():
        rclpy.shutdown()
asyncio.run(main())
"""


def ports_of_process(pid: int | str) -> set[int]:
    """Return the numbers of the ports at which a process receives messages."""
    numbers = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        name = os.path.basename(os.readlink(descriptor)) if descriptor.is_symlink() else ""
        if name.startswith(port_prefix()):
            numbers.add(int(name.removeprefix(port_prefix()).removesuffix("_el")))
    return {number for number in numbers if number > 7400}


@pytest.fixture
def killed() -> Iterator[list[int]]:
    """The ports of killed processes, which are removed in the end."""
    numbers: list[int] = []
    yield numbers
    for number in numbers:
        for name in (f"{port_prefix()}{number}", f"{port_prefix()}{number}_el"):
            (fresh_ports.FOLDER / name).unlink(missing_ok=True)


def still_there(numbers: list[int]) -> set[int]:
    """Return those of these ports that no peer has removed yet: the others may be chosen again."""
    return {n for n in numbers if (fresh_ports.FOLDER / f"{port_prefix()}{n}").exists()}


def start(stack: ExitStack, program: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        (sys.executable, "-c", program), stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    stack.enter_context(ended(process))
    assert process.stdout is not None
    assert first_line(process.stdout)
    return process


async def test_clients_that_are_killed(server: ServerProcess, killed: list[int]) -> None:
    await server.serve("/left", EMPTY)
    with ExitStack() as stack:
        for _ in range(3):
            left = still_there(killed)
            client = start(stack, CLIENT)
            [port] = ports_of_process(client.pid)
            assert port not in left
            killed.append(port)
            client.send_signal(signal.SIGKILL)
            client.wait()


@pytest.mark.faults
async def test_the_lease_of_a_killed_client_ends(server: ServerProcess, killed: list[int]) -> None:
    """Its successor goes on."""
    await server.serve("/left", EMPTY)
    with ExitStack() as stack:
        client = start(stack, CLIENT)
        killed += ports_of_process(client.pid)
        async with rosasync.Session("successor", timeout=LIMIT) as session:
            await session.call(EMPTY, "/left")
            count = session.node.count_clients
            await until(lambda: count("/left") > 1)
            client.kill()
            while count("/left") > 1:
                await session.call(EMPTY, "/left")
                await asyncio.sleep(TICK)
            await session.call(EMPTY, "/left")


async def test_servers_that_are_killed(killed: list[int]) -> None:
    async with rosasync.Session("caller", timeout=LIMIT) as session:
        with ExitStack() as stack:
            for _ in range(3):
                left = still_there(killed)
                mortal = start(stack, SERVER)
                [port] = ports_of_process(mortal.pid)
                assert port not in left
                killed.append(port)
                retry = rosasync.Retry(attempts=100, after=0.5)
                await session.call(EMPTY, "/mortal", {}, retry=retry)
                mortal.send_signal(signal.SIGKILL)
                mortal.wait()


@pytest.mark.parametrize(
    ("order", "participants"), [("", 2), ("stock", 3), ("after", 3)], ids=["alone", "late", "early"]
)
def test_several_participants_in_a_process(order: str, participants: int) -> None:
    done = subprocess.run(
        (sys.executable, "-c", TWO, order), stdout=subprocess.PIPE, text=True, cwd=ROOT, check=True
    )
    assert first_line(done.stdout.splitlines(True)) == f"{participants}\n"


@pytest.mark.parametrize(
    "count", [6, pytest.param(40, marks=[pytest.mark.faults, pytest.mark.timeout(15 * 60)])]
)
def test_many_processes_at_once(count: int) -> None:
    program = SERVER.replace("await asyncio.sleep(3600)", "await asyncio.to_thread(input)")
    with ExitStack() as stack:
        processes = []
        for _ in range(count):
            processes.append(
                stack.enter_context(
                    subprocess.Popen(
                        (sys.executable, "-c", program),
                        stdin=subprocess.PIPE,
                        stdout=subprocess.PIPE,
                        text=True,
                        cwd=ROOT,
                    )
                )
            )
        ports: set[int] = set()
        for process in processes:
            assert process.stdout is not None
            assert first_line(process.stdout) == "serving\n"
            [port] = ports_of_process(process.pid)
            assert port not in ports
            ports.add(port)
        for process in processes:
            process.communicate("end\n", timeout=LIMIT)
            assert process.returncode == 0


@pytest.mark.faults
async def test_three_hundred_sessions_one_after_another() -> None:
    for _ in range(300):
        async with rosasync.Session("one_of_many"):
            assert len(ports_of_process("self")) == 1


async def test_when_none_is_left_a_session_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configuration, "fresh_offset", lambda *_: None)
    await call_itself()


@pytest.mark.slow
@pytest.mark.parametrize("domain", [0, 232])
def test_a_session_in_the_first_and_in_the_last_domain(domain: int) -> None:
    [port] = ports_elsewhere({"ROS_DOMAIN_ID": str(domain)})
    assert 7411 + 250 * domain <= port <= min(65535, 7399 + 250 * (domain + 1))


@pytest.mark.slow
def test_a_session_without_the_profile() -> None:
    assert len(ports_elsewhere({SWITCH: "off"})) == 1


async def call_itself() -> set[int]:
    """Open a session that calls its own server, and return the ports of the process."""
    async with rosasync.Session("itself", timeout=LIMIT) as session:
        session.serve(EMPTY, "/itself", lambda request, response: response)
        await session.call(EMPTY, "/itself")
        return ports_of_process("self")


def ports_elsewhere(variables: dict[str, str]) -> set[int]:
    """Do the same in a process with other environment variables."""
    program = (
        "import asyncio; from tests.test_fresh_ports import call_itself; "
        "print(*asyncio.run(call_itself()))"
    )
    done = subprocess.run(
        (sys.executable, "-c", program),
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, **variables},
        check=True,
    )
    return {int(port) for port in first_line(done.stdout.splitlines(True)).split()}
