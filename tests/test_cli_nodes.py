"""``rosasync param`` and ``rosasync lifecycle`` against stock nodes in another process."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from rosasync import ServiceCall, Session
from rosasync._cli.param_values import read_value
from rosasync._core.safe_yaml import YamlError
from rosasync.parameters import ParameterType
from tests.support.command import DISCOVERY, LOOK, rosasync
from tests.support.managed import NodesProcess
from tests.support.process import ROOT, own
from tests.support.times import LIMIT, TICK


@pytest.fixture(scope="module")
def nodes(own_domain: None) -> Iterator[NodesProcess]:
    """A process of stock nodes, for all tests of this module."""
    with NodesProcess() as nodes:
        yield nodes


async def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return await asyncio.to_thread(rosasync, *arguments)


async def printed(*arguments: str) -> str:
    done = await run(*arguments)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


async def hang(_: ServiceCall) -> None:
    """Handle a request that is never answered."""
    await asyncio.Event().wait()


@pytest.mark.slow
class TestParam:
    async def test_list(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        names = (await printed("param", "list", node)).splitlines()
        assert {"bool", "arm.left.speed"} <= {*names}
        assert names == sorted(names)
        [line] = (await printed("param", "list", node, "--json")).splitlines()
        assert json.loads(line) == {"node": node, "parameters": names}

    async def test_a_node_that_is_not_there(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        done = await run("param", "get", f"{node}m", "bool", "--timeout", DISCOVERY)
        assert (done.returncode, done.stdout) == (3, "")
        assert f"{node}m: no node of this name after" in done.stderr
        assert f"; there are {node}" in done.stderr
        done = await run("lifecycle", "get", node, "--timeout", DISCOVERY)
        assert (done.returncode, done.stdout) == (3, "")
        assert f"{node}: this node has no lifecycle" in done.stderr

    async def test_list_of_all_nodes(self, nodes: NodesProcess) -> None:
        node = await nodes.add("unset")
        assert f"{node}:\n  first\n  last\n" in await printed("param", "list", *LOOK)
        text = await printed("param", "list", "--json", *LOOK)
        found = [json.loads(line) for line in text.splitlines()]
        assert "first" in {one["node"]: one["parameters"] for one in found}[node]

    async def test_get_and_set(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        assert await printed("param", "get", node, "double") == "0.5\n"
        assert await printed("param", "set", node, "double", "2") == "double: 2.0\n"
        assert await printed("param", "set", node, "mode", "on") == "mode: 'on'\n"
        assert await printed("param", "get", node, "mode") == "on\n"
        several = ("param", "get", node, "double", "byte_array", "string_array")
        values = {"double": 2.0, "byte_array": [0, 255], "string_array": ["a", ""]}
        assert yaml.safe_load(await printed(*several)) == values
        assert json.loads(await printed(*several, "--json")) == values

    async def test_set_what_looks_like_an_option(self, nodes: NodesProcess) -> None:
        node = await nodes.add("undeclared")
        assert await printed("param", "set", node, "rate", "-3") == "rate: -3\n"
        assert await printed("param", "set", node, "rate", "-.5", "--json") == '{"rate": -0.5}\n'
        assert await printed("param", "set", "--", node, "name", "--help") == "name: --help\n"
        done = await run("param", "set", node, "rate", "1", "--tiemout", "3")
        assert done.returncode == 2
        assert "--tiemout" in done.stderr

    async def test_set_by_the_type(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        unset = await nodes.add("unset")
        for name, text, value in (
            ("any", "1.5", "1.5"),
            ("any", "010", "8"),
            ("integer", "010", "8"),
            ("double_array", "[1, 2]", "[1.0, 2.0]"),
        ):
            assert await printed("param", "set", node, name, text) == f"{name}: {value}\n"
        assert await printed("param", "set", unset, "texts", "[]") == "texts: []\n"
        done = await run("param", "set", node, "any", "[1, on]")
        assert (done.returncode, done.stdout) == (2, "")
        assert "'on' is read as a bool" in done.stderr

    async def test_one_silent_node_of_several(self, nodes: NodesProcess) -> None:
        other = await nodes.add("unset")
        options = ("--timeout", DISCOVERY, "--wait", DISCOVERY)
        async with (
            Session("its_host") as session,
            session.serve("rcl_interfaces/srv/ListParameters", "/silent/list_parameters", hang),
            session.serve("lifecycle_msgs/srv/GetState", "/silent/get_state", hang),
        ):
            listed = await run("param", "list", *options)
            states = await run("lifecycle", "nodes", *options)
        assert f"{other}:\n  first\n" in listed.stdout
        assert "/silent:" not in listed.stdout
        assert "/silent/list_parameters" in listed.stderr
        assert "/silent: unknown [0]\n" in states.stdout
        assert "/silent/get_state" in states.stderr
        assert (listed.returncode, states.returncode) == (4, 4)

    async def test_delete(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        assert await printed("param", "delete", node, "any") == ""
        text = await printed("param", "delete", await nodes.add("parameters"), "any", "--json")
        assert json.loads(text)["deleted"] == "any"
        done = await run("param", "get", node, "any")
        assert done.returncode == 1
        assert done.stderr == f"rosasync: {node}: 'any': it is not declared, or has no value\n"

    async def test_describe(self, nodes: NodesProcess) -> None:
        node = await nodes.add("parameters", "arm")
        fields = yaml.safe_load(await printed("param", "describe", node, "volume"))
        assert fields["type"] == "integer"
        assert fields["range"] == {"minimum": 0, "maximum": 11, "step": 1}
        lines = (await printed("param", "describe", node, "gain", "serial", "--json")).splitlines()
        assert [json.loads(line)["read_only"] for line in lines] == [False, True]

    async def test_dump_and_load(self, nodes: NodesProcess, tmp_path: Path) -> None:
        node = await nodes.add("parameters", "arm")
        file = tmp_path / "arm.yaml"
        text = await printed("param", "dump", node)
        file.write_text(text.replace("volume: 5", "volume: 6"))
        assert "volume: 6\n" in await printed("param", "load", node, str(file))
        fields = json.loads(await printed("param", "dump", node, "--json"))
        assert fields["node"] == node
        assert fields["parameters"]["byte_array"] == [0, 255]
        file.write_text("/**: {ros__parameters: {volume: 7}}")
        assert await printed("param", "load", node, str(file), "--use-wildcard") == "volume: 7\n"

    async def test_what_is_refused_or_wrong(self, nodes: NodesProcess, tmp_path: Path) -> None:
        node = await nodes.add("parameters", "arm")
        for arguments, code, message in (
            (("set", node, "serial", "B2"), 1, "'serial': Trying to set a read-only parameter"),
            (("set", node, "mode", "off"), 1, "no such mode: off"),
            (("set", node, "integer", str(2**63)), 2, "out of the range of int64"),
            (("load", node, str(tmp_path / "none.yaml")), 2, "No such file"),
            (("get", "/absent", "a", "--timeout", str(TICK)), 3, "/absent"),
            (("get", node), 2, "NAME"),
        ):
            done = await run("param", *arguments)
            assert (done.returncode, done.stdout) == (code, ""), arguments
            assert message in done.stderr
            assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("1", ParameterType.DOUBLE, 1.0),
        ("010", ParameterType.DOUBLE, 8.0),
        ("1e-3", ParameterType.DOUBLE, 0.001),
        (".inf", ParameterType.DOUBLE, float("inf")),
        ("-3", ParameterType.INTEGER, -3),
        ("010", ParameterType.INTEGER, 8),
        ("1_000", ParameterType.INTEGER, "1_000"),
        ("true", ParameterType.BOOL, True),
        ("y", ParameterType.BOOL, True),
        ("true", ParameterType.STRING, "true"),
        ("'true'", ParameterType.STRING, "true"),
        ("[1, 2]", ParameterType.STRING, "[1, 2]"),
        ("a: b", ParameterType.STRING, "a: b"),
        ("[", ParameterType.STRING, "["),
        ("#fff", ParameterType.STRING, "#fff"),
        ("*x", ParameterType.STRING, "*x"),
        ("", ParameterType.NOT_SET, ""),
        ("7", ParameterType.NOT_SET, 7),
        ("010", ParameterType.NOT_SET, 8),
        ("5e-06", ParameterType.NOT_SET, 5e-06),
        ("1:30", ParameterType.NOT_SET, "1:30"),
        ("on", ParameterType.NOT_SET, True),
        ("[]", ParameterType.NOT_SET, []),
        ("[1, 2]", ParameterType.NOT_SET, [1, 2]),
        ("- 1.0\n- 2.5", ParameterType.NOT_SET, [1.0, 2.5]),
        ("[]", ParameterType.STRING_ARRAY, []),
        ("[1, on, 'x']", ParameterType.STRING_ARRAY, ["1", "on", "x"]),
        ("[1, 1e-3]", ParameterType.DOUBLE_ARRAY, [1.0, 0.001]),
        ("[]", ParameterType.DOUBLE_ARRAY, []),
        ("[1, 255]", ParameterType.BYTE_ARRAY, b"\x01\xff"),
        ("[1, 256]", ParameterType.BYTE_ARRAY, [1, 256]),
        ("x", ParameterType.BYTE_ARRAY, "x"),
        ("5", ParameterType.BYTE_ARRAY, 5),
        ("x", ParameterType.DOUBLE, "x"),
        (str(2**63), ParameterType.INTEGER, 2**63),
        (str(2**63), ParameterType.NOT_SET, 2.0**63),
        ("x", ParameterType.DOUBLE_ARRAY, "x"),
    ],
)
def test_a_value_is_read_as_its_type_needs_it(text: str, kind: ParameterType, value: Any) -> None:
    result = read_value(text, kind)
    assert result == value
    assert type(result) is type(value)


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("[1, on]", ParameterType.DOUBLE_ARRAY, "'on' is not a number"),
        ("[1, on]", ParameterType.NOT_SET, "'on' is read as a bool"),
        ("[1, 2.5]", ParameterType.NOT_SET, "'2.5' is read as a double"),
        ("[1, 2.5]", ParameterType.INTEGER_ARRAY, "'2.5' is read as a double"),
        ("[", ParameterType.NOT_SET, "this is not YAML"),
        ("a: b", ParameterType.NOT_SET, "no mappings"),
        ("*x", ParameterType.NOT_SET, "refers to no anchor"),
        ("#fff", ParameterType.NOT_SET, "there is no value"),
        ("[" * 200, ParameterType.DOUBLE_ARRAY, "nested too deeply"),
    ],
)
def test_what_is_not_a_value(text: str, kind: ParameterType, message: str) -> None:
    with pytest.raises(YamlError, match=message):
        read_value(text, kind)


async def examples_of(group: str, command: str) -> list[str]:
    """The examples that the help of a command shows."""
    lines = (await printed(group, command, "--help")).splitlines()
    return [line.strip().removeprefix("$ ") for line in lines if line.strip().startswith("$ ")]


async def run_example(example: str, folder: Path) -> None:
    program = f'{sys.executable} -m rosasync "$@"'
    script = f"rosasync() {{ {program}; }}\n{example}"
    done = await asyncio.to_thread(
        subprocess.run,
        ["bash", "-c", script],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=6 * LIMIT,
    )
    assert (done.returncode, own(done.stderr)) == (0, ""), example


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "kind", "node", "commands"),
    [
        ("param", "undeclared", "/arm", "list set get describe dump load delete"),
        ("lifecycle", "lifecycle", "/camera", "nodes get list set"),
    ],
)
async def test_the_examples_of_the_help(
    nodes: NodesProcess, tmp_path: Path, group: str, kind: str, node: str, commands: str
) -> None:
    name = await nodes.add(kind)
    (tmp_path / "all.yaml").write_text("/**: {ros__parameters: {speed: 1.0}}")
    for command in commands.split():
        examples = await examples_of(group, command)
        assert len(examples) == 2
        for example in examples:
            await run_example(example.replace(f" {node}", f" {name}"), tmp_path)


@pytest.mark.slow
class TestLifecycle:
    async def test_get_list_and_set(self, nodes: NodesProcess) -> None:
        node = await nodes.add("lifecycle")
        assert await printed("lifecycle", "get", node) == "unconfigured [1]\n"
        assert await printed("lifecycle", "set", node, "configure") == "inactive [2]\n"
        assert "- activate [3]\n\tStart: inactive\n\tGoal: activating\n" in await printed(
            "lifecycle", "list", node
        )
        done = await printed("lifecycle", "set", node, "activate", "--json")
        assert json.loads(done) == {"node": node, "state": "active", "id": 3}
        found = [
            json.loads(line)
            for line in (await printed("lifecycle", "list", node, "--json")).splitlines()
        ]
        assert {one["label"] for one in found} == {"deactivate", "shutdown"}

    async def test_nodes(self, nodes: NodesProcess) -> None:
        node = await nodes.add("lifecycle")
        other = await nodes.add("parameters", "plain")
        text = await printed("lifecycle", "nodes", *LOOK)
        assert f"{node}: unconfigured [1]\n" in text
        assert other not in text

    async def test_what_fails_or_is_wrong(self, nodes: NodesProcess) -> None:
        failing, slow = await nodes.add("failing"), await nodes.add("slow")
        for arguments, code, message in (
            (("set", failing, "configure"), 1, "its callback failed; it is unconfigured as before"),
            (("set", failing, "activate"), 1, "it is unconfigured"),
            (("set", failing, "explode"), 2, "'transition': 'explode' is not one of"),
            (("get", "/absent", "--timeout", str(TICK)), 3, "/absent"),
            (("set", slow, "configure", "--timeout", DISCOVERY), 4, "(unknown)"),
        ):
            done = await run("lifecycle", *arguments)
            assert (done.returncode, done.stdout) == (code, ""), (arguments, done.stderr)
            assert message in done.stderr
            assert done.stderr.count("\n") == 1
        await nodes.release()
