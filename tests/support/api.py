"""The public names and signatures of the package, one a line, as `tests/public_api.txt` has them.

``python -m tests.support.api`` writes that file anew, if the changelog has changed since.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from typing import Any

import griffe

from tests.support.process import ROOT

__all__ = ["changelog_digest", "public_api", "recorded"]

MODULES = (
    "rosasync",
    "rosasync.actions",
    "rosasync.behaviours",
    "rosasync.lifecycle",
    "rosasync.opentelemetry",
    "rosasync.parameters",
    "rosasync.testing",
    "rosasync.typing",
)
OBTAINED = {
    "ActionServer",
    "ClientPool",
    "Goal",
    "LeasedClient",
    "Portal",
    "ServerGoal",
    "ServiceCall",
    "ServiceClient",
    "ServiceServer",
}
"""Classes that only a session constructs."""
RECORD = ROOT / "tests" / "public_api.txt"
CHANGELOG = ROOT / "docs" / "changelog.md"


def public_api() -> list[str]:
    """Return a line for each public name: its path, and its signature or value."""
    package = griffe.load("rosasync", search_paths=[ROOT])
    return sorted({line for name in MODULES for line in _module(package, name)})


def changelog_digest() -> str:
    """Return what tells one state of the changelog from another."""
    return hashlib.sha256(CHANGELOG.read_bytes()).hexdigest()[:16]


def recorded() -> tuple[str, list[str]]:
    """Return the recorded state of the changelog, and the lines recorded with it."""
    head, *lines = RECORD.read_text().splitlines()
    return head.removeprefix("changelog "), lines


def _module(package: Any, name: str) -> Iterator[str]:
    module = package if name == "rosasync" else package[name.removeprefix("rosasync.")]
    for exported in sorted(module.exports or ()):
        yield from _thing(f"{name}.{exported}", module[str(exported)])


def _thing(path: str, thing: Any) -> Iterator[str]:
    if thing.is_function:
        for overload in getattr(thing, "overloads", None) or [thing]:
            returns = f" -> {overload.returns}" if overload.returns is not None else ""
            yield f"{path}({', '.join(map(_parameter, overload.parameters))}){returns}"
    elif thing.is_class:
        yield f"{path}({', '.join(map(str, thing.bases))})"
        for name, member in sorted(thing.all_members.items()):
            constructor = name == "__init__" and thing.name not in OBTAINED
            if constructor or not name.startswith("_"):
                yield from _thing(f"{path}.{name}", member)
    elif thing.is_attribute:
        yield f"{path}: {thing.annotation}" if thing.annotation else f"{path} = {thing.value}"


def _parameter(parameter: griffe.Parameter) -> str:
    mark = {
        griffe.ParameterKind.var_positional: "*",
        griffe.ParameterKind.var_keyword: "**",
        griffe.ParameterKind.keyword_only: "(keyword) ",
    }.get(parameter.kind or griffe.ParameterKind.positional_or_keyword, "")
    annotation = f": {parameter.annotation}" if parameter.annotation else ""
    default = f" = {parameter.default}" if parameter.default is not None else ""
    return f"{mark}{parameter.name}{annotation}{default}"


def _main() -> None:
    lines = public_api()
    if RECORD.exists():
        digest, before = recorded()
        if before == lines:
            return
        if digest == changelog_digest():
            sys.exit(f"The public API has changed: say so in {CHANGELOG.relative_to(ROOT)} first.")
    RECORD.write_text("\n".join([f"changelog {changelog_digest()}", *lines]) + "\n")


if __name__ == "__main__":
    _main()
