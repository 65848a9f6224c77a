"""The pages of the documentation, followed literally: programs are saved and run as written.

`docs/contributing.md` says what the blocks of a page mean.
"""

from __future__ import annotations

import ast
import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import indent
from typing import Any

import pytest
from sybil import Example, Sybil
from sybil.parsers.markdown import CodeBlockParser

import rosasync
from rosasync._ros.domain import isolate
from tests.support.process import ROOT, ended, first_line, own, profile
from tests.support.project import python_path
from tests.support.servers import running, wait_until_joined
from tests.support.times import LIMIT

DOCS = ROOT / "docs"
EXAMPLES = DOCS / "examples"
NAME = re.compile(r"# (\S+\.py)\n")
SERVERS = {"lamp.py": DOCS / "tutorial.md", "robot.py": DOCS / "how-to" / "ticks.md"}
"""The programs that more than one page runs, and the page that shows them."""

HANDLES: dict[str, type] = {
    "session": rosasync.Session,
    "server": rosasync.ServiceServer,
    "call": rosasync.ServiceCall,
    "proxy": rosasync.AsyncServiceProxy,
    "rosasync": type(rosasync),
}
"""What fragments call an object, and its class."""


def pages() -> list[Path]:
    """Return every page with a console block, and the README."""
    found = [path for path in DOCS.rglob("*.md") if "console\n$" in path.read_text()]
    return [*sorted(found), ROOT / "README.md"]


def name_of(page: Path) -> str:
    """Return the name of a page, or that of its folder."""
    return page.parent.name if page.stem == "README" else page.stem


class Reader:
    """Follows one page in a folder: saves its programs and runs its commands.

    The folder is empty, or that of an example.
    """

    def __init__(self, folder: Path, servers: Servers) -> None:
        self.folder = folder
        self.servers = servers
        self.programs: list[str] = []
        self.run_programs: set[str] = set()
        self.background = ExitStack()
        self.environment: dict[str, str] = {}

    def follow(self, page: Path) -> None:
        sybil = Sybil(
            [CodeBlockParser("python", self.python), CodeBlockParser("console", self.console)]
        )
        with self.background:
            for example in sybil.parse(page).examples():
                example.evaluate()

    def python(self, example: Example) -> None:
        if name := NAME.match(example.parsed):
            (self.folder / name[1]).write_text(example.parsed)
            self.programs.append(name[1])

    def console(self, example: Example) -> None:
        for command, expected in commands(example.parsed):
            words, _, remark = command.partition("  # ")
            program = words.removeprefix("python ")
            if not program.endswith(".py"):
                with in_environment(self.environment):
                    printed = shell(words, self.folder)
                assert matches(printed, expected), f"{command} printed:\n{printed}"
                continue
            self.run_programs.add(program)
            if program in SERVERS:
                self.environment = self.servers.start(program)
            elif "second terminal" in remark:
                path = self.folder / program
                server = until_terminated(path, expected) if expected else running(path)
                with in_environment(self.environment):
                    self.background.enter_context(server)
            else:
                printed = run(self.folder / program, self.environment)
                if order := re.search(r"lines (\d+) to (\d+) in any order", remark):
                    part = slice(int(order[1]) - 1, int(order[2]))
                    printed = with_sorted(printed, part)
                    expected = with_sorted(expected, part)
                assert matches(printed, expected), f"{command} printed:\n{printed}"


@contextmanager
def in_environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Start processes of a page where its shared server is, if it has one."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables.items():
            patch.setenv(name, value)
        yield


class Servers:
    """The stock servers that the pages share, each started when a page first needs it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._environments: dict[str, dict[str, str]] = {}
        self._stack = ExitStack()

    def start(self, program: str) -> dict[str, str]:
        """Start a server in a ROS domain of its own; return the environment of its clients."""
        if program not in self._environments:
            path = self._folder / program
            path.write_text(program_of(SERVERS[program], program))
            self._environments[program] = environment = another_domain()
            environment = environment | self._stack.enter_context(profile())
            process = subprocess.Popen(
                (sys.executable, str(path)), env=os.environ | environment, stderr=subprocess.DEVNULL
            )
            self._stack.enter_context(ended(process))
            wait_until_joined(process, int(environment["ROS_DOMAIN_ID"]))
        return self._environments[program]

    def close(self) -> None:
        self._stack.close()


def another_domain() -> dict[str, str]:
    """Claim another ROS domain, so that a page sees its own servers only."""
    own = os.environ["ROS_DOMAIN_ID"]
    domain = isolate()
    os.environ["ROS_DOMAIN_ID"] = own
    return {"ROS_DOMAIN_ID": str(domain)}


@contextmanager
def until_terminated(program: Path, expected: str) -> Iterator[None]:
    """Run a program until SIGTERM; check what it prints before and after, and its exit code."""
    process = subprocess.Popen((sys.executable, str(program)), stdout=subprocess.PIPE, text=True)
    with ended(process):
        assert process.stdout is not None
        first = first_line(process.stdout)
        yield
        process.terminate()
        rest = own(process.stdout.read())
        assert process.wait(LIMIT) == 0
    assert first + rest == expected


def shell(command: str, folder: Path) -> str:
    """Run any other command of a page, with the folder as home, and the commands of this Python."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    rosasync_command = f'rosasync() {{ "{sys.executable}" -m rosasync "$@"; }}; '
    with TemporaryDirectory() as site:
        variables = {"HOME": str(folder), "PATH": path, "PYTHONPATH": python_path(Path(site))}
        done = subprocess.run(
            ("bash", "-c", rosasync_command + command),
            cwd=folder,
            env=os.environ | variables,
            stdout=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    return own(done.stdout)


def run(program: Path, environment: Mapping[str, str]) -> str:
    """Run a program as the page says, with warnings about unclosed things as errors."""
    done = subprocess.run(
        (sys.executable, "-W", "error::ResourceWarning", program.name),
        cwd=program.parent,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        text=True,
        timeout=120,
        check=True,
    )
    return own(done.stdout)


def program_of(page: Path, name: str) -> str:
    """Return the text of a program that a page shows."""
    return next(code for code in python_blocks(page) if code.startswith(f"# {name}\n"))


def python_blocks(page: Path) -> list[str]:
    return [
        str(example.parsed)
        for example in Sybil([CodeBlockParser("python", lambda _: None)]).parse(page).examples()
    ]


def commands(block: str) -> Iterator[tuple[str, str]]:
    """Split a console block into its commands, each with the output that follows it."""
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command, output


def matches(printed: str, expected: str) -> bool:
    """Compare an output with the page, in which ``...`` stands for any text."""
    pattern = ".*".join(re.escape(part) for part in expected.rstrip("\n").split("..."))
    return re.fullmatch(pattern, printed.rstrip("\n"), re.DOTALL) is not None


def with_sorted(text: str, part: slice) -> str:
    """Sort some lines of a text."""
    lines = text.splitlines()
    lines[part] = sorted(lines[part])
    return "\n".join(lines)


pytestmark = pytest.mark.usefixtures("own_domain")


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    servers = Servers(tmp_path_factory.mktemp("servers"))
    yield servers
    servers.close()


@pytest.mark.slow
@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_the_page_works_as_written(page: Path, tmp_path: Path, servers: Servers) -> None:
    if EXAMPLES in page.parents:
        shutil.copytree(page.parent, tmp_path, dirs_exist_ok=True)
    reader = Reader(tmp_path, servers)
    reader.follow(page)
    imported = {
        name.removesuffix(".py")
        for name in reader.programs
        if any(f"from {name.removesuffix('.py')} import" in code for code in python_blocks(page))
    }
    not_run = set(reader.programs) - reader.run_programs
    assert {name.removesuffix(".py") for name in not_run} <= imported


@pytest.mark.parametrize("page", [*sorted(DOCS.rglob("*.md")), ROOT / "README.md"], ids=name_of)
def test_every_fragment_compiles_and_its_names_exist(page: Path) -> None:
    for code in python_blocks(page):
        tree = compile(code, str(page), "exec", ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        assert isinstance(tree, ast.Module)
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                owner = HANDLES.get(node.value.id)
                found = rosasync if node.value.id == "rosasync" else owner
                assert owner is None or has(found, node.attr), f"{node.value.id}.{node.attr}"
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rosasync"):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, alias.name) for alias in node.names)


def has(owner: Any, name: str) -> bool:
    """Return whether an object has an attribute or a submodule of this name."""
    return hasattr(owner, name) or (
        owner is rosasync and (Path(str(rosasync.__file__)).parent / f"{name}.py").exists()
    )


@pytest.mark.parametrize("page", sorted(EXAMPLES.glob("*/README.md")), ids=name_of)
def test_the_page_of_an_example_quotes_and_links_its_files(page: Path) -> None:
    programs = {path.name: path.read_text() for path in page.parent.glob("*.py")}
    for code in python_blocks(page):
        quotes = {indent(code, depth * "    ") for depth in range(3)}
        assert any(quote in program for program in programs.values() for quote in quotes), code
    text = page.read_text()
    assert not [name for name in programs if f"[{name}]({name})" not in text]
    assert page.parent.name in (EXAMPLES / "index.md").read_text()


def test_the_commands_of_the_readme_are_the_ones_that_are_checked() -> None:
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert [shlex.split(block)[-2:] for block in blocks] == [
        [".venv/bin/rosasync", "demo"],
        ["-n", "4"],
    ]


def test_the_robot_has_a_dozen_services() -> None:
    robot = program_of(SERVERS["robot.py"], "robot.py")
    assert len([line for line in robot.splitlines() if '": (' in line]) == 12


def test_the_plot_of_the_readme_shows_its_table() -> None:
    readme = (ROOT / "README.md").read_text()
    plot = (DOCS / "diagrams" / "demo.svg").read_text()
    rows = [line.split("|") for line in readme.splitlines() if re.match(r"\| .* \| \d+ \|", line)]
    assert len(rows) == 4
    for _, _, _, *figures, _, _ in rows:
        assert len(figures) == 4
        assert all(f">{figure.strip()}<" in plot for figure in figures), figures


@pytest.mark.parametrize("picture", sorted((DOCS / "diagrams").glob("*.svg")), ids=lambda p: p.stem)
def test_the_texts_of_a_diagram_are_readable(picture: Path) -> None:
    """No text is cut off by the edge or by another one, as far as its length can be estimated."""
    svg = picture.read_text()
    (width,) = re.findall(r'<svg[^>]* width="(\d+)"', svg)
    rows: defaultdict[float, list[tuple[float, float, str]]] = defaultdict(list)
    for classes, x, y, text in re.findall(
        r'<text(?: class="([^"]*)")? x="([\d.]+)" y="([\d.]+)">([^<]+)</text>', svg
    ):
        length = len(text) * (7.8 if "code" in classes else 6 if "small" in classes else 6.5)
        shift = length if "end" in classes else length / 2 if "mid" in classes else 0.0
        rows[float(y)].append((float(x) - shift, float(x) - shift + length, text))
    assert rows
    for row in rows.values():
        row.sort()
        assert 0 <= row[0][0] < row[-1][1] <= float(width), row
        assert all(one[1] < two[0] for one, two in pairwise(row)), row


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_the_pictures_of_the_first_pages_fit_a_phone(page: str) -> None:
    """At the 360 px of a phone, text of 13 px in a picture of 500 px is 9 px high."""
    path = ROOT / page
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+\.svg)\)", path.read_text())
    assert pictures
    for picture in pictures:
        (width,) = re.findall(r'<svg[^>]* width="(\d+)"', (path.parent / picture).read_text())
        assert int(width) <= 500, picture


def test_siblings_have_titles_alike_and_are_listed() -> None:
    how_to = {page.name: page.read_text() for page in (DOCS / "how-to").glob("*.md")}
    index = how_to.pop("index.md")
    assert [name for name, text in how_to.items() if not text.startswith("# How to ")] == []
    assert [name for name in how_to if f"]({name})" not in index] == []
    examples = [page.read_text() for page in (DOCS / "examples").glob("*/README.md")]
    assert [text[:40] for text in examples if not text.startswith("# A ")] == []


def test_the_links_of_the_readme_lead_somewhere() -> None:
    links = re.findall(r"\]\((docs/[^)#]+)", (ROOT / "README.md").read_text())
    assert len(links) > 10
    assert not [link for link in links if not (ROOT / link).exists()]
