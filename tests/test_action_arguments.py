"""The arguments of a goal: every way to send one checks them alike, before anything is sent."""

from __future__ import annotations

import asyncio
import math
import uuid
from collections.abc import Awaitable, Callable
from decimal import Decimal
from functools import partial
from typing import Any

import pytest
from py_trees.trees import BehaviourTree
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci, NestedMessage

from rosasync import (
    ActionState,
    AsyncActionProxy,
    GoalStatus,
    GoalTimeout,
    InvalidServiceName,
    ServiceUnavailable,
    Session,
    UsageError,
)
from rosasync.behaviours import SendGoal
from tests.support.times import LIMIT, TICK, until

NAME = "/fibonacci"
Way = Callable[..., Awaitable[object]]


class Server:
    """An action server in memory whose goals run until they are cancelled.

    Attributes:
        requests: the goals that it was asked to accept.
    """

    def __init__(self, session: Session) -> None:
        self.requests: list[Fibonacci.Goal] = []
        self.server = session.serve_action(
            Fibonacci, NAME, self._run, on_goal=self._on_goal, concurrency=100
        )

    def _on_goal(self, request: Fibonacci.Goal) -> bool:
        self.requests.append(request)
        return True

    async def _run(self, goal: Any) -> Any:
        await asyncio.sleep(LIMIT)


@pytest.fixture
def session(sessions: tuple[Session, Session]) -> Session:
    return sessions[0]


@pytest.fixture
async def server(sessions: tuple[Session, Session]) -> Server:
    return Server(sessions[1])


async def act(session: Session, wanted: Any, name: Any, goal: Any, **options: Any) -> object:
    return await session.act(wanted, name, goal, **options)


async def block(session: Session, wanted: Any, name: Any, goal: Any, **options: Any) -> object:
    async with session.goal(wanted, name, goal, **options) as handle:
        return handle


async def thread(session: Session, wanted: Any, name: Any, goal: Any, **options: Any) -> object:
    act = session.from_thread.act
    return await asyncio.to_thread(lambda: act(wanted, name, goal, **options))


async def proxy(session: Session, wanted: Any, name: Any, goal: Any, **options: Any) -> object:
    proxy: Any = AsyncActionProxy(session, wanted, name)
    proxy.send_goal(goal, **options)
    return proxy


async def leaf(session: Session, wanted: Any, name: Any, goal: Any, **options: Any) -> object:
    tree = BehaviourTree(SendGoal("leaf", wanted, name, goal, **options))
    tree.setup(session=session)
    return tree


WAYS: list[Way] = [act, block, thread, proxy, leaf]
WITHOUT: dict[Way, tuple[str, ...]] = {
    block: ("timeout", "on_feedback"),
    proxy: ("on_feedback",),
    # A mistake in its goal is that of a run.
    leaf: ("goal",),
}
WRONG: list[tuple[str, Any, type[Exception], str]] = [
    ("action_type", SetBool, TypeError, "it is a service, for session.call"),
    ("action_type", Fibonacci.Goal, TypeError, "pass Fibonacci itself"),
    ("action_type", None, TypeError, "expected an action class, or its name such as"),
    ("action_type", NAME, ValueError, "the type comes before the name"),
    ("action_type", "test_msgs/Fibonacci", ValueError, "did you mean 'test_msgs/action/Fibonacci'"),
    ("action_name", None, TypeError, "the name of the action must be a str, not NoneType"),
    ("action_name", "/a b", InvalidServiceName, "'/a b' is not a valid action name"),
    ("goal", 5, TypeError, "expected test_msgs/action/Fibonacci_Goal, got int 5"),
    ("goal", Fibonacci.Goal, TypeError, "got the class test_msgs/action/Fibonacci_Goal"),
    ("goal", NestedMessage.Goal(), TypeError, "got test_msgs/action/NestedMessage_Goal"),
    ("goal", {"ordr": 1}, ValueError, "ordr: no such field .*; did you mean 'order'"),
    ("goal", {"order": "1"}, TypeError, "order: expected int32, got str '1'"),
    ("goal", {"order": None}, TypeError, "order: expected int32, got None"),
    ("goal", {"order": 2**40}, ValueError, "order: 1099511627776 is out of the range of int32"),
    ("timeout", "5", TypeError, "^timeout must be a number of seconds or None, not str"),
    ("timeout", True, TypeError, "^timeout must be .* not bool"),
    ("timeout", math.nan, ValueError, "^timeout must be .* not NaN"),
    ("accept_timeout", "5", TypeError, "^accept_timeout must be a number of seconds or None"),
    ("accept_timeout", Decimal(5), TypeError, "^accept_timeout must be .* not Decimal"),
    ("wait", None, TypeError, "^wait must be True, False or a number of seconds, not NoneType"),
    ("wait", "no", TypeError, "^wait must be True, False or a number of seconds, not str"),
    ("on_feedback", 3, TypeError, "on_feedback must be callable, not int"),
    ("on_feedback", lambda: None, TypeError, r"on_feedback is called as on_feedback\(feedback\)"),
]


@pytest.mark.parametrize("way", WAYS)
async def test_wrong_arguments_raise_and_nothing_is_sent(
    session: Session, server: Server, way: Way
) -> None:
    given: dict[str, Any] = {"action_type": Fibonacci, "action_name": NAME, "goal": {"order": 1}}
    for option, value, error, text in WRONG:
        if option in WITHOUT.get(way, ()):
            continue
        changed = {**given, option: value}
        first = [changed.pop(name) for name in given]
        with pytest.raises(error, match=text):
            await way(session, *first, **changed)
    await asyncio.sleep(TICK)
    assert server.requests == []
    assert session.core.actions.out == 0


@pytest.mark.parametrize("seconds", [0, -1, -math.inf])
async def test_without_time_nothing_is_sent(
    session: Session, server: Server, seconds: float
) -> None:
    async with session.goal(Fibonacci, NAME):
        assert len(server.requests) == 1
    text = "the goal was not sent within 0 s: no time was left"
    each: tuple[dict[str, Any], ...] = ({"timeout": seconds}, {"accept_timeout": seconds})
    for options in each:
        with pytest.raises(GoalTimeout, match=text):
            await session.act(Fibonacci, NAME, **options)
        with pytest.raises(GoalTimeout, match=text):
            await thread(session, Fibonacci, NAME, None, **options)
        action: AsyncActionProxy[Any, Any, Any] = AsyncActionProxy(session, Fibonacci, NAME)
        action.send_goal(**options)
        await until(partial(has_timed_out, action))
        with pytest.raises(ServiceUnavailable, match="/nothing: no action server"):
            await session.act(Fibonacci, "/nothing", **options)
    with pytest.raises(GoalTimeout, match=text):
        await block(session, Fibonacci, NAME, None, accept_timeout=seconds)
    with pytest.raises(ServiceUnavailable, match="/nothing: no action server"):
        await session.act(Fibonacci, "/nothing", wait=seconds)
    await asyncio.sleep(TICK)
    assert len(server.requests) == 1
    assert session.core.actions.out == 0


def has_timed_out(action: AsyncActionProxy[Any, Any, Any]) -> bool:
    return action.get_state() is ActionState.TIMEOUT


async def test_a_block_explains_how_it_is_entered(session: Session, server: Server) -> None:
    blocks: dict[str, Any] = {
        "session.goal": session.goal(Fibonacci, NAME),
        "session.attach": session.attach(Fibonacci, NAME, uuid.uuid4()),
    }
    for method, entered in blocks.items():
        how = rf"`async with {method}\(…\) as goal:`"
        with pytest.raises(TypeError, match=rf"cannot be awaited: it is entered, with {how}"):
            await entered
        with pytest.raises(TypeError, match=rf"has no feedback: it is entered, with {how}"):
            async for _ in entered:
                pass
        with pytest.raises(AttributeError, match=rf"has no 'result': it is entered, with {how}"):
            await entered.result()
        async with entered:
            pass
        with pytest.raises(UsageError, match=rf"is entered once: call {method}\(…\) again"):
            await entered.__aenter__()
    assert len(server.requests) == 1


async def test_a_goal_belongs_to_its_loop(session: Session, server: Server) -> None:
    async with session.goal(Fibonacci, NAME) as goal:

        async def detach() -> None:
            goal.detach()

        for use in (goal.result, goal.cancel, goal.__anext__, detach):
            with pytest.raises(UsageError, match="belongs to the loop of its session: in another"):
                await asyncio.to_thread(asyncio.run, use())
        await goal.cancel()
    assert goal.status is GoalStatus.CANCELED


@pytest.mark.parametrize("given", [None, "c0ffee", b"", 5])
async def test_an_id_that_is_none(session: Session, given: Any) -> None:
    with pytest.raises(TypeError, match=r"goal_id must be a uuid.UUID, such as goal.id, or uuid"):
        session.attach(Fibonacci, NAME, given)


async def test_the_id_that_stands_for_every_goal(session: Session) -> None:
    with pytest.raises(ValueError, match="goal_id has only zeros"):
        session.attach(Fibonacci, NAME, uuid.UUID(int=0))


async def test_hooks_of_a_server_take_their_arguments(session: Session) -> None:
    serve: Any = session.serve_action

    async def handler(goal: Any) -> Any: ...

    for option, hook, shape in (
        ("on_goal", lambda: True, "on_goal(request)"),
        ("on_goal", lambda goal, request: True, "on_goal(request)"),
        ("on_cancel", lambda: True, "on_cancel(goal)"),
        ("on_error", lambda error: None, "on_error(goal, error)"),
    ):
        with pytest.raises(TypeError) as caught:
            serve(Fibonacci, "/bad", handler, **{option: hook})
        assert str(caught.value).startswith(f"{option} is called as {shape}, and <function")
    assert session.statistics().action_servers == ()
