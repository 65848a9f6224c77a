"""Lifecycle nodes of stock rclpy in another process."""

from __future__ import annotations

import asyncio
import copy
import pickle
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

import rosasync
from rosasync import Retry, ServiceCall, ServiceServer, Session
from rosasync.lifecycle import (
    LifecycleClient,
    LifecycleState,
    TransitionError,
    TransitionFailed,
    TransitionTimeout,
)
from rosasync.testing import VirtualClock
from tests.support.fake_graph import FakeGraph
from tests.support.managed import NodesProcess
from tests.support.times import LIMIT, TICK, until

CHANGE = "lifecycle_msgs/srv/ChangeState"
STATE = "lifecycle_msgs/srv/GetState"
SOON = 4 * TICK
AWHILE = 100 * TICK
"""Long enough for a call that another process answers, also on a busy machine."""


@pytest.fixture(scope="module")
def nodes() -> Iterator[NodesProcess]:
    """A process of stock nodes, for all tests of this module."""
    with NodesProcess() as nodes:
        yield nodes


async def test_all_transitions(session: Session, nodes: NodesProcess) -> None:
    node = LifecycleClient(session, await nodes.add("lifecycle"))
    assert await node.state() is LifecycleState.UNCONFIGURED
    assert await node.configure() == await node.state() == "inactive"
    assert await node.activate() == await node.state() == "active"
    assert await node.deactivate() == await node.state() == "inactive"
    assert await node.cleanup() == await node.state() == "unconfigured"
    assert await node.shutdown() == await node.state() == "finalized"


@pytest.mark.parametrize("steps", [(), ("configure",), ("configure", "activate")])
async def test_shutdown_from_each_state(
    session: Session, nodes: NodesProcess, steps: tuple[str, ...]
) -> None:
    node = LifecycleClient(session, await nodes.add("lifecycle"))
    for step in steps:
        await getattr(node, step)()
    assert await node.shutdown() is LifecycleState.FINALIZED
    with pytest.raises(TransitionFailed, match="it is finalized, and shutdown starts from"):
        await node.shutdown()


async def test_the_transitions_that_a_state_allows(session: Session, nodes: NodesProcess) -> None:
    node = LifecycleClient(session, await nodes.add("lifecycle"))
    found = {transition.label: transition for transition in await node.transitions()}
    assert {*found} == {"configure", "shutdown"}
    assert found["configure"].id == 1
    assert found["configure"].start is LifecycleState.UNCONFIGURED
    assert found["configure"].goal is LifecycleState.CONFIGURING
    await node.configure()
    labels = {transition.label for transition in await node.transitions()}
    assert labels == {"activate", "cleanup", "shutdown"}


async def test_one_that_the_state_does_not_allow(session: Session, nodes: NodesProcess) -> None:
    node = LifecycleClient(session, await nodes.add("lifecycle"))
    with pytest.raises(TransitionFailed, match="it is unconfigured, and activate starts from") as e:
        await node.activate()
    assert (e.value.node_name, e.value.transition) == (node.node_name, "activate")
    assert e.value.state is LifecycleState.UNCONFIGURED
    # The node has survived the question.
    assert await node.configure() == "inactive"


@pytest.mark.parametrize(
    ("kind", "steps", "state"),
    [
        ("failing", ("configure",), "unconfigured"),
        ("recovering", ("configure", "activate"), "unconfigured"),
        ("broken", ("configure",), "finalized"),
    ],
)
async def test_one_that_fails_or_raises(
    session: Session, nodes: NodesProcess, kind: str, steps: tuple[str, ...], state: str
) -> None:
    node = LifecycleClient(session, await nodes.add(kind))
    *before, last = steps
    for step in before:
        await getattr(node, step)()
    with pytest.raises(TransitionFailed, match=f"{node.node_name}: {last}: .* it is {state}") as e:
        await getattr(node, last)()
    assert e.value.state == state == await node.state()


async def discovered(node: LifecycleClient) -> None:
    """Have both services of a node called once, so that the next calls reach it at once."""
    with pytest.raises(TransitionFailed):
        await node.activate()


class TestTimeouts:
    @pytest.mark.slow
    async def test_done_if_the_node_answers_after_all(
        self, session: Session, nodes: NodesProcess
    ) -> None:
        node = LifecycleClient(session, await nodes.add("slow"))
        await discovered(node)
        transition = asyncio.create_task(node.configure(timeout=AWHILE))
        await nodes.held()
        # The node answers nothing while it configures. It is asked for its state when the
        # transition has timed out, and answers when it has finished.
        await until(lambda: in_flight(session, f"{node.node_name}/get_state"))
        await nodes.release()
        assert await transition is LifecycleState.INACTIVE

    async def test_unknown_if_the_node_is_silent(
        self, session: Session, nodes: NodesProcess
    ) -> None:
        node = LifecycleClient(session, await nodes.add("slow"))
        await discovered(node)
        with pytest.raises(TransitionTimeout, match="state could not be read either") as caught:
            await node.configure(timeout=SOON)
        assert caught.value.state is None
        assert caught.value.outcome == "unknown"
        assert isinstance(caught.value.__cause__, rosasync.ResponseTimeout)
        await nodes.held()
        await nodes.release()
        assert await node.state() == "inactive"

    @pytest.mark.slow
    async def test_unknown_if_it_still_configures(
        self, session: Session, nodes: NodesProcess
    ) -> None:
        node = LifecycleClient(session, await nodes.add("slow_and_talking"))
        await discovered(node)
        with pytest.raises(TransitionTimeout, match="the node is configuring") as caught:
            await node.configure(timeout=AWHILE)
        assert caught.value.state is LifecycleState.CONFIGURING
        assert caught.value.outcome == "unknown"
        await nodes.release()

    @pytest.mark.parametrize(
        ("number", "outcome"), [(1, "not done"), (3, "not done"), (15, "unknown"), (99, "unknown")]
    )
    async def test_by_the_state_of_a_node_that_does_not_answer(
        self, fake_graph: FakeGraph, virtual_clock: VirtualClock, number: int, outcome: str
    ) -> None:
        async with fake_graph.session() as session, never_changing(session, number):
            change = LifecycleClient(session, "/stuck").configure(timeout=AWHILE)
            with pytest.raises(TransitionTimeout, match="/stuck: configure: not answered") as e:
                await virtual_clock.skip(change)
            assert e.value.outcome == outcome

    async def test_done_by_the_state_of_a_node_that_does_not_answer(
        self, fake_graph: FakeGraph, virtual_clock: VirtualClock
    ) -> None:
        async with fake_graph.session() as session, never_changing(session, 2):
            change = LifecycleClient(session, "/stuck").configure(timeout=AWHILE)
            assert await virtual_clock.skip(change) == "inactive"


@pytest.mark.parametrize(
    ("label", "state", "number"),
    [("activate", 2, 3), ("shutdown", 1, 5), ("shutdown", 2, 6), ("shutdown", 3, 7)],
)
async def test_number_and_label_name_the_same_transition(
    session: Session, label: str, state: int, number: int
) -> None:
    """Stock nodes read the label, micro-ROS reads the number."""
    asked: list[tuple[int, str]] = []

    def change(request: Any, response: Any) -> Any:
        asked.append((request.transition.id, request.transition.label))
        response.success = True
        return response

    async with (
        session.serve(CHANGE, "/tiny/change_state", change),
        telling(session, "/tiny", state),
    ):
        await getattr(LifecycleClient(session, "/tiny"), label)()
    assert asked == [(number, label)]


async def test_a_node_without_a_lifecycle(session: Session, nodes: NodesProcess) -> None:
    node = LifecycleClient(session, await nodes.add("no_services"), timeout=SOON)
    for ask in (node.state, node.transitions, node.configure, node.shutdown):
        with pytest.raises(rosasync.ServiceUnavailable):
            await ask()


async def test_many_nodes_at_a_time(session: Session, nodes: NodesProcess) -> None:
    clients = [LifecycleClient(session, await nodes.add("lifecycle")) for _ in range(5)]
    assert await asyncio.gather(*(c.configure() for c in clients)) == ["inactive"] * 5
    assert await asyncio.gather(*(c.activate() for c in clients)) == ["active"] * 5


async def test_names_and_timeouts(session: Session) -> None:
    assert LifecycleClient(session, "arm").node_name == "/arm"
    assert repr(LifecycleClient(session, "/a/b")) == "<LifecycleClient /a/b>"
    with pytest.raises(rosasync.InvalidServiceName):
        LifecycleClient(session, "/no spaces")
    with pytest.raises(ValueError, match="timeout"):
        LifecycleClient(session, "/arm", timeout=float("nan"))


@pytest.mark.parametrize("kind", [TransitionError, TransitionFailed, TransitionTimeout])
def test_the_errors_are_copied_and_pickled(kind: type[TransitionError]) -> None:
    error = kind("no", node_name="/a", transition="cleanup", state=LifecycleState.ACTIVE)
    for twin in (copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert type(twin) is kind
        assert (str(twin), twin.node_name, twin.transition) == ("no", "/a", "cleanup")
        assert twin.state is LifecycleState.ACTIVE


class LossyNode:
    """A node in memory that configures, and loses requests or its responses.

    Attributes:
        asked: how often a transition has reached it.
        made: how often it was made.
        state: the number of its state.
    """

    def __init__(self, session: Session, lost: str, then: int = 2) -> None:
        self.asked = self.made = 0
        self.state = 1
        self._lost = lost
        self._then = then
        self._kept: list[ServiceCall[Any, Any]] = []
        session.serve(CHANGE, "/lossy/change_state", self._change)
        session.serve(STATE, "/lossy/get_state", self._tell)

    def _change(self, call: ServiceCall[Any, Any]) -> None:
        self.asked += 1
        first = self.asked == 1
        if not (first and self._lost == "request"):
            self.made += 1
            self.state = self._then
        call.response.success = self.state == 2
        if first:
            self._kept.append(call)
        else:
            call.respond(call.response)

    def _tell(self, request: Any, response: Any) -> Any:
        response.current_state.id = self.state
        return response

    def end(self) -> None:
        """Answer what was kept, so that no call is dropped."""
        for call in self._kept:
            call.respond(call.response)


class TestRetry:
    @pytest.fixture
    async def lossy(self, fake_graph: FakeGraph) -> AsyncIterator[tuple[Session, Session]]:
        async with fake_graph.session() as server, fake_graph.session(timeout=LIMIT) as client:
            yield server, client

    @pytest.mark.parametrize("lost", ["request", "response"])
    async def test_a_transition_is_made_once(
        self, lossy: tuple[Session, Session], lost: str
    ) -> None:
        server, client = lossy
        node = LossyNode(server, lost)
        state = await LifecycleClient(client, "/lossy", retry=Retry(after=TICK)).configure()
        assert state is LifecycleState.INACTIVE
        assert node.made == 1
        assert node.asked == (2 if lost == "request" else 1)
        node.end()

    async def test_it_waits_for_the_end_of_a_transition(
        self, lossy: tuple[Session, Session]
    ) -> None:
        server, client = lossy
        node = LossyNode(server, "response", then=LifecycleState.CONFIGURING.id)
        camera = LifecycleClient(client, "/lossy", retry=Retry(after=TICK))
        task = asyncio.create_task(camera.configure())
        await until(lambda: node.asked)
        await asyncio.sleep(4 * TICK)
        assert not task.done()
        node.state = LifecycleState.INACTIVE.id
        assert await task is LifecycleState.INACTIVE
        assert node.asked == 1
        node.end()

    async def test_another_state_is_a_failure(self, lossy: tuple[Session, Session]) -> None:
        server, client = lossy
        node = LossyNode(server, "response", then=LifecycleState.FINALIZED.id)
        with pytest.raises(TransitionFailed, match="it is finalized"):
            await LifecycleClient(client, "/lossy", retry=Retry(after=TICK)).configure()
        assert node.asked == 1
        node.end()

    async def test_it_is_sent_once_by_default(self, lossy: tuple[Session, Session]) -> None:
        server, client = lossy
        node = LossyNode(server, "request")
        with pytest.raises(TransitionTimeout):
            await LifecycleClient(client, "/lossy").configure(timeout=4 * TICK)
        assert node.asked == 1
        node.end()

    async def test_it_asks_the_node_itself(self, lossy: tuple[Session, Session]) -> None:
        async def verify() -> None: ...

        with pytest.raises(ValueError, match="leave out verify"):
            LifecycleClient(lossy[1], "/lossy", retry=Retry(verify=verify))
        with pytest.raises(TypeError, match=r"retry must be a rosasync\.Retry"):
            LifecycleClient(lossy[1], "/lossy", retry=3)  # type: ignore[arg-type]


def in_flight(session: Session, name: str) -> bool:
    keys = session.pool.statistics().keys
    return any(key.srv_name == name and one.in_flight for key, one in keys.items())


def telling(session: Session, name: str, state: int) -> ServiceServer[Any, Any]:
    """Serve the state of a node."""

    def read(request: Any, response: Any) -> Any:
        response.current_state.id = state
        return response

    return session.serve(STATE, f"{name}/get_state", read)


@asynccontextmanager
async def never_changing(session: Session, state: int) -> AsyncIterator[None]:
    """Serve a node that never answers to a transition, and says that it is in this state."""
    calls: list[ServiceCall[Any, Any]] = []
    async with (
        session.serve(CHANGE, "/stuck/change_state", calls.append),
        telling(session, "/stuck", state),
    ):
        await session.wait_for_service(CHANGE, "/stuck/change_state", timeout=LIMIT)
        yield
        for call in calls:
            call.respond(call.response)
