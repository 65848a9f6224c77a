"""AsyncActionProxy, SendGoal and `session.from_thread.act`: in memory, and with stock servers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any

import pytest
from py_trees.blackboard import Blackboard
from py_trees.common import Status
from py_trees.trees import BehaviourTree
from test_msgs.action import Fibonacci

from rosasync import (
    ActionState,
    AsyncActionProxy,
    CancelRejected,
    GoalAborted,
    GoalRejected,
    GoalTimeout,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync.behaviours import SendGoal
from tests.support.action_servers import ActionServerProcess, none_runs
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.conftest import Bridge

State = ActionState


class Server:
    """An action server in memory, whose goals go on when the test says so."""

    def __init__(self, session: Session) -> None:
        self.orders: list[int] = []
        self.cancelled: list[int] = []
        self.go_on = asyncio.Event()
        self.agrees = True
        self.accepts = True
        self.error: Exception | None = None
        self.server = session.serve_action(
            Fibonacci,
            "/fibonacci",
            self._handle,
            on_goal=lambda request: self.accepts,
            on_cancel=lambda goal: self.agrees,
            on_busy="queue",
            concurrency=10,
        )

    async def _handle(self, goal: Any) -> Any:
        order = goal.request.order
        self.orders.append(order)
        goal.feedback({"sequence": [order]})
        try:
            await self.go_on.wait()
        except asyncio.CancelledError:
            self.cancelled.append(order)
            raise
        if self.error is not None:
            raise self.error
        return {"sequence": [order, order]}


@pytest.fixture
def session(sessions: tuple[Session, Session]) -> Session:
    return sessions[0]


@pytest.fixture
async def server(sessions: tuple[Session, Session]) -> Server:
    return Server(sessions[1])


def reaches(proxy: AsyncActionProxy[Any, Any, Any], state: ActionState) -> Callable[[], bool]:
    return lambda: proxy.get_state() is state


async def test_a_goal_goes_through_its_states(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    assert proxy.get_state() is State.IDLE
    assert proxy.get_result() is None
    proxy.send_goal({"order": 3})
    assert proxy.get_state() is State.WAITING
    assert repr(proxy) == "<AsyncActionProxy /fibonacci WAITING>"
    await until(reaches(proxy, State.ACTIVE))
    await until(proxy.get_feedback)
    assert proxy.get_feedback().sequence[0] == 3  # type: ignore[union-attr]
    assert proxy.get_result() is None
    server.go_on.set()
    await until(reaches(proxy, State.SUCCEEDED))
    assert list(proxy.get_result().sequence) == [3, 3]  # type: ignore[union-attr]
    assert proxy.get_state() is State.IDLE
    assert proxy.get_errors() == []


async def test_a_goal_is_cancelled(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal({"order": 3})
    await until(reaches(proxy, State.ACTIVE))
    proxy.cancel_goal()
    assert proxy.get_state() is State.CANCELING
    await until(reaches(proxy, State.CANCELED))
    assert server.cancelled == [3]
    proxy.cancel_goal()
    assert proxy.get_state() is State.CANCELED


async def test_a_goal_that_waits_is_cancelled_at_once(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    for order in range(5):
        proxy.send_goal({"order": order})
        for _ in range(order):
            await asyncio.sleep(0)
        proxy.cancel_goal()
    await until(lambda: len(server.cancelled) == len(server.orders))
    assert proxy.get_state() in (State.CANCELED, State.CANCELING)


async def test_a_server_may_refuse_to_cancel(session: Session, server: Server) -> None:
    server.agrees = False
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal({"order": 3})
    await until(reaches(proxy, State.ACTIVE))
    proxy.cancel_goal()
    await until(reaches(proxy, State.ACTIVE))
    await until(proxy.get_errors)
    assert isinstance(proxy.get_errors()[0], CancelRejected)
    server.go_on.set()
    await until(reaches(proxy, State.SUCCEEDED))
    assert proxy.get_errors() == []


async def test_a_new_goal_replaces_and_cancels_the_old_one(
    session: Session, server: Server
) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal({"order": 1})
    await until(reaches(proxy, State.ACTIVE))
    proxy.send_goal({"order": 2})
    assert proxy.get_feedback() is None
    await until(lambda: server.cancelled == [1])
    server.go_on.set()
    await until(reaches(proxy, State.SUCCEEDED))
    assert list(proxy.get_result().sequence) == [2, 2]  # type: ignore[union-attr]


async def test_failures_have_states_and_errors(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")

    async def ends(state: ActionState, error: type[Exception]) -> None:
        await until(reaches(proxy, state))
        assert [type(each) for each in proxy.get_errors()] == [error]

    server.accepts = False
    proxy.send_goal()
    await ends(State.REJECTED, GoalRejected)
    server.accepts = True
    proxy.send_goal(timeout=TICK)
    await ends(State.TIMEOUT, GoalTimeout)
    server.error = GoalAborted("stuck")
    server.go_on.set()
    proxy.send_goal()
    await ends(State.ABORTED, GoalAborted)
    with pytest.raises(ValueError, match="ordr"):
        proxy.send_goal({"ordr": 1})
    assert proxy.get_state() is State.ABORTED
    other = AsyncActionProxy(session, Fibonacci, "/nothing")
    other.send_goal(wait=False)
    await until(reaches(other, State.TIMEOUT))
    assert isinstance(other.get_errors()[0], ServiceUnavailable)


async def test_shutdown_and_the_end_of_the_session(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    other = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    proxy.send_goal({"order": 1})
    other.send_goal({"order": 2})
    await until(reaches(proxy, State.ACTIVE))
    proxy.shutdown()
    with pytest.raises(UsageError, match="was shut down"):
        proxy.send_goal()
    await until(reaches(proxy, State.CANCELED))
    await until(reaches(other, State.ACTIVE))
    await session.aclose()
    assert other.get_state() is State.ERROR
    assert isinstance(other.get_errors()[0], SessionClosed)
    assert sorted(server.cancelled) == [1, 2]
    with pytest.raises(SessionClosed):
        AsyncActionProxy(session, Fibonacci, "/fibonacci")


async def test_ticks_of_another_thread(session: Session, server: Server) -> None:
    proxy = AsyncActionProxy(session, Fibonacci, "/fibonacci")
    server.go_on.set()

    def tick() -> list[int]:
        proxy.send_goal({"order": 4})
        while proxy.get_state() in (State.WAITING, State.ACTIVE):
            pass
        result = proxy.get_result()
        assert result is not None
        return list(result.sequence)

    assert await asyncio.to_thread(tick) == [4, 4]


# The behaviour.


async def run(tree: BehaviourTree) -> Status:
    def has_ended() -> bool:
        tree.tick()
        return tree.root.status is not Status.RUNNING

    await until(has_ended)
    return tree.root.status


async def test_a_leaf_sends_a_goal(session: Session, server: Server) -> None:
    seen: list[int] = []

    def on_feedback(feedback: Fibonacci.Feedback) -> None:
        seen.append(feedback.sequence[0])
        server.go_on.set()

    leaf = SendGoal(
        "count",
        Fibonacci,
        "/fibonacci",
        lambda: {"order": 5},
        key_result="result",
        key_feedback="feedback",
        on_feedback=on_feedback,
    )
    tree = BehaviourTree(leaf)
    tree.setup(session=session)
    assert await run(tree) is Status.SUCCESS
    assert seen == [5]
    assert list(Blackboard.get("result").sequence) == [5, 5]
    assert list(Blackboard.get("feedback").sequence) == [5]
    tree.shutdown()


async def test_a_leaf_fails_with_its_goal(session: Session, server: Server) -> None:
    server.error = GoalAborted("stuck", result={"sequence": [9]})
    server.go_on.set()
    leaf = SendGoal("count", Fibonacci, "/fibonacci", {"order": 5}, key_error="error")
    tree = BehaviourTree(leaf)
    tree.setup(session=session)
    assert await run(tree) is Status.FAILURE
    error = Blackboard.get("error")
    assert isinstance(error, GoalAborted)
    assert list(error.result.sequence) == [9]
    server.error = None
    assert await run(tree) is Status.SUCCESS
    assert not Blackboard.exists("error")
    tree.shutdown()


async def test_an_interrupted_leaf_cancels_its_goal(session: Session, server: Server) -> None:
    leaf = SendGoal("count", Fibonacci, "/fibonacci", {"order": 5})
    tree = BehaviourTree(leaf)
    tree.setup(session=session)
    tree.tick()
    await until(lambda: server.orders)
    tree.tick()
    tree.root.stop(Status.INVALID)
    await until(lambda: server.cancelled == [5])
    tree.shutdown()
    with pytest.raises(UsageError, match="not set up"):
        leaf.proxy  # noqa: B018


async def test_a_function_of_a_leaf_that_raises_cancels_the_goal(
    session: Session, server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(feedback: Fibonacci.Feedback) -> None:
        raise ZeroDivisionError

    leaf = SendGoal("count", Fibonacci, "/fibonacci", on_feedback=fails, key_error="error")
    tree = BehaviourTree(leaf)
    tree.setup(session=session)
    assert await run(tree) is Status.FAILURE
    assert isinstance(Blackboard.get("error"), ZeroDivisionError)
    await until(lambda: server.cancelled == [0])
    assert "the goal was not handled" in caplog.text
    tree.shutdown()


async def test_an_error_of_on_error_is_the_error_of_the_run(
    session: Session, server: Server, caplog: pytest.LogCaptureFixture
) -> None:
    server.error = GoalAborted("blocked")
    server.go_on.set()

    def fails(error: Exception) -> Status:
        raise ZeroDivisionError("in on_error")

    leaf = SendGoal("count", Fibonacci, "/fibonacci", on_error=fails, key_error="error")
    tree = BehaviourTree(leaf)
    tree.setup(session=session)
    assert await run(tree) is Status.FAILURE
    error = Blackboard.get("error")
    assert isinstance(error, ZeroDivisionError)
    assert isinstance(error.__context__, GoalAborted)
    assert leaf.feedback_message == "in on_error"
    assert "the error was not handled" in caplog.text
    tree.shutdown()


async def test_a_leaf_takes_its_goal_from_the_blackboard(session: Session, server: Server) -> None:
    with pytest.raises(TypeError, match="either a goal or a key_goal"):
        SendGoal("count", Fibonacci, "/fibonacci", {"order": 1}, key_goal="goal")
    leaf = SendGoal("count", Fibonacci, "/fibonacci", key_goal="plan.goal", key_error="error")
    tree = BehaviourTree(leaf)
    with pytest.raises(KeyError, match="has no session"):
        leaf.setup()
    tree.setup(session=session)
    assert await run(tree) is Status.FAILURE
    assert isinstance(Blackboard.get("error"), KeyError)

    class Plan:
        goal = Fibonacci.Goal(order=6)

    Blackboard.set("plan", Plan())
    server.go_on.set()
    assert await run(tree) is Status.SUCCESS
    assert server.orders == [6]
    tree.shutdown()


# Threads.


async def test_another_thread_acts(session: Session, server: Server) -> None:
    seen: list[int] = []

    def on_feedback(feedback: Fibonacci.Feedback) -> None:
        seen.append(feedback.sequence[0])
        server.go_on.set()

    def act() -> list[int]:
        result = session.from_thread.act(
            Fibonacci,
            "/fibonacci",
            {"order": 7},
            on_feedback=on_feedback,
        )
        return list(result.sequence)

    assert await asyncio.to_thread(act) == [7, 7]
    assert seen == [7]
    with pytest.raises(UsageError, match=r"use await session.act\(…\)"):
        session.from_thread.act(Fibonacci, "/fibonacci")


async def test_a_thread_that_gives_up_cancels_its_goal(session: Session, server: Server) -> None:
    with pytest.raises(GoalTimeout, match="within"):
        await asyncio.to_thread(
            session.from_thread.act, Fibonacci, "/fibonacci", {"order": 7}, timeout=20 * TICK
        )
    await until(lambda: server.cancelled == [7])


# Stock servers.


@pytest.fixture
async def real(bridge: Bridge) -> AsyncIterator[Session]:
    """A session on real ROS, on each bridge."""
    async with Session("ticks", bridge=bridge, timeout=LIMIT) as session:
        yield session


async def test_a_proxy_with_a_stock_server(
    real: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True)
    proxy = AsyncActionProxy(real, Fibonacci, "/held")
    proxy.send_goal({"order": 3})
    await until(reaches(proxy, State.ACTIVE))
    proxy.send_goal({"order": 2})
    await until(reaches(proxy, State.ACTIVE))
    await action_server.goals("/held", at_least=2)
    await action_server.release("/held")
    await until(reaches(proxy, State.SUCCEEDED))
    assert list(proxy.get_result().sequence) == [0, 1]  # type: ignore[union-attr]


@pytest.mark.parametrize("by", ["proxy", "leaf"])
async def test_a_goal_that_a_stock_server_has_not_accepted_yet_is_cancelled(
    real: Session, action_server: ActionServerProcess, by: str
) -> None:
    """Nobody waits for that: the proxy and the leaf go on at once."""
    await action_server.serve("/slow", hold=True, idle=True, accept_later=True)
    await real.wait_for_service(Fibonacci.Impl.SendGoalService, "/slow/_action/send_goal")
    if by == "proxy":
        proxy = AsyncActionProxy(real, Fibonacci, "/slow")
        proxy.send_goal()
        await action_server.asked("/slow")
        proxy.cancel_goal()
        assert proxy.get_state() is State.CANCELED
    else:
        tree = BehaviourTree(SendGoal("leaf", Fibonacci, "/slow"))
        tree.setup(session=real)
        tree.tick()
        await action_server.asked("/slow")
        tree.root.stop(Status.INVALID)
        tree.shutdown()
    await action_server.accept("/slow")
    await action_server.goals("/slow", at_least=1)
    await none_runs(action_server, "/slow")


async def test_a_leaf_with_a_stock_server(
    real: Session, action_server: ActionServerProcess
) -> None:
    await action_server.serve("/held", hold=True, feedback=2, readers=1)
    leaf = SendGoal("count", Fibonacci, "/held", {"order": 2}, key_result="result")
    tree = BehaviourTree(leaf)
    tree.setup(session=real)
    tree.tick()
    await until(lambda: leaf.proxy.get_feedback())
    await action_server.release("/held")
    assert await run(tree) is Status.SUCCESS
    assert list(Blackboard.get("result").sequence) == [0, 1]
    tree.shutdown()


async def test_a_thread_with_a_stock_server(
    real: Session, action_server: ActionServerProcess
) -> None:
    act = real.from_thread.act
    await action_server.serve("/fibonacci")
    result = await asyncio.to_thread(act, Fibonacci, "/fibonacci", {"order": 3})
    assert list(result.sequence) == [0, 1, 2]
    await action_server.serve("/held", hold=True)
    async with real.goal(Fibonacci, "/held"):
        pass
    goal = asyncio.create_task(asyncio.to_thread(act, Fibonacci, "/held", timeout=20 * TICK))
    await action_server.goals("/held", at_least=2)
    with pytest.raises(GoalTimeout):
        await goal
    await none_runs(action_server, "/held")


async def test_on_the_executors_thread(real: Session) -> None:
    outcome: Future[Any] = Future()

    def callback() -> None:
        try:
            real.from_thread.act(Fibonacci, "/fibonacci")
        except BaseException as error:
            outcome.set_exception(error)

    real.node.executor.create_task(callback)
    with pytest.raises(UsageError, match="executor"):
        await asyncio.wrap_future(outcome)
