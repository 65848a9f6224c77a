"""The py_trees behaviours: outcomes, blackboard, halts, and trees with real servers."""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import py_trees
import pytest
from py_trees.common import Access, Status
from py_trees.decorators import Retry, Timeout
from py_trees.trees import BehaviourTree
from std_srvs.srv import SetBool

from rosasync import (
    AsyncServiceProxy,
    InvalidServiceName,
    ResponseTimeout,
    ServerGone,
    ServiceUnavailable,
    Session,
    SessionClosed,
    UsageError,
)
from rosasync import Retry as Repeat
from rosasync.behaviours import CallService, FromBlackboard, FromConstant, WaitForService
from tests.support.checks import assert_clean
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph, FakeServer
from tests.support.times import LIMIT, TICK, until

if TYPE_CHECKING:
    from tests.support.servers import ServerProcess

NAME = "/echo"

Behaviour = Any


@pytest.fixture(autouse=True)
def blank_blackboard() -> Iterator[None]:
    yield
    py_trees.blackboard.Blackboard.clear()
    py_trees.blackboard.Blackboard.clients.clear()
    py_trees.blackboard.Blackboard.metadata.clear()


@pytest.fixture
async def graph() -> FakeGraph:
    """A graph in memory with a server that echoes."""
    graph = FakeGraph()
    graph.serve(ECHO, NAME, lambda request: f"to {request.load_namespace}")
    return graph


@pytest.fixture
async def fake_session(graph: FakeGraph) -> AsyncIterator[Session]:
    async with graph.session() as session:
        yield session


def received(graph: FakeGraph) -> list[str]:
    """What the graph's only server has received."""
    (server,) = graph.servers
    assert isinstance(server, FakeServer)
    return [request.load_namespace for request in server.received]


def blackboard(*names: str) -> Any:
    client = py_trees.blackboard.Client(name="test")
    for name in names:
        client.register_key(name, Access.WRITE)
    return client


def ready(behaviour: Behaviour, session: Session) -> Behaviour:
    py_trees.trees.setup(behaviour, session=session)
    return behaviour


async def ticked(behaviour: Behaviour) -> Status:
    """Tick until the run ends, with turns of the loop between the ticks."""

    def ended() -> bool:
        behaviour.tick_once()
        return behaviour.status is not Status.RUNNING

    await until(ended)
    return behaviour.status


class TestOutcomes:
    """The status of a run, and its response, error and feedback."""

    async def test_an_answer_is_success(self, fake_session: Session) -> None:
        answers: list[Any] = []
        leaf = CallService("leaf", ECHO, NAME, request_of("a"), on_response=answers.append)
        ready(leaf, fake_session)
        leaf.tick_once()
        assert leaf.status is Status.RUNNING
        assert leaf.feedback_message == "calling /echo"
        assert await ticked(leaf) is Status.SUCCESS
        assert answers == ["to a"]
        assert leaf.feedback_message == "/echo answered"

    @pytest.mark.parametrize("status", [Status.SUCCESS, Status.FAILURE, None])
    async def test_the_callback_may_judge_the_answer(
        self, fake_session: Session, status: Status | None
    ) -> None:
        leaf = ready(CallService("leaf", ECHO, NAME, on_response=lambda _: status), fake_session)
        assert await ticked(leaf) is (status or Status.SUCCESS)

    @pytest.mark.parametrize(
        ("response", "status", "message"),
        [
            (SetBool.Response(success=True), Status.SUCCESS, "/echo answered"),
            (SetBool.Response(success=False), Status.FAILURE, "/echo answered without success"),
            (
                SetBool.Response(message="locked"),
                Status.FAILURE,
                "/echo answered without success: locked",
            ),
            (SimpleNamespace(success=0), Status.SUCCESS, "/echo answered"),
        ],
    )
    async def test_a_response_with_the_field_success_is_judged_by_it(
        self, response: Any, status: Status, message: str
    ) -> None:
        graph = FakeGraph()
        graph.serve(ECHO, NAME, lambda _: response)
        async with graph.session() as session:
            leaf = ready(CallService("leaf", ECHO, NAME, key_response="answer"), session)
            assert await ticked(leaf) is status
            assert leaf.feedback_message == message
            assert blackboard("answer").answer == response

    @pytest.mark.parametrize("status", [Status.SUCCESS, Status.FAILURE, None])
    @pytest.mark.parametrize("success", [True, False])
    async def test_unless_the_callback_says_otherwise(
        self, success: bool, status: Status | None
    ) -> None:
        graph = FakeGraph()
        graph.serve(ECHO, NAME, lambda _: SetBool.Response(success=success))
        async with graph.session() as session:
            leaf = CallService("leaf", ECHO, NAME, on_response=lambda _: status)
            judged = Status.SUCCESS if success else Status.FAILURE
            assert await ticked(ready(leaf, session)) is (status or judged)

    async def test_left_out_the_sessions_timeout_holds_and_none_is_no_deadline(
        self, graph: FakeGraph
    ) -> None:
        async with graph.session(timeout=TICK) as session:
            call, endless = CallService("a", ECHO, NAME), CallService("b", ECHO, NAME, timeout=None)
            with graph.drop_requests():
                ready(endless, session).tick_once()
                assert await ticked(ready(call, session)) is Status.FAILURE
                endless.tick_once()
                assert endless.status is Status.RUNNING

    async def test_a_deadline_is_failure(self, graph: FakeGraph, fake_session: Session) -> None:
        errors: list[Exception] = []
        leaf = CallService("leaf", ECHO, NAME, timeout=TICK, on_error=errors.append)
        ready(leaf, fake_session)
        with graph.drop_requests():
            assert await ticked(leaf) is Status.FAILURE
        assert [type(error) for error in errors] == [ResponseTimeout]
        assert leaf.feedback_message == str(errors[0])

    async def test_the_callback_may_judge_the_error(self, fake_session: Session) -> None:
        leaf = CallService("leaf", ECHO, "/absent", wait=False, on_error=lambda _: Status.SUCCESS)
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS

    async def test_where_no_server_is_it_waits_or_fails_at_once(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        errors: list[Exception] = []
        impatient = CallService("a", ECHO, "/new", wait=False, on_error=errors.append)
        patient = CallService("b", ECHO, "/new")
        for leaf in (impatient, patient):
            ready(leaf, fake_session).tick_once()
        assert impatient.status is Status.FAILURE
        assert [type(error) for error in errors] == [ServiceUnavailable]
        patient.tick_once()
        assert patient.status is Status.RUNNING
        graph.serve(ECHO, "/new", lambda _: "there")
        assert await ticked(patient) is Status.SUCCESS

    async def test_a_server_that_vanishes_is_failure(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        errors: list[Exception] = []
        leaf = ready(CallService("a", ECHO, NAME, on_error=errors.append), fake_session)
        with graph.drop_requests():
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().in_flight)
            graph.servers[0].close()
            assert await ticked(leaf) is Status.FAILURE
        assert [type(error) for error in errors] == [ServerGone]

    async def test_the_session_closing_is_failure_and_no_exception(self, graph: FakeGraph) -> None:
        errors: list[Exception] = []
        async with graph.session() as session:
            leaf = ready(CallService("a", ECHO, NAME, on_error=errors.append), session)
            with graph.drop_requests():
                leaf.tick_once()
        assert await ticked(leaf) is Status.FAILURE
        leaf.tick_once()
        assert await ticked(leaf) is Status.FAILURE
        assert {type(error) for error in errors} == {SessionClosed}

    async def test_someone_else_stopping_the_proxy_is_failure(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        leaf = ready(CallService("a", ECHO, NAME), fake_session)
        with graph.drop_requests():
            leaf.tick_once()
            leaf.proxy.stop_call()
            assert await ticked(leaf) is Status.FAILURE
        assert leaf.feedback_message == "/echo: aborted"

    async def test_a_retry_sends_again(self, graph: FakeGraph, fake_session: Session) -> None:
        leaf = CallService("leaf", ECHO, NAME, retry=Repeat(after=TICK))
        ready(leaf, fake_session)
        with graph.drop_requests():
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().in_flight)
        assert await ticked(leaf) is Status.SUCCESS
        with pytest.raises(TypeError, match="retry"):
            CallService("leaf", ECHO, NAME, retry=3)  # type: ignore[arg-type]

    async def test_feedback_goes_to_the_callback(self, fake_session: Session) -> None:
        messages: list[str] = []
        leaf = ready(CallService("a", ECHO, NAME, on_feedback=messages.append), fake_session)
        await ticked(leaf)
        assert messages == ["calling /echo", "/echo answered"]

    async def test_each_run_calls_once(self, graph: FakeGraph, fake_session: Session) -> None:
        numbers = iter(range(3))
        leaf = CallService("a", ECHO, NAME, lambda: request_of(str(next(numbers))))
        ready(leaf, fake_session)
        for _ in range(3):
            assert await ticked(leaf) is Status.SUCCESS
        assert received(graph) == ["0", "1", "2"]


class TestWaitForService:
    """Waiting for a server."""

    async def test_it_runs_until_a_server_is_there(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        leaf = ready(WaitForService("wait", ECHO, "/new"), fake_session)
        leaf.tick_once()
        assert leaf.status is Status.RUNNING
        assert leaf.feedback_message == "waiting for /new"
        graph.serve(ECHO, "/new", lambda _: None)
        assert await ticked(leaf) is Status.SUCCESS
        assert leaf.feedback_message == "/new is there"

    async def test_it_fails_at_the_deadline(self, fake_session: Session) -> None:
        leaf = ready(WaitForService("wait", ECHO, "/new", timeout=TICK), fake_session)
        assert await ticked(leaf) is Status.FAILURE
        assert "no server" in leaf.feedback_message

    async def test_halted_it_waits_no_more(self, fake_session: Session) -> None:
        leaf = ready(WaitForService("wait", ECHO, "/new"), fake_session)
        leaf.tick_once()
        leaf.stop(Status.INVALID)
        leaf.status = Status.RUNNING
        leaf.tick_once()
        assert leaf.status is Status.FAILURE
        assert leaf.feedback_message == "aborted"

    async def test_each_run_looks_anew(self, graph: FakeGraph, fake_session: Session) -> None:
        leaf = ready(WaitForService("wait", ECHO, NAME, timeout=20 * TICK), fake_session)
        assert await ticked(leaf) is Status.SUCCESS
        graph.servers[0].close()
        assert await ticked(leaf) is Status.FAILURE


class TestBlackboard:
    """Requests from the blackboard; responses, errors and feedback to it."""

    async def test_request_and_response(self, fake_session: Session) -> None:
        board = blackboard("request", "response")
        board.request = request_of("a")
        leaf = FromBlackboard("leaf", ECHO, NAME, "request", "response")
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS
        assert board.response == "to a"

    async def test_a_constant_request(self, fake_session: Session) -> None:
        board = blackboard("/robot/response")
        leaf = FromConstant(
            "leaf", ECHO, NAME, {"load_namespace": "a"}, key_response="/robot/response"
        )
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS
        assert board.get("/robot/response") == "to a"

    async def test_variables_may_be_nested(self, fake_session: Session) -> None:
        class Goal:
            request = request_of("nested")
            response = "an older one"

        board = blackboard("goal")
        leaf = FromBlackboard("leaf", ECHO, NAME, "goal.request", "goal.response")
        ready(leaf, fake_session)
        assert await ticked(leaf) is Status.FAILURE
        board.goal = Goal()
        leaf.tick_once()
        assert board.goal.response is None
        assert await ticked(leaf) is Status.SUCCESS
        assert board.goal.response == "to nested"

    async def test_error_and_feedback(self, fake_session: Session) -> None:
        board = blackboard("error", "feedback")
        leaf = CallService(
            *("leaf", ECHO, "/absent"),
            timeout=TICK,
            key_error="error",
            key_feedback_message="feedback",
        )
        ready(leaf, fake_session).tick_once()
        assert board.feedback == "calling /absent"
        assert await ticked(leaf) is Status.FAILURE
        assert isinstance(board.error, ServiceUnavailable)
        assert board.feedback == str(board.error) == leaf.feedback_message

    async def test_without_a_request_the_run_fails_and_nothing_is_sent(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        leaf = FromBlackboard("leaf", ECHO, NAME, "request", key_error="error")
        ready(leaf, fake_session).tick_once()
        assert leaf.status is Status.FAILURE
        assert "does not yet exist" in leaf.feedback_message
        assert isinstance(blackboard("error").error, KeyError)
        blackboard("request").request = "no request"
        leaf.tick_once()
        assert leaf.status is Status.FAILURE
        assert isinstance(blackboard("error").error, TypeError)
        blackboard("request").request = request_of("a")
        assert await ticked(leaf) is Status.SUCCESS
        assert received(graph) == ["a"]

    async def test_a_new_run_takes_the_older_answer_off_the_blackboard(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        board = blackboard("response", "error")
        leaf = CallService(
            *("leaf", ECHO, NAME, request_of("a")),
            key_response="response",
            key_error="error",
            timeout=20 * TICK,
        )
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS
        with graph.drop_requests():
            leaf.tick_once()
            assert not board.exists("response")
            assert await ticked(leaf) is Status.FAILURE
        assert not board.exists("response")
        assert isinstance(board.error, ResponseTimeout)
        leaf.tick_once()
        assert not board.exists("error")
        assert await ticked(leaf) is Status.SUCCESS


class TestHalting:
    """An interrupted leaf cancels its call, and its next run does not see the response."""

    async def test_it_cancels_the_call(self, graph: FakeGraph, fake_session: Session) -> None:
        leaf = ready(CallService("leaf", ECHO, NAME), fake_session)
        with graph.drop_requests():
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().in_flight)
            leaf.stop(Status.INVALID)
            await until(lambda: fake_session.pool.statistics().cancelled == 1)

    async def test_an_answer_that_was_not_read_is_not_the_next_runs(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        answers: list[Any] = []
        texts = iter(["old", "new"])
        leaf = CallService(
            "leaf", ECHO, NAME, lambda: request_of(next(texts)), on_response=answers.append
        )
        ready(leaf, fake_session).tick_once()
        await until(lambda: fake_session.pool.statistics().completed == 1)
        leaf.stop(Status.INVALID)
        leaf.tick_once()
        assert leaf.status is Status.RUNNING
        assert await ticked(leaf) is Status.SUCCESS
        assert answers == ["to new"]

    async def test_a_late_answer_is_counted_and_not_shown(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        answers: list[Any] = []
        texts = iter(["old", "new"])
        leaf = CallService(
            "leaf", ECHO, NAME, lambda: request_of(next(texts)), on_response=answers.append
        )
        ready(leaf, fake_session)
        with graph.hold_requests():
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().in_flight)
            leaf.stop(Status.INVALID)
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().abandoned)
        assert await ticked(leaf) is Status.SUCCESS
        assert answers == ["to new"]
        assert fake_session.pool.statistics().late == 1

    async def test_halting_what_has_not_run_does_no_harm(self, fake_session: Session) -> None:
        leaf = CallService("leaf", ECHO, NAME)
        leaf.stop(Status.INVALID)
        ready(leaf, fake_session)
        leaf.stop(Status.INVALID)
        assert await ticked(leaf) is Status.SUCCESS


def divide(*_: Any) -> Any:
    return 1 // 0


class TestFunctionsThatRaise:
    """They fail the leaf, with the error on its key; the tree goes on."""

    @pytest.mark.parametrize("function", ["request", "on_response", "on_feedback"])
    async def test_the_leaf_fails_with_the_error_on_its_key(
        self, fake_session: Session, caplog: pytest.LogCaptureFixture, function: str
    ) -> None:
        errors: list[Exception] = []
        options: dict[str, Any] = {function: divide}
        leaf = CallService("leaf", ECHO, NAME, key_error="error", on_error=errors.append, **options)
        assert await ticked(ready(leaf, fake_session)) is Status.FAILURE
        assert isinstance(blackboard("error").error, ZeroDivisionError)
        assert "by zero" in leaf.feedback_message
        if function != "on_feedback":
            assert [type(error) for error in errors] == [ZeroDivisionError]
        assert "in divide" in caplog.text
        await until(lambda: not fake_session.pool.statistics().in_flight)
        assert fake_session.pool.statistics().completed == (function == "on_response")

    async def test_the_error_hook_itself(
        self, fake_session: Session, caplog: pytest.LogCaptureFixture
    ) -> None:
        leaf = CallService(
            *("leaf", ECHO, "/absent"), wait=False, on_error=divide, key_error="error"
        )
        assert await ticked(ready(leaf, fake_session)) is Status.FAILURE
        error = blackboard("error").error
        assert isinstance(error, ZeroDivisionError)
        assert isinstance(error.__context__, ServiceUnavailable)
        assert "in divide" in caplog.text

    async def test_the_error_hook_may_save_a_run(self, fake_session: Session) -> None:
        leaf = CallService("leaf", ECHO, NAME, divide, on_error=lambda _: Status.SUCCESS)
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS

    async def test_a_variable_that_cannot_be_written(self, fake_session: Session) -> None:
        leaf = CallService(*("leaf", ECHO, NAME), key_response="absent.answer", key_error="error")
        assert await ticked(ready(leaf, fake_session)) is Status.FAILURE
        assert isinstance(blackboard("error").error, KeyError)

    async def test_the_next_run_begins_anew(self, fake_session: Session) -> None:
        board = blackboard("error")
        requests = iter([divide, lambda: request_of("a")])
        leaf = CallService("leaf", ECHO, NAME, lambda: next(requests)(), key_error="error")
        assert await ticked(ready(leaf, fake_session)) is Status.FAILURE
        assert await ticked(leaf) is Status.SUCCESS
        assert not board.exists("error")

    async def test_in_a_tree_the_others_are_ticked(self, fake_session: Session) -> None:
        broken = CallService("broken", ECHO, NAME, on_response=divide)
        spare = CallService("spare", ECHO, NAME)
        root = py_trees.composites.Selector("root", memory=True, children=[broken, spare])
        assert await ticked(ready(root, fake_session)) is Status.SUCCESS
        assert spare.status is Status.SUCCESS


class TestSetup:
    """Setup never blocks, and rejects wrong arguments before the first tick."""

    async def test_it_does_not_wait_for_a_server(self, fake_session: Session) -> None:
        for leaf in (CallService("a", ECHO, "/absent"), WaitForService("b", ECHO, "/absent")):
            with ThreadPoolExecutor() as threads:
                # The loop is blocked, so setup cannot wait for it.
                threads.submit(ready, leaf, fake_session).result(LIMIT)
            assert isinstance(leaf.proxy, AsyncServiceProxy)

    async def test_the_session_may_be_given_to_the_constructor(self, fake_session: Session) -> None:
        leaf = CallService("a", ECHO, NAME, session=fake_session)
        leaf.setup_with_descendants()
        assert await ticked(leaf) is Status.SUCCESS

    async def test_without_a_session(self) -> None:
        with pytest.raises(KeyError, match="has no session: call tree.setup"):
            CallService("a", ECHO, NAME).setup()

    async def test_without_setup(self) -> None:
        for leaf in (CallService("a", ECHO, NAME), WaitForService("b", ECHO, NAME)):
            with pytest.raises(UsageError, match="not set up"):
                leaf.tick_once()

    @pytest.mark.parametrize(
        ("error", "arguments"),
        [
            (TypeError, (ECHO, NAME, "no request")),
            (ValueError, (ECHO, NAME, {"no_field": 1})),
            (ValueError, ("no_pkg/srv/Type", NAME)),
            (InvalidServiceName, (ECHO, "no name")),
        ],
    )
    async def test_a_bad_service_or_constant(
        self, fake_session: Session, error: type[Exception], arguments: tuple[Any, ...]
    ) -> None:
        with pytest.raises(error):
            ready(CallService("a", *arguments), fake_session)

    def test_bad_options(self) -> None:
        with pytest.raises(TypeError, match="not both"):
            CallService("a", ECHO, NAME, request_of("a"), key_request="request")
        with pytest.raises(ValueError, match="NaN"):
            CallService("a", ECHO, NAME, timeout=math.nan)
        with pytest.raises(ValueError, match="NaN"):
            WaitForService("a", ECHO, NAME, timeout=math.nan)

    async def test_shutdown_cancels_and_setup_begins_anew(
        self, graph: FakeGraph, fake_session: Session
    ) -> None:
        leaf = ready(CallService("a", ECHO, NAME), fake_session)
        with graph.drop_requests():
            leaf.tick_once()
            await until(lambda: fake_session.pool.statistics().in_flight)
            leaf.shutdown()
            leaf.shutdown()
            await until(lambda: fake_session.pool.statistics().cancelled == 1)
        with pytest.raises(UsageError):
            leaf.tick_once()
        leaf.stop(Status.INVALID)
        assert await ticked(ready(leaf, fake_session)) is Status.SUCCESS

    def test_without_py_trees_the_import_names_the_extra(self) -> None:
        code = (
            "import sys; sys.modules['py_trees'] = None\n"
            "import rosasync\n"
            "try: import rosasync.behaviours\n"
            "except ImportError as error: print(error)"
        )
        run = subprocess.run(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True
        )
        assert "pip install 'rosasync[py-trees]'" in run.stdout


async def run_tree(root: Behaviour, session: Session, where: Literal["loop", "thread"]) -> Status:
    """Tick a tree until its run ends, in the loop or in a thread."""
    tree = BehaviourTree(root)
    tree.setup(session=session)
    if where == "loop":
        async with asyncio.timeout(LIMIT):
            while True:
                tree.tick()
                if root.status is not Status.RUNNING:
                    break
                await asyncio.sleep(TICK / 10)
    else:
        ticking = threading.Thread(
            target=tree.tick_tock,
            kwargs={
                "period_ms": 1000 * TICK / 10,
                "number_of_iterations": LIMIT / TICK * 10,
                "stop_on_terminal_state": True,
            },
        )
        ticking.start()
        await asyncio.to_thread(ticking.join)
    status = root.status
    tree.shutdown()
    return status


@pytest.mark.parametrize("where", ["loop", "thread"])
class TestTrees:
    """Trees with a real server, ticked in the loop and in a thread."""

    @pytest.fixture
    async def robot(self, server: ServerProcess) -> ServerProcess:
        """Services that answer at once, after ``TICK``, and never."""
        await server.serve("/quick")
        await server.serve("/slow", delay=TICK)
        await server.serve("/never", delay="never")
        return server

    def call(self, name: str, answers: list[str] | None = None, **options: Any) -> CallService:
        def keep(response: Any) -> None:
            if answers is not None:
                answers.append(answer_to(response))

        options.setdefault("timeout", LIMIT)
        return CallService(
            f"call {name}", ECHO, name, request_of(name), on_response=keep, **options
        )

    async def test_sequence(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        answers: list[str] = []
        names = ["/quick", "/slow", "/quick"]
        root = py_trees.composites.Sequence(
            "sequence",
            memory=True,
            children=[
                WaitForService("wait", ECHO, "/slow", timeout=LIMIT),
                *(self.call(name, answers) for name in names),
            ],
        )
        assert await run_tree(root, session, where) is Status.SUCCESS
        assert answers == names
        await assert_clean(session)

    async def test_a_selector_halts_what_has_lower_priority(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        answers: list[str] = []
        urgent = py_trees.composites.Sequence(
            "urgent",
            memory=True,
            children=[
                py_trees.behaviours.CheckBlackboardVariableExists("urgent?", "urgent"),
                self.call("/quick", answers),
            ],
        )
        root = py_trees.composites.Selector(
            "selector", memory=False, children=[urgent, self.call("/never", answers)]
        )
        running = asyncio.create_task(run_tree(root, session, where))
        await robot.received("/never", 1)
        blackboard("urgent").urgent = True
        assert await running is Status.SUCCESS
        assert answers == ["/quick"]
        await until(lambda: session.pool.statistics().cancelled == 1)

    async def test_a_selector_with_memory_goes_on_to_the_next(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        answers: list[str] = []
        root = py_trees.composites.Selector(
            "selector",
            memory=True,
            children=[
                self.call("/absent", wait=False),
                self.call("/never", timeout=2 * TICK),
                self.call("/quick", answers),
            ],
        )
        assert await run_tree(root, session, where) is Status.SUCCESS
        assert answers == ["/quick"]

    async def test_a_parallel_halts_the_others(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        answers: list[str] = []
        root = py_trees.composites.Parallel(
            "parallel",
            policy=py_trees.common.ParallelPolicy.SuccessOnOne(),
            children=[self.call("/slow", answers), self.call("/never", answers)],
        )
        await session.wait_for_service(ECHO, "/never")
        assert await run_tree(root, session, where) is Status.SUCCESS
        assert answers == ["/slow"]
        await until(lambda: session.pool.statistics().cancelled == 1)

    @pytest.mark.slow
    async def test_a_parallel_of_all(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        answers: list[str] = []
        root = py_trees.composites.Parallel(
            "parallel",
            policy=py_trees.common.ParallelPolicy.SuccessOnAll(synchronise=True),
            children=[self.call("/slow", answers) for _ in range(30)],
        )
        assert await run_tree(root, session, where) is Status.SUCCESS
        assert answers == 30 * ["/slow"]
        assert session.pool.statistics().created == 1
        await assert_clean(session)

    async def test_retry(
        self, session: Session, server: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        await server.serve("/deaf", skip=2)
        await session.wait_for_service(ECHO, "/deaf")
        answers: list[str] = []
        root = Retry("retry", self.call("/deaf", answers, timeout=10 * TICK), num_failures=5)
        assert await run_tree(root, session, where) is Status.SUCCESS
        assert answers == ["/deaf"]
        # More than two on a busy machine, where an answer may come too late.
        failures = session.pool.statistics().timed_out
        assert failures >= 2
        assert await server.received("/deaf") == (failures + 1) * ["/deaf"]

    async def test_timeout(
        self, session: Session, robot: ServerProcess, where: Literal["loop", "thread"]
    ) -> None:
        await session.wait_for_service(ECHO, "/never")
        root = Timeout("timeout", self.call("/never"), duration=10 * TICK)
        assert await run_tree(root, session, where) is Status.FAILURE
        await until(lambda: session.pool.statistics().cancelled == 1)
