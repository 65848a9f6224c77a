"""The graph of a node: fitting servers, explanations if there is none, and events."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.srv import AddDiagnostics
from rclpy.duration import Duration
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from std_srvs.srv import SetBool, Trigger
from test_msgs.action import Fibonacci, NestedMessage

from rosasync._ros import bridges, endpoints, graph
from rosasync._ros.endpoints import gid_of, incompatibility, response_writers
from rosasync._ros.graph import GraphQueries, GraphWaitable
from rosasync.errors import UsageError
from tests.conftest import Bridge
from tests.support.echo import ECHO
from tests.support.nodes import Opened, borrowed_node, open_node
from tests.support.times import until

BEST_EFFORT = QoSProfile(depth=10, reliability=QoSReliabilityPolicy.BEST_EFFORT)
TRANSIENT = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
DEADLINE = QoSProfile(depth=10, deadline=Duration(seconds=1))


@pytest.fixture
async def opened() -> AsyncIterator[Opened]:
    async with open_node("direct") as opened:
        yield opened


@pytest.fixture
async def lonely(own_domain: None) -> AsyncIterator[Opened]:
    """A node that sees no other one."""
    async with open_node("direct", "lonely") as opened:
        yield opened


def nothing(request: Any, response: Any) -> Any:
    return response


class TestServers:
    """Which servers fit."""

    async def test_they_are_told_apart_by_their_response_writers(self, opened: Opened) -> None:
        service = opened.service()
        assert opened.queries.find_servers(service) == frozenset()
        with borrowed_node() as lender:
            servers = [lender.create_service(AddDiagnostics, "/echo", nothing) for _ in range(2)]
            await until(lambda: len(opened.queries.find_servers(service)) == 2)
            gids = {gid_of(writer) for writer in response_writers(lender, "/echo")}
            assert opened.queries.find_servers(service) == gids
            lender.destroy_service(servers[0])
            await until(lambda: len(opened.queries.find_servers(service)) == 1)
            assert opened.queries.find_servers(service) < gids

    async def test_those_of_another_type_do_not_count(self, opened: Opened) -> None:
        with borrowed_node() as lender:
            lender.create_service(Trigger, "/echo", nothing)
            await until(lambda: opened.ros.node.count_services("/echo"))
            assert opened.queries.find_servers(opened.service(srv_type=Trigger))
            assert not opened.queries.find_servers(opened.service())

    @pytest.mark.parametrize(
        ("served", "asked", "fits"),
        [
            (None, None, True),
            (QoSProfile(depth=1), None, True),
            (BEST_EFFORT, None, False),
            (None, BEST_EFFORT, False),
            (BEST_EFFORT, BEST_EFFORT, True),
            (TRANSIENT, None, False),
            (None, TRANSIENT, False),
            (TRANSIENT, TRANSIENT, True),
            (DEADLINE, None, False),
            (DEADLINE, DEADLINE, True),
        ],
    )
    async def test_those_of_another_qos_do_not_count(
        self, opened: Opened, served: Any, asked: Any, fits: bool
    ) -> None:
        """As the middleware decides: a client is matched if, and only if, a server fits."""
        with borrowed_node() as lender:
            options = {} if served is None else {"qos_profile": served}
            lender.create_service(AddDiagnostics, "/echo", nothing, **options)
            await until(lambda: opened.ros.node.count_services("/echo"))
            assert bool(opened.queries.find_servers(opened.service(qos=asked))) == fits
            client = opened.client(qos=asked)
            lender.create_service(AddDiagnostics, "/witness", nothing)
            await until(opened.client("/witness").ready)
            assert client.ready() == fits

    async def test_placeholders_if_the_topics_have_other_names(
        self, opened: Opened, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(endpoints, "response_writers", lambda *_: [])
        with borrowed_node() as lender:
            for _ in range(2):
                lender.create_service(AddDiagnostics, "/echo", nothing)
            await until(lambda: opened.ros.node.count_services("/echo") == 2)
            assert opened.queries.find_servers(opened.service()) == {0, 1}
            assert not opened.queries.find_servers(opened.service(srv_type=Trigger))

    def test_unset_values_are_not_incompatible(self) -> None:
        assert incompatibility(QoSProfile(depth=10), QoSProfile(depth=1)) is None
        assert "best effort" in str(incompatibility(BEST_EFFORT, QoSProfile(depth=10))).lower()
        assert endpoints.compatible(TRANSIENT, QoSProfile(depth=10))
        assert not endpoints.compatible(QoSProfile(depth=10), TRANSIENT)


class TestMissing:
    """The explanation of a missing service."""

    @pytest.mark.parametrize("events", [True, False])
    async def test_many_callers_share_one_snapshot(
        self, opened: Opened, monkeypatch: pytest.MonkeyPatch, events: bool
    ) -> None:
        now = 100.0
        monkeypatch.setattr(graph, "monotonic", lambda: now)
        with borrowed_node() as lender:
            for number in range(20):
                lender.create_service(Trigger, f"/service_{number}", nothing)
            await until(lambda: opened.ros.node.count_services("/service_19"))
            queries = GraphQueries(opened.ros.node, events)
            counted = 0
            list_services = opened.ros.node.get_service_names_and_types

            def counting() -> Any:
                nonlocal counted
                counted += 1
                return list_services()

            monkeypatch.setattr(opened.ros.node, "get_service_names_and_types", counting)
            service = opened.service("/missing")
            for _ in range(100):
                queries.explain_missing(service)
            assert counted == 1
            now += graph.SNAPSHOT_TIME
            queries.explain_missing(service)
            assert counted == (1 if events else 2)
            queries.changed()
            queries.explain_missing(service)
            assert counted == (2 if events else 3)

    async def test_a_change_of_the_graph_is_in_the_next_answer(self, opened: Opened) -> None:
        missing = opened.service("/ecco")
        opened.queries.explain_missing(missing)
        with borrowed_node() as lender:
            lender.create_service(AddDiagnostics, "/echo", nothing)
            await until(lambda: "/echo" in opened.queries.explain_missing(missing))

    async def test_no_other_node(self, lonely: Opened) -> None:
        missing = lonely.service("/ecco")
        domain = lonely.ros.node.context.get_domain_id()
        expected = (
            f"no other node is visible in domain {domain} with discovery range LOCALHOST and "
            f"{rclpy.get_rmw_implementation_identifier()}: start the server, or compare its ROS_DOM"
        )
        assert expected in lonely.queries.explain_missing(missing)
        lonely.serve("/own")
        await until(lambda: lonely.ros.node.count_services("/own"))
        assert expected in lonely.queries.explain_missing(missing)
        with borrowed_node():
            await until(lambda: "no other node" not in lonely.queries.explain_missing(missing))

    async def test_only_services_of_other_nodes_count(self, lonely: Opened) -> None:
        """Those of a node of the same name too: the graph shows the two as one."""
        missing = lonely.service("/zzz", ECHO)
        lonely.serve("/own", Trigger)
        with borrowed_node(lonely.ros.name) as twin:
            twin.create_service(Trigger, "/far", nothing)
            own = len(list(twin.services))
            await until(
                lambda: f"among {own} services of other" in lonely.queries.explain_missing(missing)
            )
            assert "there are /far" in lonely.queries.explain_missing(lonely.service("/z", Trigger))

    async def test_for_an_action_actions_are_counted(self, lonely: Opened) -> None:
        name = "/entirely_different_things/_action/send_goal"
        missing = lonely.service(name, NestedMessage.Impl.SendGoalService)
        with borrowed_node() as other:
            other.create_service(Fibonacci.Impl.SendGoalService, "/far/_action/send_goal", nothing)
            await until(
                lambda: "among 1 action of other" in lonely.queries.explain_missing(missing)
            )

    @pytest.mark.parametrize(
        ("setting", "expected"),
        [
            ({}, "range SUBNET and"),
            ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, "range OFF and"),
            ({"ROS_LOCALHOST_ONLY": "1"}, "range LOCALHOST (ROS_LOCALHOST_ONLY=1) and"),
        ],
    )
    async def test_the_discovery_range(
        self,
        lonely: Opened,
        monkeypatch: pytest.MonkeyPatch,
        setting: dict[str, str],
        expected: str,
    ) -> None:
        for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
            monkeypatch.delenv(name, raising=False)
        for name, value in setting.items():
            monkeypatch.setenv(name, value)
        assert expected in lonely.queries.explain_missing(lonely.service("/ecco"))

    async def test_another_type(self, opened: Opened) -> None:
        service = opened.service()
        assert opened.queries.explain_mismatch(service) is None
        with borrowed_node() as lender:
            lender.create_service(Trigger, "/echo", nothing)
            expected = "this name is served as std_srvs/srv/Trigger by node /lender"
            await until(lambda: opened.queries.explain_mismatch(service) == expected)
            assert opened.queries.explain_missing(service) == expected
            assert opened.queries.explain_mismatch(opened.service(srv_type=Trigger)) is None

    async def test_other_types_of_two_nodes_of_the_same_name(self, opened: Opened) -> None:
        """In a query by node, the one hides the other's services."""
        service = opened.service()
        with borrowed_node("twin") as first, borrowed_node("twin") as second:
            first.create_service(Trigger, "/echo", nothing)
            second.create_service(SetBool, "/echo", nothing)
            expected = (
                "this name is served as std_srvs/srv/SetBool by node /twin "
                "and as std_srvs/srv/Trigger by node /twin"
            )
            await until(lambda: opened.queries.explain_mismatch(service) == expected)
            similar = opened.service("/ecoo")
            types = "/echo (std_srvs/srv/SetBool, std_srvs/srv/Trigger)"
            # The types of all services may be from a moment before.
            await until(lambda: types in opened.queries.explain_missing(similar))

    async def test_another_type_if_the_topics_have_other_names(
        self, opened: Opened, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(endpoints, "response_writers", lambda *_: [])
        with borrowed_node() as lender:
            lender.create_service(Trigger, "/echo", nothing)
            expected = "this name is served as std_srvs/srv/Trigger by node /lender"
            await until(lambda: opened.queries.explain_missing(opened.service()) == expected)

    async def test_a_node_that_is_not_known_yet(
        self, opened: Opened, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            graph, "servers_of", lambda *_: [endpoints.Endpoint("", "std_srvs/srv/Trigger", None)]
        )
        with borrowed_node() as lender:
            lender.create_service(Trigger, "/echo", nothing)
            expected = "this name is served as std_srvs/srv/Trigger"
            await until(lambda: opened.queries.explain_missing(opened.service()) == expected)

    async def test_the_right_type_among_others_is_no_mismatch(self, opened: Opened) -> None:
        with borrowed_node() as lender, borrowed_node("other") as other:
            lender.create_service(Trigger, "/echo", nothing)
            other.create_service(SetBool, "/echo", nothing)
            service = opened.service(srv_type=SetBool)
            await until(lambda: opened.ros.node.count_services("/echo") == 2)
            assert opened.queries.explain_mismatch(service) is None
            await until(
                lambda: (
                    "served by node /other, but not matched"
                    in opened.queries.explain_missing(service)
                )
            )

    async def test_another_qos(self, opened: Opened) -> None:
        with borrowed_node() as lender:
            lender.create_service(Trigger, "/echo", nothing)
            service = opened.service(srv_type=Trigger, qos=BEST_EFFORT)
            expected = (
                "this name and type are served by node /lender, but with a QoS that does not fit "
                "the client's (Best effort publisher and reliable subscription): call with qos= "
                "and the server's QoS"
            )
            await until(lambda: opened.queries.explain_missing(service) == expected)


class TestEvents:
    """Every node of a context reports every change, although one wait set takes the event."""

    async def test_nodes_come_and_go_in_other_threads(self) -> None:
        """The waitable that is woken reports to all others, in any order."""
        stop = threading.Event()
        errors: list[Exception] = []

        class Lender:
            """Enough of a node for a waitable."""

            def __init__(self) -> None:
                self.context = self
                self.waitables: list[Any] = []
                self.add_waitable = self.waitables.append
                self.remove_waitable = self.waitables.remove

        lender = Lender()

        def churn() -> None:
            while not stop.is_set():
                made = [GraphWaitable(lender, None, nothing_changed) for _ in range(20)]  # type: ignore[arg-type]
                for waitable in made:
                    waitable.close()

        heard = 0

        def changed() -> None:
            nonlocal heard
            heard += 1

        def nothing_changed() -> None:
            """Another session's."""

        kept = GraphWaitable(lender, None, changed)  # type: ignore[arg-type]
        threads = [threading.Thread(target=churn) for _ in range(2)]
        for thread in threads:
            thread.start()
        rounds = 3000
        for _ in range(rounds):
            try:
                kept.execute(None).send(None)
            except StopIteration:
                continue
            except Exception as error:
                errors.append(error)
                break
        stop.set()
        for thread in threads:
            thread.join()
        assert errors == []
        assert heard == rounds

    async def test_two_nodes_of_a_context(self, bridge: Bridge) -> None:
        with borrowed_node() as lender:
            async with (
                open_node(bridge, lender) as one,
                open_node(bridge, "other", context=lender.context) as two,
            ):
                with borrowed_node("server") as server:
                    server.create_service(Trigger, "/new", nothing)
                    await until(lambda: one.changes and two.changes)


class TestExecutors:
    """Which bridge an executor allows."""

    def test_events_executor_is_recognised(self) -> None:
        """It is recognised outside rclpy.experimental, and as a base class."""
        from rclpy.impl.implementation_singleton import rclpy_implementation

        events_executor = rclpy_implementation.EventsExecutor
        assert events_executor.__module__ != "rclpy.experimental"

        kinds: list[Any] = [events_executor, type("Derived", (events_executor,), {})]
        for kind in kinds:
            assert bridges.takes_callbacks(kind.__new__(kind))
        assert not bridges.takes_callbacks(None)

    async def test_its_nodes_are_not_taken_from_directly(self) -> None:
        from rclpy.experimental.events_executor import EventsExecutor

        with borrowed_node() as lender:
            executor = EventsExecutor(context=lender.context)
            executor.add_node(lender)
            async with open_node("auto", lender) as opened:
                assert opened.ros.bridge == "executor"
                assert not opened.ros.graph_events
                assert lender.executor is executor
            with pytest.raises(UsageError, match="EventsExecutor"):
                async with open_node("direct", lender):
                    pass
            assert lender.executor is executor
            executor.remove_node(lender)
            executor.shutdown()
