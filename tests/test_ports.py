"""The contract of the ports: one suite for the real ones and those in memory."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Hashable
from contextlib import asynccontextmanager
from typing import Any, Literal

import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from builtin_interfaces.msg import Time
from test_msgs.action import Fibonacci, NestedMessage
from test_msgs.msg import BasicTypes, Builtins

from rosasync import InvalidServiceName
from rosasync._actions.status import read_statuses, uuid_bytes
from rosasync._core.gateway import LoopGateway
from rosasync._core.ports import ClientPort, NodePort, PortDestroyed, PublisherPort, TopicQos
from rosasync._ros.node import RosNode
from rosasync._status.wire import process_of
from rosasync.options import Limits, SessionOptions
from rosasync.testing._memory.graph import MemoryNode
from tests.support.echo import ECHO, answer_to, fill, request_of, service_class
from tests.support.fake_graph import FakeGraph
from tests.support.servers import ServerProcess
from tests.support.times import until

Kind = Literal["memory", "direct", "executor"]


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
        return len(self.node.queries.find_servers(self.node.describe(srv_type, "/port_echo", None)))

    def _deliver(self, sequence_number: int, response: Any) -> None:
        self.responses.append((sequence_number, answer_to(response)))


@pytest.fixture(params=["memory", "direct", "executor"])
async def world(request: pytest.FixtureRequest) -> AsyncIterator[World]:
    kind: Kind = request.param
    if kind == "memory":
        graph = FakeGraph()
        response_class = service_class(ECHO).Response

        async def serve(name: str) -> None:
            graph.serve(ECHO, name, lambda request: fill(request, response_class()))

        async def vanish(name: str) -> None:
            graph.find(ECHO, name)[0].close()

        world = World(serve, vanish)
        world.node = MemoryNode(graph, world.changed)
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
    await real.wait_stopped()
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
    await until(lambda: world.servers() == 1)
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
    request = world.node.make_message(srv_type.Request, {"load_namespace": "x"})
    assert isinstance(request, srv_type.Request)
    assert world.node.make_message(srv_type.Request, request) is request
    with pytest.raises(TypeError):
        world.node.make_message(srv_type.Request, srv_type.Response())
    with pytest.raises(ValueError, match="no_such_package"):
        world.node.describe("no_such_package/srv/Nothing", "/port_echo", None)


async def test_what_is_seen_instead(world: World) -> None:
    missing = world.node.describe(ECHO, "/port_ecco", None)
    await world.serve("/port_echo")
    await until(world.servers)
    assert "/port_echo" in world.node.queries.explain_missing(missing)
    assert world.node.ok()


def feedback(*sequence: int) -> Any:
    message = Fibonacci.Impl.FeedbackMessage()
    message.goal_id.uuid = [len(sequence)] * 16
    message.feedback.sequence = sequence
    return message


def sequences(messages: list[Any]) -> list[tuple[int, ...]]:
    return [tuple(message.feedback.sequence) for message in messages]


async def test_messages_come_on_the_loop_in_order_and_never_within_publish(world: World) -> None:
    message_type = Fibonacci.Impl.FeedbackMessage
    arrived: list[Any] = []
    subscription = world.node.open_subscription(
        message_type, "/port_topic", TopicQos(1000), arrived.append
    )
    publisher = world.node.open_publisher(message_type, "/port_topic", TopicQos(1000))
    await until(lambda: publisher.subscriptions() and subscription.publishers())
    for i in range(300):
        publisher.publish(feedback(i))
    assert arrived == []
    await until(lambda: len(arrived) == 300)
    assert sequences(arrived) == [(i,) for i in range(300)]
    publisher.close()
    publisher.close()
    await until(lambda: not subscription.publishers())
    subscription.close()
    subscription.close()


@asynccontextmanager
async def raw_topic(
    world: World, message_type: Any
) -> AsyncIterator[tuple[PublisherPort, list[Any]]]:
    """Open both ends of a topic; yield its publisher, and a list of what its subscription gets."""
    arrived: list[Any] = []
    subscription = world.node.open_subscription(
        message_type, "/port_topic", TopicQos(), arrived.append, raw=True
    )
    publisher = world.node.open_publisher(message_type, "/port_topic", TopicQos())
    await until(lambda: publisher.subscriptions() and subscription.publishers())
    yield publisher, arrived
    publisher.close()
    subscription.close()


async def test_a_raw_subscription_gets_bytes_with_the_uuid_of_the_goal(world: World) -> None:
    message_type = Fibonacci.Impl.FeedbackMessage
    async with raw_topic(world, message_type) as (publisher, arrived):
        publisher.publish(feedback(3, 4))
        await until(lambda: arrived)
    assert uuid_bytes(arrived[0]) == bytes([2] * 16)
    message = world.node.deserialize(message_type, arrived[0])
    assert sequences([message]) == [(3, 4)]
    with pytest.raises(ValueError, match="cannot be read|not a message"):
        world.node.deserialize(message_type, b"\0\1")


async def test_feedback_is_read_without_the_uuid_before_it(world: World) -> None:
    message_type = NestedMessage.Impl.FeedbackMessage
    message = message_type()
    message.goal_id.uuid = [7] * 16
    # Fields of eight bytes behind some of one, so that their alignment counts.
    message.feedback = NestedMessage.Feedback(
        nested_field_no_pkg=Builtins(time_value=Time(sec=1, nanosec=2)),
        nested_field=BasicTypes(bool_value=True, float64_value=2.5, int64_value=-3),
        nested_different_pkg=Time(sec=5, nanosec=6),
    )
    async with raw_topic(world, message_type) as (publisher, arrived):
        publisher.publish(message)
        await until(lambda: arrived)
    assert world.node.deserialize_feedback(NestedMessage, arrived[0]) == message.feedback
    for unreadable in (b"", bytes(20), arrived[0][:24]):
        with pytest.raises(ValueError, match="cannot be read|not a message"):
            world.node.deserialize_feedback(NestedMessage, unreadable)


async def test_a_latched_topic_has_its_newest_messages_for_those_who_come_later(
    world: World,
) -> None:
    latched = TopicQos(depth=1, latched=True)
    arrived: list[Any] = []
    publisher = world.node.open_publisher(GoalStatusArray, "/port_status", latched)
    for status in (1, 2):
        publisher.publish(GoalStatusArray(status_list=[GoalStatus(status=status)]))
    subscription = world.node.open_subscription(
        GoalStatusArray, "/port_status", latched, arrived.append
    )
    await until(lambda: arrived)
    assert [message.status_list[0].status for message in arrived] == [2]
    publisher.close()
    subscription.close()


async def test_no_message_comes_after_close(world: World) -> None:
    message_type = Fibonacci.Impl.FeedbackMessage
    arrived: list[Any] = []
    others: list[Any] = []
    closed = world.node.open_subscription(message_type, "/port_topic", TopicQos(), arrived.append)
    other = world.node.open_subscription(message_type, "/port_topic", TopicQos(), others.append)
    publisher = world.node.open_publisher(message_type, "/port_topic", TopicQos())
    await until(lambda: publisher.subscriptions() == 2)
    await until(lambda: closed.publishers() and other.publishers())
    publisher.publish(feedback(1))
    closed.close()
    await until(lambda: others)
    assert arrived == []
    other.close()
    publisher.close()


async def test_an_action_is_described_by_its_services_and_topics(world: World) -> None:
    action = world.node.describe_action("test_msgs/action/Fibonacci", "port_action")
    assert action.action_type is Fibonacci
    assert (action.name, action.type_name) == ("/port_action", "test_msgs/action/Fibonacci")
    assert action.send_goal.key.srv_name == "/port_action/_action/send_goal"
    assert action.cancel_goal.key.srv_type == "action_msgs/srv/CancelGoal"
    assert action.get_result.key.srv_type == "test_msgs/action/Fibonacci_GetResult"
    with pytest.raises(InvalidServiceName, match="'with space' is not a valid action name"):
        world.node.describe_action(Fibonacci, "with space")
    with pytest.raises(ValueError, match="did you mean 'test_msgs/action/Fibonacci'"):
        world.node.describe_action("test_msgs/action/Fibonaci", "/port_action")
    with pytest.raises(TypeError, match="not an action"):
        world.node.describe_action(service_class(ECHO), "/port_action")


async def test_statuses_are_read_without_deserializing_them(world: World) -> None:
    if world.node.bridge == "memory":
        return  # It serializes nothing.
    async with raw_topic(world, GoalStatusArray) as (publisher, arrived):
        for count in (0, 1, 2, 5):
            message = GoalStatusArray(status_list=[GoalStatus(status=i + 1) for i in range(count)])
            for i, status in enumerate(message.status_list):
                status.goal_info.goal_id.uuid = [i] * 16
            publisher.publish(message)
        await until(lambda: len(arrived) == 4)
    for count, serialized in zip((0, 1, 2, 5), arrived, strict=True):
        statuses = read_statuses(serialized)
        assert statuses is not None
        assert list(statuses) == [(bytes([i] * 16), i + 1) for i in range(count)]
        padded = read_statuses(serialized + b"\0\0\0")
        assert padded is not None
        assert len(list(padded)) == count
        assert read_statuses(serialized[:-1]) is None or count == 0
        assert read_statuses(serialized + b"\0" * 7) is None or count == 0


async def test_a_server_knows_its_clients_by_their_identities(world: World) -> None:
    taken: list[tuple[Hashable, int]] = []
    service = world.node.describe(ECHO, "/port_own", None)
    port = world.node.open_service(
        service,
        lambda _, header: taken.append((port.client_of(header), header.request_id.sequence_number)),
    )
    clients = [world.node.open_client(service, lambda *_: None) for _ in range(3)]
    for client in clients:
        await until(client.ready)
        sent = [client.send(request_of("x")) for _ in range(2)]
        await until(lambda: len(taken) == 2)
        assert taken == [(client.identity, number) for number in sent]
        taken.clear()
    assert port.clients() >= {client.identity for client in clients}
    assert len({client.identity for client in clients}) == 3
    assert world.node.queries.find_servers(service) == {port.identity}
    for client in clients:
        client.close()
    await until(lambda: not port.clients() & {client.identity for client in clients})
    port.stop()
    port.close()


async def test_clients_and_servers_of_a_node_are_of_one_process(world: World) -> None:
    service = world.node.describe(ECHO, "/port_own", None)
    port = world.node.open_service(service, lambda *_: None)
    client = world.node.open_client(service, lambda *_: None)
    assert process_of(port.identity) == process_of(client.identity) is not None
    client.close()
    port.stop()
    port.close()


async def test_a_publisher_knows_which_clients_it_reaches(world: World) -> None:
    client = world.client()
    message_type = Fibonacci.Impl.FeedbackMessage
    publisher = world.node.open_publisher(message_type, "/port_topic", TopicQos())
    # In memory, nobody can subscribe too late.
    assert publisher.reaches(client.identity) is (world.node.bridge == "memory")
    assert publisher.acknowledged()
    received: list[Any] = []
    subscription = world.node.open_subscription(
        message_type, "/port_topic", TopicQos(), received.append
    )
    await until(lambda: publisher.reaches(client.identity) and subscription.publishers())
    publisher.publish(feedback(1))
    await until(publisher.acknowledged)
    await until(lambda: received)
    subscription.close()
    await until(lambda: not publisher.reaches(client.identity) or world.node.bridge == "memory")
    publisher.close()
    client.close()
    if world.node.bridge != "memory":
        for query in (publisher.acknowledged, lambda: publisher.reaches(client.identity)):
            with pytest.raises(PortDestroyed):
                query()


async def test_publishers_are_identified(world: World) -> None:
    client = world.client()
    assert world.node.queries.find_publishers("/port_topic") == frozenset()
    publisher = world.node.open_publisher(GoalStatusArray, "/port_topic", TopicQos())
    await until(lambda: world.node.queries.find_publishers("/port_topic"))
    (found,) = world.node.queries.find_publishers("/port_topic")
    assert process_of(found) == process_of(client.identity) is not None
    publisher.close()
    await until(lambda: not world.node.queries.find_publishers("/port_topic"))
    client.close()
