"""Parameters of stock nodes in another process."""

from __future__ import annotations

import array
import asyncio
import copy
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy
import pytest
import yaml
from rcl_interfaces.msg import ParameterDescriptor as RosDescriptor
from rcl_interfaces.msg import ParameterValue, SetParametersResult

import rosasync
from rosasync import Session
from rosasync._core.safe_yaml import MAX_BYTES
from rosasync.parameters import (
    ParameterClient,
    ParameterDescriptor,
    ParameterError,
    ParameterRange,
    ParameterType,
)
from tests.support.managed import VALUES, NodesProcess
from tests.support.process import ROOT
from tests.support.times import TICK

PLAIN = VALUES | {"byte_array": b"\x00\xff"}
OTHERS = {"serial": "A1", "any": 1, "volume": 5, "gain": 0.5, "mode": "idle"}
ALWAYS = {"use_sim_time", "start_type_description_service"}
"""Parameters that rclpy declares for every node, in some version."""


@pytest.fixture(scope="module")
def nodes() -> Iterator[NodesProcess]:
    """A process of stock nodes, for all tests of this module."""
    with NodesProcess() as nodes:
        yield nodes


@pytest.fixture
async def arm(session: Session, nodes: NodesProcess) -> ParameterClient:
    """The client of a new node with a parameter of each kind."""
    return ParameterClient(session, await nodes.add("parameters", "arm"))


class TestReading:
    async def test_a_value_of_each_type(self, arm: ParameterClient) -> None:
        for name, value in PLAIN.items():
            assert await arm.get(name) == value
        assert await arm.get([*PLAIN]) == PLAIN

    async def test_each_type(self, arm: ParameterClient) -> None:
        types = await arm.types(set(PLAIN))
        assert {name: kind for name, kind in types.items() if "." not in name} == {
            kind.name.lower(): kind for kind in ParameterType if kind is not ParameterType.NOT_SET
        }
        assert await arm.types("any") is ParameterType.INTEGER

    async def test_names(self, arm: ParameterClient) -> None:
        names = await arm.list()
        assert set(names) - ALWAYS == {*PLAIN, *OTHERS}
        assert names == sorted(names)
        assert await arm.list("arm") == ["arm.left.speed", "arm.right.speed"]
        assert await arm.list("arm.left", "mode") == ["arm.left.speed", "mode"]
        assert "arm.left.speed" not in await arm.list(depth=1)

    async def test_descriptors(self, arm: ParameterClient) -> None:
        described = await arm.describe(["volume", "gain", "serial", "any"])
        assert described["volume"] == ParameterDescriptor(
            "volume",
            ParameterType.INTEGER,
            "how loud",
            "not at night",
            range=ParameterRange(0, 11, 1),
        )
        assert described["gain"].range == ParameterRange(0.0, 1.0, 0.25)
        assert described["serial"].read_only
        assert described["any"].dynamic_typing
        assert await arm.describe("gain") == described["gain"]

    async def test_one_that_is_not_declared(self, arm: ParameterClient) -> None:
        for ask in (arm.get, arm.describe, arm.types):
            with pytest.raises(ParameterError, match="'spee': it is not declared") as caught:
                await ask("spee")
            assert caught.value.node_name == arm.node_name
            assert caught.value.name == "spee"

    async def test_of_several_those_that_are_not_declared(self, arm: ParameterClient) -> None:
        with pytest.raises(ParameterError) as caught:
            await arm.get(["bool", "x", "integer", "double", "y"])
        assert [*caught.value.reasons] == ["x", "y"]
        assert str(caught.value).startswith(f"{arm.node_name}: 'x', 'y': it is not declared")

    async def test_none_at_all(self, arm: ParameterClient) -> None:
        assert await arm.get([]) == {}


class TestSetting:
    @pytest.mark.parametrize("name", PLAIN)
    async def test_each_type(self, arm: ParameterClient, name: str) -> None:
        value = PLAIN[name]
        other = value[::-1] if hasattr(value, "__getitem__") else type(value)(0)
        await arm.set(name, other)
        assert await arm.get(name) == other
        await arm.set({name: value})
        assert await arm.get(name) == value

    @pytest.mark.parametrize("name", [name for name in PLAIN if name.endswith("array")])
    async def test_an_empty_list(self, arm: ParameterClient, name: str) -> None:
        await arm.set(name, [])
        assert await arm.get(name) == (b"" if name == "byte_array" else [])
        assert (await arm.types(name)).name.lower() == name

    @pytest.mark.parametrize(
        ("name", "given", "value"),
        [
            ("integer", numpy.int32(7), 7),
            ("double", numpy.float32(0.25), 0.25),
            ("bool", numpy.False_, False),
            ("byte_array", bytearray(b"abc"), b"abc"),
            ("byte_array", [b"a", b"b"], b"ab"),
            ("bool_array", (True, True), [True, True]),
            ("integer_array", numpy.arange(3), [0, 1, 2]),
            ("integer_array", array.array("h", [1, 2]), [1, 2]),
            ("double_array", [1, 2.5], [1.0, 2.5]),
            ("double_array", numpy.array([0.5]), [0.5]),
            ("string_array", ("x",), ["x"]),
        ],
    )
    async def test_other_values_of_the_type(
        self, arm: ParameterClient, name: str, given: object, value: object
    ) -> None:
        await arm.set(name, given)
        result = await arm.get(name)
        assert result == value
        assert type(result) is type(value)

    @pytest.mark.parametrize(
        ("name", "value", "reason"),
        [
            ("serial", "B2", "read-only"),
            ("mode", "off", "no such mode: off"),
            ("volume", 12, "range"),
            ("gain", 0.3, "step"),
            ("double", 1, "type"),
            ("bool", None, "cannot be undeclared"),
            ("spee", 1.0, "undeclared"),
        ],
    )
    async def test_a_refused_one_is_an_error_with_its_reason(
        self, arm: ParameterClient, name: str, value: object, reason: str
    ) -> None:
        with pytest.raises(ParameterError, match=f"{arm.node_name}: '{name}'") as caught:
            await arm.set(name, value)
        assert caught.value.name == name
        assert caught.value.reason in str(caught.value)
        assert re.search(reason, caught.value.reason), caught.value.reason
        if name in PLAIN | OTHERS:
            assert await arm.get(name) == (PLAIN | OTHERS)[name]

    async def test_of_several_the_others_are_set(self, arm: ParameterClient) -> None:
        with pytest.raises(ParameterError) as caught:
            await arm.set({"serial": "B2", "volume": 6, "mode": "off", "gain": 0.75})
        assert [*caught.value.reasons] == ["serial", "mode"]
        assert await arm.get(["volume", "gain"]) == {"volume": 6, "gain": 0.75}

    async def test_all_or_none(self, arm: ParameterClient) -> None:
        await arm.set_atomically({"volume": 6, "gain": 0.75})
        with pytest.raises(ParameterError, match="'volume', 'mode': no such mode") as caught:
            await arm.set_atomically({"volume": 7, "mode": "off"})
        assert caught.value.reasons == dict.fromkeys(("volume", "mode"), "no such mode: off")
        assert await arm.get(["volume", "gain"]) == {"volume": 6, "gain": 0.75}

    async def test_a_type_that_may_change(self, arm: ParameterClient) -> None:
        for value in ("text", 0.5, [1, 2], b"raw", True):
            await arm.set("any", value)
            assert await arm.get("any") == value
        await arm.set("any", None)
        assert "any" not in await arm.list()

    async def test_one_that_is_declared_with_a_type_and_no_value(
        self, session: Session, nodes: NodesProcess
    ) -> None:
        node = ParameterClient(session, await nodes.add("unset"))
        assert await node.types("unset") is ParameterType.INTEGER
        assert await node.types("texts") is ParameterType.STRING_ARRAY
        await node.set("texts", [])
        assert await node.get("texts") == []

    async def test_undeclared_ones_where_they_are_allowed(
        self, session: Session, nodes: NodesProcess
    ) -> None:
        node = ParameterClient(session, await nodes.add("undeclared"))
        await node.set({"a.b": 1, "c": ["x"]})
        assert await node.get(["a.b", "c", "d"]) == {"a.b": 1, "c": ["x"], "d": None}
        await node.set("c", [])
        assert await node.types("c") is ParameterType.STRING_ARRAY
        with pytest.raises(ParameterError, match="'d': it is not declared"):
            await node.types(["c", "d"])
        with pytest.raises(TypeError, match="'d': the type of an empty list is unknown"):
            await node.set("d", [])
        # The node has survived the questions.
        assert await node.get("a.b") == 1

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ({"a": 1}, "'mode': no parameter can have a dict"),
            (1j, "'mode': no parameter can have a complex"),
            ([1, "a"], "'mode': the elements of a list must all be"),
            ([[1], [2]], "'mode': the elements of a list must all be"),
            ([b"ab"], "'mode': the elements of a list must all be"),
            ([True, 1], "'mode': the elements of a list must all be"),
            ([], "'mode': the type of an empty list is unknown"),
        ],
    )
    async def test_values_of_no_type(
        self, arm: ParameterClient, value: object, message: str
    ) -> None:
        with pytest.raises(TypeError, match=message):
            await arm.set("mode", value)

    async def test_a_value_out_of_range(self, arm: ParameterClient) -> None:
        with pytest.raises(ValueError, match="out of the range of int64"):
            await arm.set({"volume": 6, "integer": 2**63})
        assert await arm.get("volume") == 5

    async def test_arguments_that_do_not_fit(self, arm: ParameterClient) -> None:
        ask: Any = arm.set
        for arguments in (("volume",), ({"volume": 1}, 2), (1, 2)):
            with pytest.raises(TypeError, match="give a name and a value"):
                await ask(*arguments)


class TestFiles:
    async def test_what_it_writes_is_what_ros2_param_dump_writes(
        self, arm: ParameterClient
    ) -> None:
        text = await arm.dump()
        tree = yaml.safe_load(text)[arm.node_name]["ros__parameters"]
        for name in ALWAYS:
            tree.pop(name, None)
        assert tree == {
            **{
                name: value
                for name, value in (VALUES | OTHERS).items()
                if "." not in name and name != "byte_array"
            },
            "arm": {"left": {"speed": 1.0}, "right": {"speed": 2.0}},
        }
        assert "  ros__parameters:\n    any: 1\n    arm:\n      left:\n        speed: 1.0\n" in text

    async def test_what_it_writes_can_be_read(self, arm: ParameterClient, tmp_path: Path) -> None:
        file = tmp_path / "arm.yaml"
        text = await arm.dump()
        file.write_text(text)
        await arm.set({"double": 7.0, "arm.left.speed": 9.0})
        loaded = await arm.load(file)
        assert loaded["arm.left.speed"] == 1.0
        assert await arm.get([*PLAIN]) == PLAIN
        assert await arm.dump() == text

    async def test_a_file_with_a_refused_one(self, arm: ParameterClient, tmp_path: Path) -> None:
        file = tmp_path / "arm.yaml"
        file.write_text((await arm.dump()).replace("A1", "B2").replace("volume: 5", "volume: 6"))
        with pytest.raises(ParameterError, match="read-only") as caught:
            await arm.load(file)
        assert [*caught.value.reasons] == ["serial"]
        assert await arm.get("volume") == 6

    async def test_without_a_value(
        self, session: Session, nodes: NodesProcess, tmp_path: Path
    ) -> None:
        node = ParameterClient(session, await nodes.add("unset"))
        tree = yaml.safe_load(await node.dump())[node.node_name]["ros__parameters"]
        assert {name: tree[name] for name in tree if name not in ALWAYS} == {
            "first": 1,
            "last": "z",
        }
        with pytest.raises(ParameterError, match="'unset': it is not declared, or has no value"):
            await node.get("unset")

    async def test_wildcards_and_namespaces(self, arm: ParameterClient, tmp_path: Path) -> None:
        file = tmp_path / "all.yaml"
        name = arm.node_name.rpartition("/")[2]
        file.write_text(
            f"""
stock:
  {name}: {{ros__parameters: {{volume: 7}}}}
/**: {{ros__parameters: {{volume: 8, gain: 0.25}}}}
/*/{name}: {{ros__parameters: {{mode: on_}}}}
/*: {{ros__parameters: {{string: other}}}}
/other: {{ros__parameters: {{string: other}}}}
""".replace("on_", "'on'")
        )
        assert await arm.load(file) == {"volume": 7}
        assert await arm.load(file, use_wildcard=True) == {
            "volume": 8,
            "gain": 0.25,
            "mode": "on",
        }
        assert await arm.get(["volume", "gain", "mode", "string"]) == {
            "volume": 8,
            "gain": 0.25,
            "mode": "on",
            "string": PLAIN["string"],
        }

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("a: [", "is not YAML"),
            ("a: 1", "is not a parameter file"),
            ("- a", "is not a parameter file"),
            ("", "is not a parameter file"),
            ("/b: {ros__parameters: {a: 1}}", "no parameters for /stock/.*, only for /b$"),
            ("/**: {ros__parameters: {a: 1}}", r"only for /\*\*; use_wildcard"),
            ("NODE: {ros__parameters: {a: }}", "has no value for a"),
            ("NODE: {ros__parameters: {a: [], b: 1}}", "has no value for a: rcl reads no empty"),
            ("NODE: {ros__parameters: {a: [1, on]}}", "'on' is read as a bool"),
            ("NODE: {ros__parameters: {a: &a 1, b: *a}}", "has no aliases"),
        ],
    )
    async def test_files_that_do_not_fit(
        self, arm: ParameterClient, tmp_path: Path, text: str, message: str
    ) -> None:
        file = tmp_path / "bad.yaml"
        file.write_text(text.replace("NODE", arm.node_name))
        with pytest.raises(ValueError, match=f"bad.yaml.*{message}"):
            await arm.load(file)

    async def test_a_binary_file(self, arm: ParameterClient, tmp_path: Path) -> None:
        file = tmp_path / "binary.yaml"
        file.write_bytes(bytes(range(256)))
        with pytest.raises(ValueError, match="binary.yaml: this is not YAML"):
            await arm.load(file)

    async def test_a_file_beyond_the_limits(self, arm: ParameterClient, tmp_path: Path) -> None:
        file = tmp_path / "large.yaml"
        with file.open("wb") as opened:
            opened.truncate(MAX_BYTES + 1)
        with pytest.raises(ValueError, match="large.yaml: this YAML is too large"):
            await arm.load(file)
        file.write_text("{a: " * 200)
        with pytest.raises(ValueError, match="nested too deeply"):
            await arm.load(file)

    async def test_nan_is_the_value_that_it_has(
        self, session: Session, nodes: NodesProcess, tmp_path: Path
    ) -> None:
        node = ParameterClient(session, await nodes.add("read_only"))
        file = tmp_path / "nan.yaml"
        file.write_text(await node.dump())
        await node.load(file)
        file.write_text(f"{node.node_name}: {{ros__parameters: {{whole: 1}}}}")
        with pytest.raises(ParameterError, match="'whole'"):
            await node.load(file)

    async def test_a_parameter_below_another(
        self, session: Session, nodes: NodesProcess, tmp_path: Path
    ) -> None:
        node = ParameterClient(session, await nodes.add("undeclared"))
        values = {"a": 1, "a.b": 2, "a.b.c": 3}
        await node.set(values)
        file = tmp_path / "nested.yaml"
        file.write_text(await node.dump())
        assert (await node.load(file)).items() >= values.items()

    def test_without_pyyaml_it_says_so(self) -> None:
        program = """
import sys
sys.modules["yaml"] = None
import rosasync.parameters
try:
    rosasync.parameters._read("/dev/null", "/arm", False)
except ImportError as error:
    print(error)
"""
        process = subprocess.run(
            [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert "pip install 'rosasync[cli]'" in process.stdout


async def test_many_nodes_at_a_time(session: Session, nodes: NodesProcess) -> None:
    names = [await nodes.add("undeclared", "many") for _ in range(10)]
    clients = [ParameterClient(session, name) for name in names]
    await asyncio.gather(*(c.set("number", i) for i, c in enumerate(clients)))
    assert await asyncio.gather(*(c.get("number") for c in clients)) == [*range(10)]


async def test_a_node_without_parameter_services(session: Session, nodes: NodesProcess) -> None:
    node = ParameterClient(session, await nodes.add("no_services"), timeout=4 * TICK)
    with pytest.raises(rosasync.ServiceUnavailable, match="/get_parameters"):
        await node.get("a")
    with pytest.raises(rosasync.ServiceUnavailable, match="/list_parameters"):
        await node.list(timeout=TICK)


async def test_names_and_timeouts(session: Session) -> None:
    assert ParameterClient(session, "arm").node_name == "/arm"
    assert repr(ParameterClient(session, "/a/b")) == "<ParameterClient /a/b>"
    with pytest.raises(rosasync.InvalidServiceName):
        ParameterClient(session, "/no spaces")
    with pytest.raises(rosasync.InvalidServiceName, match="the name of a node is missing"):
        ParameterClient(session, "")
    with pytest.raises(TypeError, match="a node's name is a str, not a NoneType"):
        ParameterClient(session, None)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="timeout"):
        ParameterClient(session, "/arm", timeout="soon")  # type: ignore[arg-type]


@dataclass
class Hostile:
    """A node whose answers about parameters make no sense."""

    name = "/hostile"
    results: int = 0
    kind: int = 99

    def serve(self, session: Session, service: str, srv_type: str) -> rosasync.ServiceServer:
        handler = getattr(self, service)
        return session.serve(f"rcl_interfaces/srv/{srv_type}", f"{self.name}/{service}", handler)

    def set_parameters(self, _: Any, response: Any) -> Any:
        response.results = [SetParametersResult(successful=True)] * self.results
        return response

    def get_parameters(self, request: Any, response: Any) -> Any:
        response.values = [ParameterValue(type=self.kind) for _ in request.names]
        return response

    def get_parameter_types(self, request: Any, response: Any) -> Any:
        response.types = [self.kind] * len(request.names)
        return response

    def describe_parameters(self, request: Any, response: Any) -> Any:
        response.descriptors = [RosDescriptor(type=self.kind) for _ in request.names] * 2
        return response

    def list_parameters(self, _: Any, response: Any) -> Any:
        response.result.names = ["a"]
        return response


async def test_a_hostile_node(session: Session) -> None:
    hostile = Hostile()
    services = {
        "set_parameters": "SetParameters",
        "get_parameters": "GetParameters",
        "get_parameter_types": "GetParameterTypes",
        "describe_parameters": "DescribeParameters",
        "list_parameters": "ListParameters",
    }
    async with AsyncExitStack() as stack:
        for service, srv_type in services.items():
            await stack.enter_async_context(hostile.serve(session, service, srv_type))
        node = ParameterClient(session, hostile.name)
        with pytest.raises(ParameterError, match="0 results for 2; it may have set them, or not"):
            await node.set({"a": 1, "b": 2})
        hostile.results = 3
        with pytest.raises(ParameterError, match="3 results for 2") as caught:
            await node.set({"a": 1, "b": 2})
        assert [*caught.value.reasons] == ["a", "b"]
        for ask in (node.get, node.types):
            with pytest.raises(ParameterError, match="'a': .* the type 99, which is not known"):
                await ask("a")
        with pytest.raises(ParameterError, match="'a': .* the type 99, which is not known"):
            await node.dump()
        with pytest.raises(ParameterError, match="answered with 2 descriptors for 1"):
            await node.describe("a")


def test_the_error_is_copied_and_pickled() -> None:
    error = ParameterError("/a: no", node_name="/a", reasons={"x": "no", "y": "never"})
    for twin in (copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert isinstance(twin, ParameterError)
        assert (str(twin), twin.node_name, twin.reasons) == ("/a: no", "/a", error.reasons)
        assert (twin.name, twin.reason) == ("x", "no")
