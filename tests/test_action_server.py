"""Action servers, with stock rclpy clients in another process."""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Iterator
from typing import Any, TypeAlias

import pytest
from test_msgs.action import Fibonacci, NestedMessage

from rosasync import GoalAborted, GoalStatus, InvalidServiceName, Session, SessionClosed, UsageError
from rosasync._actions import feedback, server_goals
from tests.support.action_clients import ActionClientProcess, Ended
from tests.support.serving import UnmatchedClients
from tests.support.times import LIMIT, TICK, until

S = GoalStatus
AnyGoal: TypeAlias = Any
NONE, REJECTED, UNKNOWN_GOAL_ID, GOAL_TERMINATED = range(4)
OTHER = uuid.uuid4().hex


@pytest.fixture(scope="module")
def stock() -> Iterator[ActionClientProcess]:
    """A process of stock action clients."""
    with ActionClientProcess() as child:
        yield child


@pytest.fixture(autouse=True)
def hold_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hold feedback back longer for clients that a busy machine discovers later."""
    monkeypatch.setattr(feedback, "HOLD_TIME", LIMIT)


@pytest.fixture
def name() -> str:
    """A name for each test: what a stock client learns of a server outlives the test."""
    return f"/fibonacci_{uuid.uuid4().hex[:8]}"


class Steps:
    """A handler that the test leads: it goes on with `step`, and keeps its goals.

    Attributes:
        goals: the goals it has begun, in order.
        ended: how each has left the handler.
    """

    def __init__(self) -> None:
        self.goals: list[AnyGoal] = []
        self.ended: list[str] = []
        self._next = asyncio.Semaphore(0)
        self._errors: dict[int, Exception] = {}

    async def __call__(self, goal: AnyGoal) -> Any:
        self.goals.append(goal)
        try:
            await self._next.acquire()
        except asyncio.CancelledError:
            self.ended.append("cancelled")
            raise
        self.ended.append("returned")
        return fibonacci(goal.request.order)

    def step(self) -> None:
        """Let one goal end."""
        self._next.release()


def fibonacci(order: int) -> dict[str, Any]:
    return {"sequence": list(range(order))}


async def at_once(goal: AnyGoal) -> Any:
    return fibonacci(goal.request.order)


class TestStates:
    """Each transition of a goal's status, as a stock client sees it."""

    async def test_accepted_executing_succeeded(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        await stock.watch(name)
        first = await stock.send(name, 3)
        second = await stock.send(name, 2)
        assert first is not None
        assert second is not None
        assert await stock.statuses(name, second, S.ACCEPTED) == [S.ACCEPTED]
        steps.step()
        assert await stock.ended(first) == Ended(S.SUCCEEDED, [0, 1, 2])
        assert await stock.statuses(name, second, S.EXECUTING) == [S.ACCEPTED, S.EXECUTING]
        steps.step()
        assert await stock.ended(second) == Ended(S.SUCCEEDED, [0, 1])
        assert await stock.statuses(name, first, S.SUCCEEDED) == [S.EXECUTING, S.SUCCEEDED]
        await stock.statuses(name, second, S.SUCCEEDED)
        assert await stock.listed(name) == {first: S.SUCCEEDED, second: S.SUCCEEDED}
        assert [goal.id.hex for goal in steps.goals] == [first, second]
        assert all(goal.done and goal.status is S.SUCCEEDED for goal in steps.goals)
        statistics = server.statistics()
        assert (statistics.accepted, statistics.succeeded, statistics.results) == (2, 2, 2)
        assert (statistics.running, statistics.waiting, statistics.asking) == (0, 0, 0)
        await server.aclose()
        assert session.statistics().action_servers == ()

    async def test_executing_canceling_canceled(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        session.serve_action(Fibonacci, name, steps)
        await stock.watch(name)
        goal = await stock.send(name, 3)
        assert goal is not None
        # The topic keeps the last message only, for a subscription that is matched late.
        await stock.statuses(name, goal, S.EXECUTING)
        assert await stock.cancel_handle(goal) == (NONE, [goal])
        assert await stock.ended(goal) == Ended(S.CANCELED, [])
        seen = await stock.statuses(name, goal, S.CANCELED)
        assert seen == [S.EXECUTING, S.CANCELING, S.CANCELED]
        assert steps.ended == ["cancelled"]
        assert await stock.cancel_handle(goal) == (GOAL_TERMINATED, [])

    async def test_accepted_canceling_canceled(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        session.serve_action(Fibonacci, name, steps)
        running, waiting = await stock.send(name), await stock.send(name)
        assert waiting is not None
        assert await stock.cancel_handle(waiting) == (NONE, [waiting])
        assert await stock.ended(waiting) == Ended(S.CANCELED, [])
        assert [goal.id.hex for goal in steps.goals] == [running]

    async def test_canceling_with_a_result(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        stopping = asyncio.Event()

        async def handler(goal: AnyGoal) -> Any:
            assert not goal.cancelling
            try:
                await asyncio.sleep(LIMIT)
            except asyncio.CancelledError:
                assert goal.cancelling
                goal.feedback({"sequence": [7]})
                await stopping.wait()
                return {"sequence": [5]}

        session.serve_action(Fibonacci, name, handler)
        goal = await stock.send(name)
        assert goal is not None
        assert await stock.cancel_handle(goal) == (NONE, [goal])
        assert await stock.feedback(goal, 1) == [[7]]
        # As rcl: a goal that is being cancelled cannot be cancelled.
        assert await stock.cancel_handle(goal) == (GOAL_TERMINATED, [])
        stopping.set()
        assert await stock.ended(goal) == Ended(S.CANCELED, [5])

    @pytest.mark.parametrize("cancelled", [False, True])
    async def test_aborted(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        cancelled: bool,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        async def handler(goal: AnyGoal) -> Any:
            try:
                await asyncio.sleep(LIMIT if cancelled else 0)
            finally:
                raise GoalAborted("blocked", result={"sequence": [9]})

        session.serve_action(Fibonacci, name, handler)
        await stock.watch(name)
        goal = await stock.send(name)
        assert goal is not None
        if cancelled:
            await stock.cancel_handle(goal)
        assert await stock.ended(goal) == Ended(S.ABORTED, [9])
        assert (await stock.statuses(name, goal, S.ABORTED))[-1] == S.ABORTED
        # On a busy machine there is also a warning about a loop that was blocked.
        (message,) = [r.getMessage() for r in caplog.records if "aborted" in r.getMessage()]
        assert "blocked" in message


class TestCancelling:
    async def test_by_id_by_time_and_all(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        session.serve_action(Fibonacci, name, steps, concurrency=4)
        ids = [uuid.uuid4().hex for _ in range(5)]
        stamps = []
        for goal in ids:
            accepted, stamp = await stock.request(name, goal)
            assert accepted
            stamps.append(stamp)
        assert sorted(stamps) == stamps
        assert [goal.accepted_at for goal in steps.goals] == stamps[:4]
        assert await stock.cancel(name, OTHER) == (UNKNOWN_GOAL_ID, [])
        assert await stock.cancel(name, ids[2]) == (NONE, [ids[2]])
        assert await stock.cancel(name, stamp=stamps[0]) == (NONE, [ids[0]])
        assert await stock.cancel(name, ids[4], stamps[1]) == (NONE, [ids[1], ids[4]])
        assert await stock.cancel(name) == (NONE, [ids[3]])
        assert await stock.cancel(name) == (NONE, [])
        for goal in ids:
            assert await stock.result(name, goal) == Ended(S.CANCELED, [])

    async def test_a_hook_decides(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        steps = Steps()

        async def on_cancel(goal: AnyGoal) -> bool:
            await asyncio.sleep(0)
            if goal.request.order == 9:
                raise OSError("no brakes")
            return bool(goal.request.order > 1)

        session.serve_action(Fibonacci, name, steps, concurrency=3, on_cancel=on_cancel)
        ids = [await stock.send(name, order) for order in (1, 2, 9)]
        assert ids[0] is not None
        assert await stock.cancel(name, ids[0]) == (REJECTED, [])
        assert await stock.cancel(name) == (NONE, [ids[1]])
        assert steps.goals[0].status is S.EXECUTING
        assert "no brakes" in caplog.text

    async def test_a_goal_ends_while_the_hook_decides(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()

        async def on_cancel(goal: AnyGoal) -> bool:
            steps.step()
            await until(lambda: goal.done)
            return True

        session.serve_action(Fibonacci, name, steps, on_cancel=on_cancel)
        goal = await stock.send(name, 1)
        assert goal is not None
        assert await stock.cancel(name, goal) == (GOAL_TERMINATED, [])
        assert await stock.ended(goal) == Ended(S.SUCCEEDED, [0])


class TestResults:
    async def test_several_ask_before_and_after_the_end(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        goal = await stock.send(name, 4)
        assert goal is not None
        async with ActionClientProcess() as other, asyncio.timeout(LIMIT):
            asked = asyncio.create_task(other.result(name, goal))
            await until(lambda: server.statistics().asking == 2)
            steps.step()
            expected = Ended(S.SUCCEEDED, [0, 1, 2, 3])
            assert await asked == expected
            assert await stock.ended(goal) == expected
            assert await stock.result(name, goal) == expected
            assert await other.result(name, goal) == expected

    async def test_of_unknown_and_expired_goals(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        server = session.serve_action(Fibonacci, name, at_once, result_timeout=4 * TICK)
        assert await stock.result(name, OTHER) == Ended(S.UNKNOWN, [])
        goal = uuid.uuid4().hex
        assert (await stock.request(name, goal, 2))[0]
        await until(lambda: server.statistics().results == 0)
        assert await stock.result(name, goal) == Ended(S.UNKNOWN, [])
        assert await stock.cancel(name, goal) == (UNKNOWN_GOAL_ID, [])
        # Its id may be used again.
        assert (await stock.request(name, goal, 2))[0]
        await until(lambda: server.statistics().succeeded == 2)

    async def test_a_result_that_its_handler_uses_again(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        message = Fibonacci.Result()

        async def handler(goal: AnyGoal) -> Any:
            message.sequence = [goal.request.order]
            return message

        session.serve_action(Fibonacci, name, handler)
        goals = [await stock.send(name, order) for order in (1, 2)]
        for order, goal in enumerate(goals, 1):
            assert goal is not None
            assert await stock.ended(goal) == Ended(S.SUCCEEDED, [order])
            assert await stock.result(name, goal) == Ended(S.SUCCEEDED, [order])


class TestFeedback:
    async def test_messages_and_mappings_from_the_loop_and_threads(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        go_on, received = asyncio.Event(), asyncio.Event()
        goals: list[AnyGoal] = []

        async def handler(goal: AnyGoal) -> Any:
            goals.append(goal)
            await go_on.wait()
            message = Fibonacci.Feedback(sequence=[0])
            goal.feedback(message)
            message.sequence = [1]
            await asyncio.to_thread(goal.feedback, message)
            goal.feedback({"sequence": [2]})
            with pytest.raises(ValueError, match="sequenze"):
                goal.feedback({"sequenze": [2]})
            for wrong in (Fibonacci.Result(), None):
                with pytest.raises(TypeError):
                    goal.feedback(wrong)
            # A stock client drops the feedback that it has not taken before the result.
            await received.wait()
            return fibonacci(0)

        server = session.serve_action(Fibonacci, name, handler)
        goal = await stock.send(name)
        assert goal is not None
        go_on.set()
        assert await stock.feedback(goal, 3) == [[0], [1], [2]]
        received.set()
        await stock.ended(goal)
        assert server.statistics().feedback == 3
        with pytest.raises(UsageError, match="has ended"):
            goals[0].feedback({"sequence": [3]})
        await server.aclose()

    async def test_none_is_too_early(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        received = asyncio.Event()

        async def handler(goal: AnyGoal) -> Any:
            for number in range(3):
                goal.feedback({"sequence": [number]})
            await received.wait()
            return fibonacci(0)

        session.serve_action(Fibonacci, name, handler)
        goal = await stock.send(name)
        assert goal is not None
        assert await stock.feedback(goal, 3) == [[0], [1], [2]]
        received.set()
        await stock.ended(goal)


class TestAcceptance:
    async def test_a_hook_decides(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        def plain(request: Any) -> bool:
            if request.order == 9:
                raise OSError("no map")
            return bool(request.order < 5)

        async def asynchronous(request: Any) -> bool:
            await asyncio.sleep(0)
            return plain(request)

        hooks: tuple[Any, ...] = (plain, asynchronous)
        for number, hook in enumerate(hooks):
            server = session.serve_action(Fibonacci, f"{name}_{number}", at_once, on_goal=hook)
            answers = [await stock.send(f"{name}_{number}", order) for order in (1, 6, 9)]
            assert [answer is not None for answer in answers] == [True, False, False]
            assert server.statistics().rejected == 2
        assert caplog.text.count("OSError: no map") == 2

    async def test_what_is_not_a_bool_rejects(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        def undecided(request: Any) -> Any:
            return None

        session.serve_action(Fibonacci, name, at_once, on_goal=undecided)
        assert await stock.send(name) is None
        assert "must return True or False, not NoneType" in caplog.text

    async def test_an_id_is_accepted_once(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        deciding = asyncio.Event()
        decided = asyncio.Event()

        async def on_goal(request: Any) -> bool:
            deciding.set()
            await decided.wait()
            return True

        steps = Steps()
        session.serve_action(Fibonacci, name, steps, on_goal=on_goal)
        goal = uuid.uuid4().hex
        async with ActionClientProcess() as other:
            first = asyncio.create_task(other.request(name, goal))
            await deciding.wait()
            assert await stock.request(name, goal) == (False, 0)
            # It is not known before its acceptance.
            assert await stock.result(name, goal) == Ended(S.UNKNOWN, [])
            assert await stock.cancel(name, goal) == (UNKNOWN_GOAL_ID, [])
            decided.set()
            assert (await first)[0]
        assert await stock.request(name, goal) == (False, 0)
        steps.step()
        assert await stock.result(name, goal) == Ended(S.SUCCEEDED, [])
        assert await stock.request(name, goal) == (False, 0)


class TestBusy:
    async def test_goals_wait_in_order_up_to_the_backlog(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps, concurrency=2, backlog=2)
        goals = [await stock.send(name, order) for order in range(5)]
        assert goals[4] is None
        assert repr(server) == (
            f"<ActionServer {name} [test_msgs/action/Fibonacci] 2 running, 2 waiting>"
        )
        for _ in range(4):
            steps.step()
        for order, goal in enumerate(goals[:4]):
            assert goal is not None
            assert await stock.ended(goal) == Ended(S.SUCCEEDED, list(range(order)))
        assert [goal.request.order for goal in steps.goals] == [0, 1, 2, 3]

    async def test_further_goals_are_rejected(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        session.serve_action(Fibonacci, name, steps, on_busy="reject")
        first = await stock.send(name)
        assert first is not None
        assert await stock.send(name) is None
        steps.step()
        await stock.ended(first)
        assert await stock.send(name) is not None

    async def test_the_oldest_is_replaced(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        stopped = asyncio.Semaphore(0)
        orders: list[int] = []

        async def handler(goal: AnyGoal) -> Any:
            orders.append(goal.request.order)
            try:
                await asyncio.sleep(LIMIT if goal.request.order < 3 else 0)
            finally:
                if goal.cancelling:
                    await stopped.acquire()
            return fibonacci(1)

        server = session.serve_action(Fibonacci, name, handler, on_busy="replace")
        first, second, third = [await stock.send(name, order) for order in (1, 2, 3)]
        assert first is not None
        assert second is not None
        assert third is not None
        # It never ran: the third one came while the first one was ending.
        assert await stock.ended(second) == Ended(S.CANCELED, [])
        assert (server.statistics().running, server.statistics().waiting) == (1, 1)
        stopped.release()
        assert await stock.ended(first) == Ended(S.CANCELED, [])
        assert await stock.ended(third) == Ended(S.SUCCEEDED, [0])
        assert orders == [1, 3]


class TestFailures:
    async def test_a_handler_that_raises_aborts_its_goal_alone(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        async def handler(goal: AnyGoal) -> Any:
            match goal.request.order:
                case 1:
                    raise OSError("no power")
                case 2:
                    return None
                case 3:
                    return {"sequenze": []}
                case 4:
                    return Fibonacci.Feedback()
                case 5:
                    # Of another action.
                    raise GoalAborted("nested", result=NestedMessage.Result())
                case 6:
                    raise asyncio.CancelledError
            return fibonacci(goal.request.order)

        server = session.serve_action(Fibonacci, name, handler)
        for order in range(1, 7):
            goal = await stock.send(name, order)
            assert goal is not None
            assert await stock.ended(goal) == Ended(S.ABORTED, [])
        for text in ("no power", "returned None", "sequenze", "Fibonacci_Feedback", "nested"):
            assert text in caplog.text
        assert "was cancelled by other code" in caplog.text
        goal = await stock.send(name, 7)
        assert goal is not None
        assert (await stock.ended(goal)).status == S.SUCCEEDED
        assert (server.statistics().aborted, server.statistics().succeeded) == (6, 1)

    async def test_on_error_gives_the_result(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        async def handler(goal: AnyGoal) -> Any:
            raise OSError(goal.request.order)

        async def asynchronous(goal: AnyGoal, error: Exception) -> Any:
            await asyncio.sleep(0)
            return plain(goal, error)

        def plain(goal: AnyGoal, error: Exception) -> Any:
            if goal.request.order == 2:
                raise LookupError("of the hook")
            return {"sequence": [int(str(error))]}

        for number, hook in enumerate((plain, asynchronous)):
            session.serve_action(Fibonacci, f"{name}_{number}", handler, on_error=hook)
            for order, expected in ((1, [1]), (2, [])):
                goal = await stock.send(f"{name}_{number}", order)
                assert goal is not None
                assert await stock.ended(goal) == Ended(S.ABORTED, expected)
        assert caplog.text.count("LookupError: of the hook") == 2

    async def test_a_vanished_client_leaves_its_goal_running(
        self, session: Session, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        async with ActionClientProcess() as client:
            assert await client.send(name, 2) is not None
        async with ActionClientProcess() as client:
            assert steps.goals[0].status is S.EXECUTING
            steps.step()
            await until(lambda: server.statistics().succeeded == 1)
            assert await client.result(name, steps.goals[0].id.hex) == Ended(S.SUCCEEDED, [0, 1])

    async def test_a_handler_that_blocks_the_loop_is_reported_once(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        async def blocks(goal: AnyGoal) -> Any:
            await asyncio.sleep(0)
            time.sleep(3 * TICK)  # noqa: ASYNC251
            return fibonacci(0)

        session.serve_action(Fibonacci, name, blocks)
        for _ in range(2):
            goal = await stock.send(name)
            assert goal is not None
            await stock.ended(goal)
        assert caplog.text.count(".blocks has blocked the event loop") == 1


class TestEnding:
    async def test_every_client_that_waits_gets_its_end(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        running, waiting = await stock.send(name), await stock.send(name)
        assert running is not None
        assert waiting is not None
        await until(lambda: server.statistics().asking == 2)
        await server.aclose()
        assert server.closed
        await server.aclose()
        assert await stock.ended(running) == Ended(S.CANCELED, [])
        assert await stock.ended(waiting) == Ended(S.CANCELED, [])
        assert steps.ended == ["cancelled"]
        assert repr(server).endswith("closed>")
        assert session.statistics().servers == ()

    async def test_a_client_that_has_not_asked_yet_gets_its_end(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(server_goals, "ASKING_TIME", LIMIT)
        server = session.serve_action(Fibonacci, name, Steps())
        assert (await stock.request(name, OTHER))[0]
        async with asyncio.TaskGroup() as group:
            group.create_task(server.aclose())
            await until(lambda: server.statistics().canceled)
            assert await stock.result(name, OTHER) == Ended(S.CANCELED, [])

    async def test_a_client_that_never_asks_is_not_waited_for(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        server = session.serve_action(Fibonacci, name, Steps())
        assert (await stock.request(name, OTHER))[0]
        monkeypatch.setattr(server_goals, "ASKING_TIME", TICK)
        async with asyncio.timeout(LIMIT):
            await server.aclose()
        assert server.closed

    async def test_a_client_whose_acceptance_waits_to_be_sent_gets_its_end(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """As if the middleware had not discovered it when its goal was accepted, long ago."""
        monkeypatch.setattr(server_goals, "ASKING_TIME", 0.0)
        monkeypatch.setattr("rosasync._actions.server.CLOSE_TIMEOUT", LIMIT)
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        # In truth it is discovered, which may take seconds.
        steps.step()
        first = await stock.send(name)
        assert first is not None
        await stock.ended(first)
        (send_goal,) = (
            each for each in session.core.servers if each.srv_name.endswith("send_goal")
        )
        clients = UnmatchedClients(send_goal)
        sending = asyncio.create_task(stock.send(name))
        await until(lambda: clients.attempts)
        closing = asyncio.create_task(server.aclose())
        await until(lambda: server.statistics().canceled)
        monkeypatch.setattr(server_goals, "ASKING_TIME", LIMIT)
        clients.unmatched = False
        goal = await sending
        assert goal is not None
        assert await stock.ended(goal) == Ended(S.CANCELED, [])
        await closing

    async def test_the_session_ends_it(
        self, bridge: Any, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        async with Session("ends", bridge=bridge) as session:
            server = session.serve_action(Fibonacci, name, steps)
            goal = await stock.send(name)
            assert goal is not None
            await until(lambda: server.statistics().asking)
        assert await stock.ended(goal) == Ended(S.CANCELED, [])
        assert server.closed
        assert all(goal.done for goal in steps.goals)
        with pytest.raises(SessionClosed):
            session.serve_action(Fibonacci, name, steps)

    async def test_a_handler_that_outlasts_the_deadline(
        self,
        session: Session,
        stock: ActionClientProcess,
        name: str,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        released = asyncio.Event()
        ended = asyncio.Event()

        async def stubborn(goal: AnyGoal) -> Any:
            while not released.is_set():
                try:
                    await released.wait()
                except asyncio.CancelledError:
                    continue
            with pytest.raises(UsageError):
                goal.feedback({})
            ended.set()
            return fibonacci(1)

        server = session.serve_action(Fibonacci, name, stubborn)
        goal = await stock.send(name)
        assert goal is not None
        await until(lambda: server.statistics().asking)
        await server.aclose(timeout=2 * TICK)
        assert await stock.ended(goal) == Ended(S.ABORTED, [])
        assert "1 handlers still run" in caplog.text
        released.set()
        await ended.wait()

    async def test_a_handler_may_close_its_server(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        closed = asyncio.Event()

        async def handler(goal: AnyGoal) -> Any:
            await until(lambda: server.statistics().asking)
            await server.aclose()
            closed.set()
            return fibonacci(1)

        server = session.serve_action(Fibonacci, name, handler)
        goal = await stock.send(name)
        assert goal is not None
        assert await stock.ended(goal) == Ended(S.ABORTED, [])
        await closed.wait()

    async def test_goals_that_come_while_it_ends_are_rejected(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        ending = asyncio.Event()
        released = asyncio.Event()

        async def handler(goal: AnyGoal) -> Any:
            try:
                await asyncio.sleep(LIMIT)
            finally:
                ending.set()
                await released.wait()

        server = session.serve_action(Fibonacci, name, handler, concurrency=2)
        goal = await stock.send(name)
        assert goal is not None
        closing = asyncio.create_task(server.aclose(timeout=None))
        await ending.wait()
        assert await stock.send(name) is None
        assert await stock.cancel(name, goal) == (GOAL_TERMINATED, [])
        await until(lambda: server.statistics().asking)
        released.set()
        await closing
        assert await stock.ended(goal) == Ended(S.CANCELED, [])

    async def test_a_service_that_others_destroy_ends_it(
        self, session: Session, stock: ActionClientProcess, name: str
    ) -> None:
        steps = Steps()
        server = session.serve_action(Fibonacci, name, steps)
        assert await stock.send(name) is not None
        for service in tuple(session.node.services):
            if service.srv_name.endswith(f"{name}/_action/get_result"):
                session.node.destroy_service(service)
        await until(lambda: server.closed)
        await until(lambda: steps.ended == ["cancelled"])
        assert session.statistics().servers == ()

    async def test_from_another_loop(self, session: Session, name: str) -> None:
        server = session.serve_action(Fibonacci, name, at_once)

        def close() -> None:
            with pytest.raises(UsageError, match="in the loop that serves it"):
                asyncio.run(server.aclose())

        await asyncio.to_thread(close)


async def test_bad_arguments(session: Session) -> None:
    serve: Any = session.serve_action

    def plain(goal: AnyGoal) -> Any: ...
    async def two(goal: AnyGoal, more: Any) -> Any: ...

    for handler, text in (
        (plain, "must be async"),
        (two, "takes one argument"),
        (3, "coroutine function"),
        (Steps, "coroutine function"),
    ):
        with pytest.raises(TypeError, match=text):
            serve(Fibonacci, "/bad", handler)
    for hook in ("on_goal", "on_cancel", "on_error"):
        with pytest.raises(TypeError, match=hook):
            serve(Fibonacci, "/bad", at_once, **{hook: 3})
    for option, value in (
        ("concurrency", 0),
        ("backlog", -1),
        ("on_busy", "wait"),
        ("result_timeout", -1),
    ):
        with pytest.raises(ValueError, match=option):
            serve(Fibonacci, "/bad", at_once, **{option: value})
    with pytest.raises(InvalidServiceName):
        serve(Fibonacci, "/b a d", at_once)
    with pytest.raises(ValueError, match="no/action/Such"):
        serve("no/action/Such", "/bad", at_once)
    assert session.statistics().servers == ()
    assert session.statistics().action_servers == ()


async def test_a_type_by_its_name(session: Session, name: str) -> None:
    async def handler(goal: AnyGoal) -> Any:
        return {"nested_field": goal.request.nested_field}

    async with session.serve_action("test_msgs/action/NestedMessage", name, handler) as server:
        assert server.action_type == "test_msgs/action/NestedMessage"
        assert server.action_name == name
        async with Session("client", timeout=LIMIT) as client:
            goal = {"nested_field": {"int32_value": 7}}
            result = await client.act(NestedMessage, name, goal)
            assert result.nested_field.int32_value == 7
    assert server.closed
