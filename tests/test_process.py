"""The processes of stock nodes that the tests use."""

from __future__ import annotations

import signal

import pytest

from tests.support import servers
from tests.support.managed import NodesProcess
from tests.support.servers import ServerProcess


@pytest.mark.slow
def test_one_that_hangs_is_replaced() -> None:
    with NodesProcess() as nodes:
        hung = nodes.pid
        nodes.signal(signal.SIGSTOP)
        nodes.ask_first("add", patience=0.5, kind="lifecycle", name="first")
        assert nodes.pid != hung
        assert nodes.ask_now("add", kind="lifecycle", name="second") is None


@pytest.mark.slow
def test_one_that_hangs_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    with ServerProcess() as server:
        assert server.works()
        server.signal(signal.SIGSTOP)
        monkeypatch.setattr(servers, "REPLACED_AFTER", 0.5)
        assert not server.works()
