"""What depends on the middleware, for those that cannot run here: played by fakes.

The fakes do what the sources of rmw_zenoh_cpp and rmw_cyclonedds_cpp say. So these tests show that
rosasync does what it should if they are right, and not that it runs on those middlewares.
"""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from rosasync import ServerGone
from rosasync._core.ports import Service
from rosasync._ros import fastdds, host, identities, silence
from rosasync._ros.endpoints import clients_of, servers_of
from rosasync._ros.graph import GraphQueries
from rosasync._ros.identities import Identities
from rosasync._ros.names import default_qos
from rosasync._ros.responder import Responder
from rosasync.statistics import ServiceKey
from rosasync.testing._memory.graph import MemoryQueries
from tests.support.echo import ECHO, answer_to, request_of, response_to, service_class
from tests.support.fake_graph import FakeGraph
from tests.support.times import until
from tests.test_services import BAD, GOOD, RESPONSE, STEP, TRANSIENT, Header, Middleware, fail
from tests.test_services import middleware as middleware

NAME = "/served"
KEY = ServiceKey(NAME, "std_srvs/srv/Trigger")
SERVICE = Service(Trigger, NAME, None, KEY, lambda request: True)
FIRST, SECOND, THIRD = (bytes([number] * 16) for number in (1, 2, 3))


def info(gids: list[bytes], node: str = "lamp", kind: str = "std_srvs/srv/Trigger") -> Any:
    """What rclpy lists of a server or client from 10.0.2 on."""
    return SimpleNamespace(
        node_name=node,
        node_namespace="/",
        service_type=kind,
        endpoint_gids=[list(gid) for gid in gids],
        qos_profiles=[default_qos() for _ in gids],
    )


class Zenoh(Middleware):
    """A node on a middleware without topics for services, with an rclpy that lists no servers."""

    def __init__(self, *servers: Any) -> None:
        super().__init__()
        self.servers = list(servers)

    def get_publishers_info_by_topic(self, name: str, no_mangle: bool) -> list[Any]:
        return []

    def get_subscriptions_info_by_topic(self, name: str, no_mangle: bool) -> list[Any]:
        return []

    def get_count_services(self, name: str) -> int:
        return len(self.servers) if name == NAME else 0

    def get_service_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [(NAME, sorted({server.service_type for server in self.servers}))]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        return [("lamp", "/")]

    def get_service_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        return self.get_service_names_and_types()

    def get_client_names_and_types_by_node(
        self, name: str, namespace: str
    ) -> list[tuple[str, list[str]]]:
        return []


class ZenohOfLyrical(Zenoh):
    """The same with an rclpy that lists the servers of a service."""

    def get_servers_info_by_service(self, name: str) -> list[Any]:
        return self.servers if name == NAME else []

    def get_clients_info_by_service(self, name: str) -> list[Any]:
        return [info([SECOND], "caller")]


class Unsupported(Zenoh):
    """A middleware that does not answer this rclpy's query."""

    def get_servers_info_by_service(self, name: str) -> list[Any]:
        raise NotImplementedError("rmw_get_servers_info_by_service")

    get_clients_info_by_service = get_servers_info_by_service


def find_servers(node: Any) -> frozenset[Any]:
    return GraphQueries(node, events=False).find_servers(SERVICE)


class TestServersOfZenoh:
    """Servers are liveliness tokens with a GID each; there are no topics for services."""

    def test_they_are_identified_by_rclpys_own_query(self) -> None:
        node = ZenohOfLyrical(info([FIRST]), info([SECOND], "other"))
        assert find_servers(node) == {FIRST, SECOND}
        node.servers = [info([THIRD])]
        assert find_servers(node) == {THIRD}

    def test_those_of_another_type_do_not_count(self) -> None:
        other = info([SECOND], kind="std_srvs/srv/SetBool")
        assert find_servers(ZenohOfLyrical(info([FIRST]), other)) == {FIRST}

    def test_those_of_another_qos_do_not_count(self) -> None:
        server = info([FIRST])
        server.qos_profiles = [QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)]
        assert find_servers(ZenohOfLyrical(server)) == frozenset()

    def test_servers_and_clients_are_described(self) -> None:
        node: Any = ZenohOfLyrical(info([FIRST]))
        (server,), (client,) = servers_of(node, NAME), clients_of(node, NAME)
        assert (server.node, server.srv_type, server.gid) == ("/lamp", SERVICE.key.srv_type, FIRST)
        assert (client.node, client.gid) == ("/caller", SECOND)

    @pytest.mark.parametrize("kind", [Zenoh, Unsupported])
    def test_without_the_query_they_are_counted(self, kind: type[Zenoh]) -> None:
        node: Any = kind(info([FIRST]), info([SECOND]))
        assert find_servers(node) == {0, 1}
        (server,) = servers_of(node, NAME)
        assert (server.node, server.srv_type, server.gid) == ("/lamp", SERVICE.key.srv_type, None)
        assert clients_of(node, NAME) == []


def test_of_the_two_endpoints_of_dds_the_one_of_the_responses_counts() -> None:
    """As rclpy lists them: the reader first, the writer last."""
    node: Any = ZenohOfLyrical(info([FIRST, SECOND]))
    node.get_clients_info_by_service = lambda name: [info([FIRST, SECOND])]
    assert find_servers(node) == {SECOND}
    assert [client.gid for client in clients_of(node, NAME)] == [FIRST]


class TestIdentitiesOfClients:
    """A client takes part in reports only if servers know it by the GUID that the graph shows."""

    @pytest.mark.parametrize(
        ("gid", "known"),
        [
            # A GUID of the graph, of the request writer or of the response reader.
            (GOOD[:12] + bytes([3] * 4), True),
            (GOOD, True),
            (GOOD[:12] + bytes([0, 0, 0, 1]), False),  # Cyclone DDS: its process and a number.
            (None, False),
        ],
    )
    def test_they_count_if_the_middleware_uses_them(
        self, monkeypatch: pytest.MonkeyPatch, gid: bytes | None, known: bool
    ) -> None:
        node: Any = Middleware()
        node.join(GOOD)
        monkeypatch.setattr(fastdds, "is_present", lambda: False)
        monkeypatch.setattr(identities, "client_gid", lambda client: gid)
        found = Identities(node)
        for _ in range(3):
            assert found.confirm(None, NAME, GOOD) == (GOOD if known else None)
        # Asked once, for the first client.
        assert node.queries == 1

    def test_one_that_the_graph_does_not_show_decides_nothing(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        node: Any = Middleware()
        node.join(GOOD)
        monkeypatch.setattr(fastdds, "is_present", lambda: False)
        monkeypatch.setattr(identities, "client_gid", lambda client: GOOD[:12] + bytes([3] * 4))
        found = Identities(node)
        assert found.confirm(None, NAME, None) is None
        assert found.confirm(None, NAME, GOOD) == GOOD


class TestResponsesOfCyclone:
    """A request's header names its client by numbers of Cyclone's own, which the graph lacks."""

    GOOD, BAD = bytes(range(16)), bytes(range(100, 116))

    @pytest.fixture
    def service(self, middleware: Middleware, monkeypatch: pytest.MonkeyPatch) -> Responder:
        monkeypatch.setattr(fastdds, "is_present", lambda: False)
        node: Any = middleware
        return Responder(node, node, QoSProfile(depth=10))

    def test_a_slow_send_has_sent(self, middleware: Middleware, service: Responder) -> None:
        middleware.report = "nothing"
        middleware.unmatched.add(self.GOOD)
        for _ in range(3):
            service.send(Header(self.GOOD), RESPONSE)
        assert middleware.sent == [self.GOOD] * 3

    def test_one_attempt_in_a_while_may_block(
        self, middleware: Middleware, service: Responder
    ) -> None:
        middleware.unmatched.add(self.BAD)
        middleware.join(BAD, reader=False)
        for _ in range(10):
            fail(service, self.BAD)
            fail(service, self.GOOD)
            middleware.now += STEP
        assert middleware.sent == [self.BAD]
        middleware.readers[BAD] = QoSProfile(depth=10)
        middleware.unmatched.clear()
        middleware.now += STEP
        service.send(Header(self.BAD), RESPONSE)
        service.send(Header(self.GOOD), RESPONSE)
        assert middleware.sent == [self.BAD, self.BAD, self.GOOD]

    def test_a_qos_that_cannot_match_blocks_once_in_a_while(
        self, middleware: Middleware, service: Responder
    ) -> None:
        middleware.unmatched.add(self.BAD)
        middleware.join(BAD, TRANSIENT)
        for _ in range(10):
            fail(service, self.BAD)
            middleware.now += STEP
        assert middleware.sent == [self.BAD]


class TestWithoutFastDds:
    """What only Fast DDS has is not looked for elsewhere."""

    @pytest.fixture(params=["rmw", "rmw_that_is_not_there"], autouse=True)
    def other(self, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
        """A middleware whose library lacks Fast DDS's functions, or is not there."""
        name = request.param
        monkeypatch.setattr(fastdds, "get_rmw_implementation_identifier", lambda: name)
        for function in ("is_present", "_load"):
            monkeypatch.setattr(fastdds, function, getattr(fastdds, function).__wrapped__)

    def test_nothing_is_loaded_or_acknowledged_and_no_discovery_ends(self) -> None:
        node: Any = None
        assert not fastdds.end_discovery(node)
        assert not fastdds.is_present()
        assert not fastdds.load_profiles("<profiles/>")
        assert not fastdds.acknowledged(SimpleNamespace(pointer=1))

    def test_nothing_is_said_of_shared_memory_and_ended_processes(self) -> None:
        node: Any = None
        assert silence.explain_silence(node, [SimpleNamespace(endpoint_gid=list(FIRST))]) is None
        assert host.ended(node, [FIRST]) == frozenset()


def test_fast_dds_is_recognised() -> None:
    assert fastdds.is_present()


@pytest.fixture
def placeholders(fake_graph: FakeGraph, monkeypatch: pytest.MonkeyPatch) -> FakeGraph:
    """A graph that counts servers and identifies none."""

    def counted(queries: MemoryQueries, service: Service) -> frozenset[int]:
        return frozenset(range(queries.count_servers(service)))

    monkeypatch.setattr(MemoryQueries, "find_servers", counted)
    return fake_graph


class TestSessionsWithoutIdentities:
    """A session on a middleware that identifies no servers."""

    async def test_calls_end_when_no_server_is_left(self, placeholders: FakeGraph) -> None:
        servers = [placeholders.serve(ECHO, "/echo", echo) for _ in range(2)]
        async with placeholders.session() as session:
            assert answer_to(await session.call(ECHO, "/echo", request_of("1"))) == "1"
            with placeholders.hold_requests():
                call = session.start(ECHO, "/echo", request_of("2"))
                await until(lambda: session.pool.statistics().in_flight)
                servers[0].close()
                await asyncio.sleep(0.2)
                assert not call.done()
                servers[1].close()
                with pytest.raises(ServerGone):
                    await call


def echo(request: Any) -> Any:
    return service_class(ECHO).Response(message=response_to(request))
