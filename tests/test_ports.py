"""The contract of the ports: one suite for the real ones and the fake."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, Literal

import pytest

from rosasync import InvalidServiceName
from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import ClientPort, NodePort
from rosasync._ros.node import RosNode
from rosasync.options import Limits, SessionOptions
from rosasync.testing import FakeGraph, FakeNode
from tests.support.echo import ECHO, answer_to, fill, request_of, service_class
from tests.support.servers import ServerProcess
from tests.support.times import until

Kind = Literal["fake", "direct", "executor"]


class World:
    """A node under test, with functions to add and remove servers."""

    node: NodePort

    def __init__(
        self,
        serve: Callable[[str], Awaitable[object]],
        vanish: Callable[[str], Awaitable[object]],
    ) -> None:
        self.serve = serve
        self.vanish = vanish
        self.changes = 0
        self.responses: list[tuple[int, str]] = []

    def changed(self) -> None:
        self.changes += 1

    def client(self, srv_name: str = "/port_echo") -> ClientPort:
        return self.node.open_client(self.node.describe(ECHO, srv_name, None), self._deliver)

    def servers(self, srv_type: str = ECHO) -> int:
        return len(self.node.find_servers(self.node.describe(srv_type, "/port_echo", None)))

    def _deliver(self, sequence_number: int, response: Any) -> None:
        self.responses.append((sequence_number, answer_to(response)))


@pytest.fixture(params=["fake", "direct", "executor"])
async def world(request: pytest.FixtureRequest) -> AsyncIterator[World]:
    kind: Kind = request.param
    if kind == "fake":
        graph = FakeGraph()
        response_class = service_class(ECHO).Response

        async def serve(name: str) -> None:
            graph.serve(ECHO, name, lambda request: fill(request, response_class()))

        async def vanish(name: str) -> None:
            graph.find(ECHO, name)[0].close()

        world = World(serve, vanish)
        world.node = FakeNode(graph, world.changed)
        yield world
        world.node.close()
        return
    server: ServerProcess = request.getfixturevalue("server")
    world = World(serve=server.serve, vanish=server.stop)
    gateway = LoopGateway()
    options = SessionOptions(
        node="test_ports",
        context=None,
        executor=None,
        bridge=kind,
        limits=Limits(),
        timeout=None,
        busy_poll=0.0,
        introspection="off",
    )
    real = world.node = RosNode(options, gateway, world.changed, lambda: None)
    yield world
    real.stop()
    await real.stopped()
    assert real.join()
    gateway.close()
    real.close()


async def test_each_response_carries_the_number_of_its_request(world: World) -> None:
    await world.serve("/port_echo")
    client = world.client()
    await until(client.ready)
    numbers = [client.send(request_of(str(i))) for i in range(5)]
    assert numbers == sorted(set(numbers))
    await until(lambda: len(world.responses) == 5)
    assert dict(world.responses) == {number: str(i) for i, number in enumerate(numbers)}
    client.close()


async def test_responses_come_on_the_loop_and_never_within_send(world: World) -> None:
    await world.serve("/port_echo")
    client = world.client()
    await until(client.ready)
    client.send(request_of("x"))
    assert world.responses == []
    await until(lambda: world.responses)
    client.close()


async def test_ready_follows_the_server(world: World) -> None:
    client = world.client()
    assert not client.ready()
    await world.serve("/port_echo")
    await until(client.ready)
    assert world.servers() == 1
    assert not world.servers("std_srvs/srv/Empty")
    await world.vanish("/port_echo")
    await until(lambda: not client.ready())
    await until(lambda: world.servers() == 0)
    client.close()


async def test_a_change_of_the_graph_is_told(world: World) -> None:
    assert world.node.graph_events
    client = world.client()
    before = world.changes
    await world.serve("/port_echo")
    await until(lambda: world.changes > before)
    client.close()


async def test_a_forgotten_request_does_not_disturb_the_next(world: World) -> None:
    await world.serve("/port_echo")
    client = world.client()
    await until(client.ready)
    first = client.send(request_of("forgotten"))
    client.forget(first)
    client.forget(first)
    second = client.send(request_of("wanted"))
    await until(lambda: (second, "wanted") in world.responses)
    client.close()


async def test_nothing_comes_after_close(world: World) -> None:
    await world.serve("/port_echo")
    client = world.client()
    other = world.client()
    await until(lambda: client.ready() and other.ready())
    client.send(request_of("too late"))
    client.close()
    client.close()
    number = other.send(request_of("in time"))
    await until(lambda: world.responses)
    await asyncio.sleep(0)
    assert world.responses == [(number, "in time")]
    other.close()


async def test_names_are_resolved_or_refused(world: World) -> None:
    assert world.node.describe(ECHO, "port_echo", None).key.srv_name == "/port_echo"
    for name in ("", "/", "/with space", "/1st", "/double//slash", "/\ud800"):
        with pytest.raises(InvalidServiceName, match="service name"):
            world.node.describe(ECHO, name, None)


async def test_types_and_requests_are_checked(world: World) -> None:
    service = world.node.describe(ECHO, "/port_echo", None)
    assert service.key == ("/port_echo", ECHO, None)
    srv_type = service.srv_type
    request = world.node.make_request(srv_type, {"load_namespace": "x"})
    assert isinstance(request, srv_type.Request)
    assert world.node.make_request(srv_type, request) is request
    with pytest.raises(TypeError):
        world.node.make_request(srv_type, srv_type.Response())
    with pytest.raises(ValueError, match="no_such_package"):
        world.node.describe("no_such_package/srv/Nothing", "/port_echo", None)


async def test_what_is_seen_instead(world: World) -> None:
    missing = world.node.describe(ECHO, "/port_ecco", None)
    await world.serve("/port_echo")
    await until(world.servers)
    assert "/port_echo" in world.node.explain_missing(missing)
    assert world.node.ok()
