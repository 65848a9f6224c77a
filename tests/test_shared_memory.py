"""Which ports in shared memory count as unfinished."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from rosasync import RosasyncError
from rosasync._ros import shared_memory
from rosasync._ros.profile import is_old, profile_variable
from rosasync._ros.shared_memory import check_ports, unfinished_ports
from tests.support.times import LIMIT, TICK

PREFIX = "fastrtps_port" if is_old() else "fastdds_port"
DOMAIN = 3
READY = b"\2\0\0\0" + bytes(100)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(shared_memory, "FOLDER", tmp_path)
    monkeypatch.setattr(shared_memory, "GRACE", 4 * TICK)
    return tmp_path


def leave(folder: Path, name: str, content: bytes = b"") -> Path:
    """Leave a file behind."""
    file = folder / name
    file.write_bytes(content)
    return file


@pytest.mark.parametrize("content", [b"", b"\0" * 50_000, b"\1\0\0\0" + bytes(100)])
def test_unfinished(folder: Path, content: bytes) -> None:
    every = [leave(folder, f"{PREFIX}{number}", content) for number in (7003, 8151, 8399)]
    assert unfinished_ports(DOMAIN) == every
    with pytest.raises(RosasyncError, match=f"Remove it: rm {every[0]} {every[1]}"):
        check_ports(DOMAIN)


@pytest.mark.parametrize("content", [READY, b"\3\0\0\0" + bytes(100)])
def test_ready_or_corrupted(folder: Path, content: bytes) -> None:
    leave(folder, f"{PREFIX}7000", content)
    check_ports(DOMAIN)


@pytest.mark.parametrize(
    "name",
    [
        "fastrtps_port8149",
        "fastrtps_port8400",
        "fastdds_port8149",
        "fastdds_port7000_el",
        "fastrtps_port7000_el",
        "fastrtps_7000",
        "sem.fastrtps_port7000_mutex",
    ],
)
def test_other_files(folder: Path, name: str) -> None:
    leave(folder, name)
    check_ports(DOMAIN)


def test_being_created(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory, "GRACE", LIMIT)
    file = leave(folder, f"{PREFIX}7000")
    finish = threading.Timer(TICK, file.write_bytes, (READY,))
    finish.start()
    assert unfinished_ports(DOMAIN) == []
    finish.join()


@pytest.mark.parametrize(
    "profile", [None, "<useBuiltinTransports>false</useBuiltinTransports><type>UDPv4</type>"]
)
def test_shared_memory_that_is_not_used(
    folder: Path, monkeypatch: pytest.MonkeyPatch, profile: str | None
) -> None:
    leave(folder, f"{PREFIX}7000")
    if profile is None:
        monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4")
    else:
        file = folder / "profile.xml"
        file.write_text(profile)
        monkeypatch.setenv(profile_variable(is_old()), str(file))
    check_ports(DOMAIN)
