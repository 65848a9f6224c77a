"""What a user imports: the names, their docstrings, and what they need to be there."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import rosasync
from tests.support.process import ROOT

PACKAGE = Path(rosasync.__file__).parent
MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(rosasync.__path__, "rosasync.")
    if not module.name.rpartition(".")[2].startswith("_")
)
CONTRACT = {
    "CallError",
    "ContextShutdown",
    "InvalidServiceName",
    "Limits",
    "PoolFull",
    "QueueTimeout",
    "ResponseTimeout",
    "Retry",
    "RosasyncError",
    "ServerGone",
    "ServiceClient",
    "ServiceUnavailable",
    "Session",
    "SessionClosed",
    "UsageError",
    "wrap_future",
}


@pytest.fixture(params=MODULES)
def module(request: pytest.FixtureRequest) -> ModuleType:
    """Each module of the package."""
    return importlib.import_module(request.param)


def test_the_package_has_the_names_of_the_contract() -> None:
    assert set(rosasync.__all__) >= CONTRACT
    assert sorted(rosasync.__all__) == list(rosasync.__all__)


def test_every_public_name_is_in_the_reference() -> None:
    pages = (page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    directive = r"^\.\. auto(?:class|exception|function):: rosasync\.(\w+)$"
    entries = re.findall(directive, "\n".join(pages), re.MULTILINE)
    assert sorted(entries) == sorted(rosasync.__all__)


def test_all_names_exist_once(module: ModuleType) -> None:
    names = list(module.__all__) if hasattr(module, "__all__") else []
    assert len(names) == len(set(names))
    assert not [name for name in names if not hasattr(module, name)]
    assert not [name for name in names if name.startswith("_")]


def test_public_modules_say_what_is_public(module: ModuleType) -> None:
    if _is_empty(module):
        return
    assert isinstance(module.__all__, list)
    own = {
        name
        for name, thing in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(thing) or inspect.isfunction(thing))
        and thing.__module__ == module.__name__
    }
    public_elsewhere = set(rosasync.__all__) & own
    assert public_elsewhere <= set(module.__all__)


def test_public_things_have_docstrings(module: ModuleType) -> None:
    if _is_empty(module):
        return
    assert module.__doc__
    missing = []
    for name in module.__all__:
        thing = getattr(module, name)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            missing += [name] if not inspect.getdoc(thing) else []
        if inspect.isclass(thing):
            missing += [
                f"{name}.{attribute}"
                for attribute, value in vars(thing).items()
                if not attribute.startswith("_")
                and (inspect.isfunction(value) or isinstance(value, property))
                and not inspect.getdoc(value)
            ]
    assert not missing


def test_every_error_is_a_rosasync_error_and_calls_tell_what_they_called() -> None:
    errors = [
        thing
        for name in rosasync.__all__
        if inspect.isclass(thing := getattr(rosasync, name)) and issubclass(thing, Exception)
    ]
    assert len(errors) >= 11
    assert all(issubclass(error, rosasync.RosasyncError) for error in errors)
    for error in (rosasync.ServiceUnavailable, rosasync.QueueTimeout, rosasync.ResponseTimeout):
        assert issubclass(error, rosasync.CallError)
        assert issubclass(error, TimeoutError)
    assert issubclass(rosasync.ServerGone, rosasync.CallError)
    assert issubclass(rosasync.ServerGone, ConnectionError)
    assert issubclass(rosasync.InvalidServiceName, ValueError)
    assert issubclass(rosasync.UsageError, RuntimeError)


def test_without_rclpy_it_imports_and_says_what_is_missing() -> None:
    program = """
import asyncio, sys
sys.modules["rclpy"] = None
import rosasync
async def main():
    async with rosasync.Session("x"):
        pass
try:
    asyncio.run(main())
except ImportError as error:
    print(error)
"""
    process = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "rosasync[jazzy]" in process.stdout
    assert "/opt/ros" in process.stdout
    assert process.stderr == ""


def test_importing_it_imports_nothing_of_ros() -> None:
    program = "import rosasync, sys; print([m for m in sys.modules if m.startswith('rclpy')])"
    process = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert process.stdout.strip() == "[]"


def test_it_is_typed() -> None:
    assert (PACKAGE / "py.typed").is_file()


def _is_empty(module: ModuleType) -> bool:
    source = inspect.getsource(module) if module.__file__ else ""
    return not [node for node in ast.parse(source).body if not isinstance(node, ast.Expr)]
