"""The layout of the package: what the design page says of it is true."""

from __future__ import annotations

import ast
import re
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import yaml

import rosasync
from tests.support.process import ROOT

PACKAGE = Path(rosasync.__file__).parent
DESIGN = ROOT / "docs" / "explanation" / "design.md"
FILES = {
    ".".join(("rosasync", *file.relative_to(PACKAGE).with_suffix("").parts)): file
    for file in sorted(PACKAGE.rglob("*.py"))
}
"""Each module's file, by its dotted name; a package's name ends in ``__init__``."""
INNER = ("_core", "_client", "_server", "_actions")
"""The rooms between the public modules and the rooms below, which never import these."""


def test_only_ros_imports_rclpy() -> None:
    offenders = [
        f"{file.relative_to(PACKAGE)}:{statement.lineno}"
        for file in FILES.values()
        if file.relative_to(PACKAGE).parts[0] != "_ros"
        and file.relative_to(PACKAGE) != Path("_demo/stock.py")
        for statement in _imports(ast.parse(file.read_text()), typing=False)
        if any(name.partition(".")[0] == "rclpy" for name in _names(statement))
    ]
    assert not offenders


def test_actions_are_not_those_of_rclpy() -> None:
    # Its client in Jazzy's packages loses goals: see docs/faq.md.
    offenders = [
        f"{name}:{statement.lineno}"
        for name, file in FILES.items()
        for statement in _imports(ast.parse(file.read_text()), typing=True)
        if any(found.startswith("rclpy.action") for found in _names(statement))
    ]
    assert not offenders


@pytest.mark.parametrize("room", INNER)
def test_the_inside_imports_no_user_of_the_public_api(room: str) -> None:
    above = ("rosasync._cli.", "rosasync._demo.", "rosasync.testing.", "rosasync.behaviours")
    offenders = [
        f"{name} imports {found}"
        for name, file in FILES.items()
        if name.startswith(f"rosasync.{room}.")
        for found in _imported_modules(file)
        if found.startswith(above)
    ]
    assert not offenders


def test_imports_make_no_circle() -> None:
    # Also those for type checkers: who has to know whom is the same question.
    graph = {
        name: {found for found in _imported_modules(file) if found != name}
        for name, file in FILES.items()
        if name != "rosasync.__init__"
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"imports make a circle: {' -> '.join(error.args[1])}")


def test_no_module_is_longer_than_600_lines() -> None:
    lengths = {name: len(file.read_text().splitlines()) for name, file in FILES.items()}
    assert {name: lines for name, lines in lengths.items() if lines > 600} == {}


def test_no_class_has_more_than_28_methods() -> None:
    counts = {
        f"{name}.{node.name}": sum(map(_is_method, node.body))
        for name, file in FILES.items()
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.ClassDef)
    }
    assert {name: methods for name, methods in counts.items() if methods > 28} == {}


def _is_method(statement: ast.stmt) -> bool:
    """Whether this defines a method: an overload and a setter are further forms of one."""
    if not isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
        return False
    decorators = [ast.unparse(decorator) for decorator in statement.decorator_list]
    return "overload" not in decorators and not any(
        decorator.endswith(".setter") for decorator in decorators
    )


def test_the_design_page_lists_every_file() -> None:
    listed = _listed_files()
    there = {
        str(file.relative_to(PACKAGE))
        for file in FILES.values()
        if file.relative_to(PACKAGE).parts[0] not in ("_cli", "_demo", "_ros")
        and len(file.relative_to(PACKAGE).parts) <= 2
        and file.name not in ("__init__.py", "__main__.py")
    }
    assert sorted(listed - there) == [], "the page lists what is not there"
    assert sorted(there - listed) == [], "the page lacks"


def _listed_files() -> set[str]:
    """The files of the page's first tree, in which a folder's own are indented below it.

    Of a folder within a folder, the page says what it is for.
    """
    tree = DESIGN.read_text().partition("```text\nrosasync/\n")[2].partition("```")[0]
    listed, folder = set(), ""
    for line in tree.splitlines():
        if found := re.match(r"  (\w+/)", line):
            folder = found[1]
        elif re.match(r"  \w", line):
            folder = ""
        for name in re.findall(r"(?:^ +|    )(\w+\.py)\b", line):
            if name not in ("__init__.py", "__main__.py"):
                listed.add(folder + name)
    return listed


def _imported_modules(file: Path) -> set[str]:
    """The modules of rosasync that a file imports, also for type checkers only."""
    found = set()
    for statement in _imports(ast.parse(file.read_text()), typing=True):
        if isinstance(statement, ast.ImportFrom):
            module = statement.module or ""
            children = {f"{module}.{alias.name}" for alias in statement.names} & FILES.keys()
            found |= children or {module}
        else:
            found |= {alias.name for alias in statement.names}
    return found & FILES.keys()


def _imports(tree: ast.Module, *, typing: bool) -> list[ast.Import | ast.ImportFrom]:
    """The imports of a module; without ``typing``, only those that run."""
    typing_only = {
        id(child)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for child in ast.walk(node)
    }
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom) and (typing or id(node) not in typing_only)
    ]


def _names(statement: ast.Import | ast.ImportFrom) -> list[str]:
    if isinstance(statement, ast.Import):
        return [alias.name for alias in statement.names]
    return [statement.module or ""]


def test_the_version_is_the_same_everywhere() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / ".conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == project["version"]
    assert f"## {project['version']}, " in (ROOT / "docs" / "changelog.md").read_text()


def test_the_recipe_has_the_dependencies_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / ".conda" / "recipe.yaml").read_text())["requirements"]
    assert {f"python{project['requires-python']}", *project["dependencies"]} == {
        line.replace(" ", "") for line in recipe["run"]
    }
    cli = project["optional-dependencies"]["cli"]
    assert {line.lower() for line in cli} == {
        line.replace(" ", "") for line in recipe["run_constraints"]
    }
