"""Parameter files, against stock nodes that are started with ``--params-file``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from rosasync import Session
from rosasync._core.parameter_files import read_file, write_file
from rosasync._core.safe_yaml import YamlError
from rosasync.parameters import ParameterClient, _read
from tests.support.managed import NodesProcess
from tests.support.started import NAME, Refused, StartedProcess, typed

SCALARS = [
    # Numbers, and what looks like one.
    *("5e-06", "1:30", "1_000", "123E5", "1e5", "010", "08", "09.5", "-010", "+5", "-3"),
    *("0x1F", "0X1f", "0x", "0xg", "0b101", "0o17", "1.", ".5", ".", "-.5", "1.5.2", "1,5", "1e"),
    *("9223372036854775807", "9223372036854775808", "-9223372036854775808", "0x8000000000000000"),
    *("1e308", "1e309", "-1e309", "1e-307", "1e-310", "5e-324", "1e-400", "0e-400", "0.0", "-0.0"),
    *("0x1p3", "0x1p-1074", "0x1p-1075", "0x1p2000", "0x.8", "0x1.8p1", "1p3", "1f", "1d5", "1L"),
    *("2.2250738585072014e-308", "2.225073858507201e-308", "1" * 400, "0." + "0" * 400 + "1"),
    *(".inf", "-.inf", "+.inf", ".Inf", ".INF", ".iNF", ".nan", ".NaN", "-.nan", "+.nan"),
    *("inf", "-Infinity", "INF", "infinit", "nan", "NAN", "-nan", "nan()", "nan(1_a)", "nan(-)"),
    # Words.
    *("y", "Y", "yes", "Yes", "YES", "yEs", "n", "no", "on", "On", "ON", "oN", "off", "Off"),
    *("true", "True", "TRUE", "tRUE", "false", "False", "FALSE", "t", "f", "~", "null", "None"),
    *("2024-01-01", "2024-01-01T00:00:00Z", "=", "<<", "a b", "a#b", "a # b", "grüß dich", "☃"),
    # Quotes, tags, anchors, blocks.
    *("'1'", '"on"', "''", '""', '"\\x31"', '"a\\0b"', "'it''s'", "!!str 5", "!!str on", "! 5"),
    *("!!int '5'", "!!int 5", "!!float 5", "!!bool x", "!!binary AA==", "!mine 5", "&a 5", "&a on"),
    *("|\n      5", "|-\n      5", "|-\n      on", ">\n      a\n      b", "|2-\n       5"),
    *("|-\n\n\n      5", ">-\n      1.5", '"a\n\n      b"'),
]

LISTS = [
    *("[1, 2]", "[1, 010, 0x1F]", "[1, 2.5]", "[1.0, 2]", "[1.0, .inf, -.nan]", "[1, on]", "[on]"),
    *("[on, y, 'on']", "[y, no, TRUE]", "[1e5, x]", "['1e5', x]", "[x, ~, null]", "['1', 'on']"),
    *("[5e-06]", "[5e-324]", "[1.0, 1e400]", "[[1, 2]]", "[[1], [2]]", "[1, [2]]", "[[]]", "[]"),
    *("[&a 1, 2]", "[&a 1, *a]", "[1, {b: 2}]", "[{b: 1}, 2]", "[!!str 1, x]", "[1, ]", "[,]"),
    *("\n    - 1\n    - 2", "\n    - 1\n    -", "\n    - - 1\n    - 2", "[1, 9223372036854775808]"),
]

FILES = [
    *("a: 1\n    a: x", "a: x\n    a: 1", "a: 1.5\n    a: [1]", "a: [1, 2]\n    a: [3]"),
    *("a: 1\n    a: {b: x}", "a: {b: 1}\n    a.b: 2", "a.b: 1\n    a: {b: 2}", "a: {b: 1, b: 2}"),
    *("a: {b: {c: 1, d: {e: 2}}, f: 3}", "a: {b.c: {d: 1}, e: 2}", "a.b: {c: 1}\n    d: 2"),
    *(
        "a: {}",
        "a: {}\n    b: 1",
        "a: {b: {}}",
        "a: {b: []}",
        "{}",
        "a:",
        "a: {b: }",
        "? a\n    : 1",
    ),
    *("? [a]\n    : 1", "? {a: b}\n    : 1", "5: 1\n    on: 2\n    ~: 3", "'a b': 1", "'': 1"),
    *('"a\\0b": 1', "a: &x 1\n    b: *x", "a: &x {b: 1}\n    <<: *x", "ros__parameters: {a: 1}"),
]

DOCUMENTS = [
    *("", "a", "a: 1", "- a", "[]", "# nothing", "---\n---\n", "NODE: {ros__parameters: {}}"),
    *("NODE: {ros__parametersX: {a: 1}}", "NODE: {ros__parameters: {a: 1}, x: 1}", "NODE: {x: 1}"),
    *("ros__parameters: {a: 1}", "x y: {ros__parameters: {a: 1}}", "5: {ros__parameters: {a: 1}}"),
    "NODE: {ros__parameters: {a: 1}}\n---\nNODE: {ros__parameters: {b: 2}}",
    "NODE: {ros__parameters: {a: 1}}\nNODE: {ros__parameters: {a: 2}}",
    "stock: {started: {ros__parameters: {a: 1}}}\nNODE: {ros__parameters: {a: 2}}",
    "NODE: {ros__parameters: {a: 2}}\nstock: {started: {ros__parameters: {a: 1}}}",
    "/stock: {/started: {ros__parameters: {a: 1}}}",
    "stock/: {started: {ros__parameters: {a: 1}}}",
    "/**: {ros__parameters: {a: 1, b: 1}}\nNODE: {ros__parameters: {a: 2}}",
    "NODE: {ros__parameters: {a: 2}}\n/**: {ros__parameters: {a: 1, b: 1}}",
    "/*: {ros__parameters: {a: 1}}",
    "/*/started: {ros__parameters: {a: 1}}",
    "/*/*: {ros__parameters: {a: 1}}",
    "/**/*: {ros__parameters: {a: 1}}",
    "/**/started: {ros__parameters: {a: 1}}",
    "/stock/**: {ros__parameters: {a: 1}}",
    "/**/stock: {ros__parameters: {a: 1}}",
    "/sto*: {ros__parameters: {a: 1}}",
    "'**': {ros__parameters: {a: 1}}",
    "NODE: {ros__parameters: {a: 1}}\n/other: {ros__parameters: {b: []}}",
    "NODE: {ros__parameters: {a: 1}}\n/other: {ros__parameters: {b: [1, x]}}",
    "NODE: {ros__parameters: {a: 1}}\nx: [",
]


@pytest.fixture(scope="module")
def stock(own_domain: None) -> Iterator[StartedProcess]:
    """A process that starts a node for each file."""
    with StartedProcess() as stock:
        yield stock


@pytest.fixture(scope="module")
def nodes(own_domain: None) -> Iterator[NodesProcess]:
    """A process of stock nodes to load files into."""
    with NodesProcess() as nodes:
        yield nodes


def check(stock: StartedProcess, tmp_path: Path, text: str | bytes) -> dict[str, Any] | None:
    """Check that rosasync reads a file as a node that is started with it; return the values."""
    data = text.encode() if isinstance(text, str) else text
    file = tmp_path / "read.yaml"
    file.write_bytes(data)
    found, error = read(file)
    expected, refused = start(stock, data)
    if refused:
        # Newer versions of libyaml, such as PyYAML's, allow a colon in [a:b].
        newer = "Error parsing a event" in refused and b":" in data
        assert error or newer, (text, refused, found)
        return None
    # A node starts with a file that has nothing for it.
    nothing = not expected and re.search("no parameters for|no node in it", error)
    assert nothing or (typed(found), error) == (expected, ""), text
    return found


def read(file: Path) -> tuple[dict[str, Any], str]:
    """Return what rosasync reads for the node `NAME`, or the error."""
    try:
        return _read(str(file), NAME, True), ""
    except ValueError as error:
        return {}, str(error)


def start(stock: StartedProcess, file: bytes) -> tuple[dict[str, Any], str]:
    """Return what a stock node has, or why it did not start."""
    try:
        return stock.start(file), ""
    except Refused as error:
        return {}, str(error)


def below(text: str) -> str:
    """Return a file with these parameters."""
    return f"{NAME}:\n  ros__parameters:\n    {text}"


def test_each_scalar(stock: StartedProcess, tmp_path: Path) -> None:
    for text in SCALARS:
        assert check(stock, tmp_path, below(f"a: {text}\n")) is not None, text
        check(stock, tmp_path, below(f"a: {text}"))


@pytest.mark.parametrize("text", LISTS)
def test_each_list(stock: StartedProcess, tmp_path: Path, text: str) -> None:
    check(stock, tmp_path, below(f"a: {text}"))


@pytest.mark.parametrize("text", FILES)
def test_names_and_mappings(stock: StartedProcess, tmp_path: Path, text: str) -> None:
    check(stock, tmp_path, below(text))


@pytest.mark.parametrize("text", DOCUMENTS)
def test_nodes_and_documents(stock: StartedProcess, tmp_path: Path, text: str) -> None:
    check(stock, tmp_path, text.replace("NODE", NAME))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "latin-1"])
def test_encodings(stock: StartedProcess, tmp_path: Path, encoding: str) -> None:
    check(stock, tmp_path, below("a: grüß dich").encode(encoding))


relaxed = settings(
    deadline=None,
    max_examples=60,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        # Each bridge is an executor of its own, for hypothesis.
        HealthCheck.differing_executors,
    ],
)

numbers = st.one_of(
    st.integers().map(str),
    st.floats().map(repr),
    st.floats(width=16).map(float.hex),
    st.from_regex(r"[-+]?0?[0-9]{0,20}\.?[0-9]{0,20}([eE][-+]?[0-9]{1,4})?", fullmatch=True),
    st.from_regex(
        r"[-+]?0[xX][0-9a-fA-F]{0,18}\.?[0-9a-fA-F]{0,3}(p-?[0-9]{1,4})?", fullmatch=True
    ),
)
# Without "!": libyaml's versions disagree about the end of a tag, as in [!, 0].
letters = st.text("0123456789abcdefxXpPeE+-._ infatyYoOsN:~()'\"#", min_size=1, max_size=12)
plain = st.one_of(numbers, letters, st.sampled_from([s for s in SCALARS if "\n" not in s]))


def is_scalar(text: str) -> bool:
    try:
        events = [type(event) for event in yaml.parse(f"a: {text}\n")]
    except yaml.YAMLError:
        return False
    collections = (yaml.SequenceStartEvent, yaml.AliasEvent)
    return events.count(yaml.ScalarEvent) == 2 and not any(kind in events for kind in collections)


@relaxed
@given(texts=st.lists(plain.filter(is_scalar), min_size=1, max_size=20))
def test_any_scalars(stock: StartedProcess, tmp_path: Path, texts: list[str]) -> None:
    lines = "\n    ".join(f"p{number}: {text}" for number, text in enumerate(texts))
    check(stock, tmp_path, below(lines))


@relaxed
@given(texts=st.lists(plain.filter(is_scalar), min_size=1, max_size=6), flow=st.booleans())
def test_any_list(stock: StartedProcess, tmp_path: Path, texts: list[str], flow: bool) -> None:
    text = f"[{', '.join(texts)}]" if flow else "".join(f"\n    - {text}" for text in texts)
    check(stock, tmp_path, below(f"a: {text}"))


leaves = st.sampled_from(["1", "2", "x", "1.5", "on", "[1, 2]", "[x]", "[]", "''", "[1.0]"])
trees = st.recursive(
    leaves,
    lambda inner: st.lists(
        st.tuples(st.sampled_from(["a", "b", "c", "a.b", "b.c"]), inner), max_size=4
    ).map(lambda items: "{" + ", ".join(f"{name}: {value}" for name, value in items) + "}"),
    max_leaves=12,
)
mappings = trees.filter(lambda tree: tree.startswith("{"))
names = st.sampled_from([NAME, NAME, "stock/started", "/**", "/*/started", "/other"])


@relaxed
@given(entries=st.lists(st.tuples(names, mappings), min_size=1, max_size=3))
def test_any_file(stock: StartedProcess, tmp_path: Path, entries: list[tuple[str, str]]) -> None:
    lines = [f"{name}: {{ros__parameters: {tree}}}\n" for name, tree in entries]
    check(stock, tmp_path, "".join(lines))


texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)
integers = st.integers(-(2**63), 2**63 - 1)
strings = st.one_of(texts, st.sampled_from([s for s in SCALARS if "\n" not in s]))
values = st.one_of(
    *(scalar for scalar in (st.booleans(), integers, st.floats(), strings)),
    *(
        st.lists(scalar, min_size=1, max_size=4)
        for scalar in (st.booleans(), integers, st.floats(), strings)
    ),
)
parameter_names = st.one_of(
    st.lists(st.sampled_from(["a", "b", "on", "1", ""]), min_size=1, max_size=4).map(".".join),
    st.text("ab.1 :#'\"~ü\n", min_size=1, max_size=6),
).filter(bool)


@relaxed
@given(parameters=st.dictionaries(parameter_names, values, max_size=8))
@example({"a": "123E5", "b": ["1e5", "x"], "c": 5e-324, "d": math.nan, "e": -0.0, "f": 1e16})
@example({".".join("a" * 300): 1, ".".join("a" * 19): 2})
@example({"a": 1, "a.b": 2, "a.b.c": 3, "a..b": 4, ".a": 5, "a.": 6})
def test_what_is_written_is_what_a_node_has(
    stock: StartedProcess, parameters: dict[str, Any]
) -> None:
    text = write_file(NAME, parameters, {})
    assert stock.start(text.encode()) == typed(parameters)
    [(name, found)] = read_file(text.encode()) or [(NAME, {})]
    assert (name, typed(found)) == (NAME, typed(parameters))


@given(parameters=st.dictionaries(st.sampled_from(["a", "on", "a.b"]), strings, min_size=1))
def test_other_readers_of_yaml_find_the_same_texts(parameters: dict[str, str]) -> None:
    tree = yaml.safe_load(write_file(NAME, parameters, {}))[NAME]["ros__parameters"]
    assert {name: tree[name] for name in parameters if "." not in name and name != "a"} == {
        name: value for name, value in parameters.items() if "." not in name and name != "a"
    }


class TestClient:
    """The same through `ParameterClient`, with a node to load into."""

    async def test_load_sets_what_a_started_node_has(
        self, session: Session, nodes: NodesProcess, stock: StartedProcess, tmp_path: Path
    ) -> None:
        node = ParameterClient(session, await nodes.add("undeclared"))
        lines = [f"p{number}: {text}\n" for number, text in enumerate([*SCALARS, "[1, 2]", "[x]"])]
        text = f"{NAME}:\n  ros__parameters:\n    {'    '.join(lines)}"
        expected = stock.start(text.encode())
        file = tmp_path / "all.yaml"
        file.write_text(text.replace(NAME, node.node_name))
        assert typed(await node.load(file)) == expected
        assert typed(await node.get([*expected])) == expected

    async def test_a_started_node_has_what_dump_wrote(
        self, session: Session, nodes: NodesProcess, stock: StartedProcess
    ) -> None:
        node = ParameterClient(session, await nodes.add("undeclared"))
        parameters: dict[str, Any] = {f"text{number}": text for number, text in enumerate(SCALARS)}
        parameters |= {"nan": math.nan, "tiny": 5e-324, "big": 1e16, "texts": ["1e5", "x", "~"]}
        await node.set(parameters | {"bytes": b"\x00\xff"})
        text = await node.dump()
        assert stock.start(text.replace(node.node_name, NAME).encode()) == typed(parameters)

    async def test_dump_names_what_it_leaves_out(
        self, session: Session, nodes: NodesProcess, stock: StartedProcess
    ) -> None:
        node = ParameterClient(session, await nodes.add("undeclared"))
        await node.set({"raw.data": b"\x00\xff", "list": ["x"], "a": 1})
        await node.set("list", [])
        text = await node.dump()
        assert "# raw.data is left out: a parameter file has no byte arrays; it is [0, 255]" in text
        assert "# list is left out: a parameter file has no empty arrays" in text
        assert stock.start(text.replace(node.node_name, NAME).encode()) == {"a": "1"}

    @settings(relaxed, max_examples=15)
    @given(entries=st.lists(mappings, min_size=1, max_size=2))
    async def test_load_of_any_file(
        self,
        session: Session,
        nodes: NodesProcess,
        stock: StartedProcess,
        tmp_path: Path,
        entries: list[str],
    ) -> None:
        text = "".join(f"{NAME}: {{ros__parameters: {tree}}}\n" for tree in entries)
        expected, _ = start(stock, text.encode())
        assume(expected)
        node = ParameterClient(session, await nodes.add("undeclared"))
        file = tmp_path / "any.yaml"
        file.write_text(text.replace(NAME, node.node_name))
        await node.load(file)
        assert typed(await node.get([*expected])) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, on]", "line 3, column 12: 'on' is read as a bool, in a list that begins with an"),
        ("a: *x", r"\*x refers to no anchor"),
        ("a: &x 1\n    b: *x", "line 4, column 8: a parameter file has no aliases"),
        ("a:\n", "it has no value for a"),
    ],
)
def test_what_is_wrong_is_said(text: str, message: str) -> None:
    with pytest.raises(YamlError, match=message):
        read_file(below(text).encode())
