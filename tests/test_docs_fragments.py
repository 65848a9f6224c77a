"""The fragments of the pages, run one by one: what a page shows without a program around it."""

from __future__ import annotations

import ast
import asyncio
import logging
import types
from collections.abc import AsyncIterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import anyio
import pytest
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParameters
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci

import rosasync
from rosasync.lifecycle import LifecycleClient
from rosasync.parameters import ParameterClient
from rosasync.testing import Graph, VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.servers import running
from tests.support.times import LIMIT
from tests.test_docs import DOCS, EXAMPLES, NAME, name_of, python_blocks

NOT_RUN = {
    "from launch import": "needs ROS's launch",
    "import uvloop": "has no main; test_loops runs it",
    "from my_interfaces": "has a type of the reader's own",
    "goal = await": "needs an action; test_wrap_future has one",
    "def ": "defines functions for a program that the reader has",
    "class ": "the same",
    "async def every_second": "runs until it is cancelled",
    "FromBlackboard(": "needs a tree; test_behaviours has one",
    "self._service_proxy": "is what another library does",
    "response = await client.call(request)  # before": "is what rclpy does",
    "async with session.serve": "serves for ever; test_server_iteration does so",
}
"""Beginnings of fragments that are only compiled, by `test_docs`, and why."""

SPECIAL = {"lifecycle", "notebook", "parameters", "testing"}
"""Pages whose fragments need nodes, each other, or a test around them (test_testing_plugin)."""


def fragments(*pages: Path) -> list[Any]:
    """Return the fragments of pages as parameters of a test."""
    return [
        pytest.param(code, id=f"{name_of(page)}-{number}")
        for page in pages
        for number, code in enumerate(python_blocks(page))
        if not NAME.match(code) and not code.startswith(tuple(NOT_RUN)) and "__main__" not in code
        if "asyncio.run(main())" not in code and "app.exec()" not in code
    ]


def plain_pages() -> list[Path]:
    """Return the pages whose fragments need nothing but services."""
    found = [*DOCS.glob("*.md"), *DOCS.glob("how-to/*.md"), *DOCS.glob("reference/*.md")]
    return sorted(page for page in found if page.stem not in SPECIAL)


async def run(code: str, names: dict[str, Any]) -> None:
    """Run a fragment, which may await."""
    tree = compile(code, "fragment", "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    done = types.FunctionType(tree, names)()
    if asyncio.iscoroutine(done):
        await done


def known(session: rosasync.Session) -> dict[str, Any]:
    """Return what the reader of a page has by then."""
    return {
        **{module.__name__: module for module in (anyio, asyncio, logging, rosasync)},
        **{named.__name__: named for named in (LifecycleClient, ParameterClient, Path)},
        "Drive": Fibonacci,
        "Fibonacci": Fibonacci,
        "Move": SetBool,
        "SetBool": SetBool,
        "Trigger": Trigger,
        "drive": drive,
        "handler": lambda request: SetBool.Response(success=request.data),
        "session": session,
    }


async def drive(goal: Any) -> Any:
    return {"sequence": []}


@pytest.fixture
async def graph(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Graph]:
    """A graph with the services that the pages call; new sessions are in it."""
    async with Graph(strict=False) as graph:
        for name in ("/arm/enable", "/lamp/switch"):
            graph.stub(SetBool, name, {"success": True})
        for name in ("/gripper/open", "/map/rebuild"):
            graph.stub(Trigger, name, {"success": True})
        graph.stub_action(
            Fibonacci, "/fibonacci", {"sequence": [0, 1]}, feedback=[{"sequence": [0]}]
        )
        monkeypatch.setattr(rosasync, "Session", graph.session)
        yield graph


@pytest.mark.parametrize("code", fragments(*plain_pages()))
async def test_fragment(code: str, graph: Graph) -> None:
    code = "".join(line for line in code.splitlines(True) if "# an error" not in line)
    async with graph.session() as session:
        await run(code, known(session))


@pytest.mark.usefixtures("own_domain")
class TestNodes:
    """The pages about nodes. Each fragment runs beside the nodes that it names."""

    @pytest.mark.slow
    @pytest.mark.parametrize("code", fragments(DOCS / "how-to" / "parameters.md"))
    async def test_parameters(
        self, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "all.yaml").write_text("/**:\n  ros__parameters:\n    speed: 0.5\n")
        await self._run(code, "arm")

    @pytest.mark.slow
    @pytest.mark.parametrize("code", fragments(DOCS / "how-to" / "lifecycle.md"))
    async def test_lifecycle(self, code: str) -> None:
        await self._run(code, "camera")

    async def _run(self, code: str, node: str) -> None:
        namespaces = ("/left", "/right") if "/left" in code else ("",)
        with ExitStack() as stack:
            for namespace in namespaces:
                arguments = ("--ros-args", "-r", f"__ns:={namespace or '/'}")
                stack.enter_context(running(EXAMPLES / "nodes" / f"{node}.py", *arguments))
            async with rosasync.Session("tutorial") as session:
                for namespace in namespaces:
                    name = f"{namespace}/{node}/get_parameters"
                    await session.call(GetParameters, name, timeout=LIMIT)
                await run(code, {**known(session), "arm": ParameterClient(session, "/arm")})


def test_each_reason_is_needed() -> None:
    everything = [code for page in DOCS.rglob("*.md") for code in python_blocks(page)]
    unused = [start for start in NOT_RUN if not any(c.startswith(start) for c in everything)]
    assert not unused


async def test_the_cells_of_a_notebook(graph: Graph) -> None:
    names: dict[str, Any] = {}
    for code in python_blocks(DOCS / "how-to" / "notebook.md"):
        await run(code, names)
    assert names["response"].success
    assert len(names["answers"]) == 2
    assert names["seen"] == [True]
    assert names["session"].closed


class TestVerify:
    """The page on retries: what it verifies is not done twice, although the answer was lost."""

    @pytest.mark.parametrize("lost", ["request", "response"])
    @pytest.mark.parametrize("which", ["is_open", "LifecycleClient", "is_set"])
    async def test_it_is_done_once(self, which: str, lost: str, fake_graph: FakeGraph) -> None:
        async with (
            fake_graph.session() as serving,
            fake_graph.session(timeout=LIMIT) as session,
        ):
            robot = LossyRobot(serving, lost)
            names = known(session)
            (code,) = (c for c in python_blocks(DOCS / "how-to" / "retry.md") if which in c)
            clock = VirtualClock()
            await clock.skip(run(code, names))
            if which == "LifecycleClient":
                assert await clock.skip(names["configure"](session, "/camera")) == "inactive"
            elif which == "is_set":
                response = await clock.skip(names["set_height"](session, 0.5))
                assert response.results[0].successful
            assert robot.done == 1
            assert robot.asked == (2 if lost == "request" else 1)
            robot.end()


class LossyRobot:
    """A gripper, a camera and a lift. What is asked first does not arrive, or is not answered."""

    def __init__(self, session: rosasync.Session, lost: str) -> None:
        self.asked = self.done = 0
        self._lost = lost
        self._kept: list[rosasync.ServiceCall[Any, Any]] = []
        session.serve(Trigger, "/gripper/open", self._act)
        session.serve(Trigger, "/gripper/is_open", self._is_open)
        session.serve(ChangeState, "/camera/change_state", self._act)
        session.serve(GetState, "/camera/get_state", self._state)
        session.serve(SetParameters, "/lift/set_parameters", self._act)
        session.serve(GetParameters, "/lift/get_parameters", self._height)

    def end(self) -> None:
        for call in self._kept:
            call.respond(call.response)

    def _act(self, call: rosasync.ServiceCall[Any, Any]) -> None:
        self.asked += 1
        first = self.asked == 1
        if not (first and self._lost == "request"):
            self.done += 1
        if first:
            self._kept.append(call)
        elif isinstance(call.response, SetParameters.Response):
            call.respond({"results": [{"successful": True}]})
        else:
            call.respond({"success": True})

    def _is_open(self, request: Any, response: Any) -> Any:
        response.success = self.done > 0
        return response

    def _state(self, request: Any, response: Any) -> Any:
        response.current_state.id = 2 if self.done else 1
        return response

    def _height(self, request: Any, response: Any) -> Any:
        return {"values": [{"type": 3, "double_value": 0.5 if self.done else 0.0}]}
