"""What the faults share: a short and a full form of each, and the trial that counts."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rosasync import Session
from tests.conftest import Bridge
from tests.faults.table import PROPERTY, Row
from tests.faults.trial import Trial
from tests.support.servers import ServerProcess


@pytest.fixture(
    autouse=True,
    params=[False, pytest.param(True, marks=pytest.mark.faults)],
    ids=["short", "full"],
)
def full(request: pytest.FixtureRequest) -> bool:
    """Whether this is the full form, which ``-m faults`` selects."""
    return bool(request.param)


@pytest.fixture(scope="session")
def warm() -> dict[str, bool]:
    """The bridges that this process has used: what it opens only once is not a leak."""
    return {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the full forms more time: in debug mode, 20,000 calls take minutes."""
    for item in items:
        if item.get_closest_marker("faults"):
            item.add_marker(pytest.mark.timeout(30 * 60))


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Callable[[Row], None]:
    """Put a row into the report of the test, for the table at the end of the run."""

    def put(row: Row) -> None:
        request.node.user_properties.append((PROPERTY, row.to_json()))

    return put


@pytest.fixture
async def trial(
    request: pytest.FixtureRequest,
    record: Callable[[Row], None],
    bridge: Bridge,
    server: ServerProcess,
    warm: dict[str, bool],
) -> AsyncIterator[Trial]:
    """A trial, with its row in the report of the test. It fails if a figure is not as promised."""
    if bridge not in warm:
        for _ in range(2):
            async with Session("warm", bridge=bridge):
                pass
        warm[bridge] = True
    trial = Trial(fault_of(request), bridge)
    yield trial
    await trial.finish()
    record(trial.row)
    trial.row.check()


def fault_of(request: pytest.FixtureRequest) -> str:
    """Name a fault by its module and its test, with the parameters that are its own."""
    item: Any = request.node
    module = item.module.__name__.rpartition("test_")[2].replace("_", " ")
    name = item.originalname.removeprefix("test_").replace("_", " ")
    own = [
        word
        for word in item.callspec.id.split("-")
        if word not in ("direct", "executor", "short", "full", "asyncio")
    ]
    return f"{module}: {name}" + (f", {', '.join(own)}" if own else "")
