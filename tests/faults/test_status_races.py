"""Servers and callers that tell each other how calls end, in any order, in virtual time.

Servers answer, fail and end only when they are told, and what the processes say may be late or get
lost. So hypothesis decides the order of everything, and can shorten a failure.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from hypothesis.stateful import run_state_machine_as_test as run_machine

from rosasync import HandlerFailed, Limits, ServerGone, ServerOverloaded, Session, SessionClosed
from rosasync._client.client import Client
from rosasync._client.service import ServicePool
from rosasync._server.status import ServerStatus
from rosasync._status.reporter import Reporter
from rosasync._status.wire import REPORT_TYPE, Outcome, Report
from rosasync.testing._memory.graph import MemoryNode
from rosasync.testing._memory.services import MemoryClient, MemoryServer
from rosasync.testing._memory.topics import MemoryPublisher, MemorySubscription
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.overload import VirtualLoop
from tests.support.places import check_places
from tests.support.serving import AnyCall, echo_of

SETTLE = 0.2
"""Virtual seconds after which nothing moves any more, but for deadlines."""
MOST = 12.0
"""Virtual seconds after which nothing can be left."""
TIMEOUT = 3.11
"""Seconds of the calls with a deadline: none passes in the moment in which the model looks."""
LIMITS = Limits(in_flight=3, server_depth=None, idle=5.13, grace=5.07)
MOST_SERVERS = 3
ERRORS = {
    Outcome.FAILED: HandlerFailed,
    Outcome.DROPPED: ServerOverloaded,
    Outcome.CLOSED: ServerGone,
}


class Network(FakeGraph):
    """A graph whose requests and status messages can be kept on the way, and the latter lost.

    Attributes:
        told: for each call, by the text of its request, the servers whose report has arrived.
        took: the same, for the servers that its request was sent to.
    """

    def __init__(self) -> None:
        super().__init__()
        self.status = "prompt"
        self.took: dict[str, set[bytes]] = {}
        self.told: dict[str, set[bytes]] = {}
        self.topics_of: dict[MemoryNode, list[MemoryPublisher | MemorySubscription]] = {}
        # What each status message that was ever sent does when it arrives.
        self.published: list[Callable[[], None]] = []
        self._kept_requests: list[tuple[MemoryServer, MemoryClient, int, Any]] = []
        self._kept_messages: list[Callable[[], None]] = []
        self._texts: dict[tuple[bytes, int], str] = {}

    def watch(self, node: MemoryNode) -> None:
        """Carry the messages of the topics of a node."""
        opened = self.topics_of[node] = []
        open_publisher, open_subscription = node.open_publisher, node.open_subscription

        def watch_publisher(*arguments: Any) -> MemoryPublisher:
            publisher = open_publisher(*arguments)
            publish = publisher.publish

            def carry(message: Any) -> None:
                if node in self.nodes:
                    self._carry_message(publish, message)

            publisher.publish = carry  # type: ignore[method-assign]
            opened.append(publisher)
            return publisher

        def watch_subscription(*arguments: Any) -> MemorySubscription:
            subscription = open_subscription(*arguments)
            opened.append(subscription)
            return subscription

        node.open_publisher = watch_publisher  # type: ignore[assignment]
        node.open_subscription = watch_subscription  # type: ignore[assignment]

    def crash(self, node: MemoryNode) -> None:
        """Take a process out of the graph, with everything that is its own."""
        for topic in self.topics_of[node]:
            topic.close()
        for client in node.clients:
            client.close()
        self.nodes.remove(node)
        for server in tuple(self.servers):
            if server.identity.startswith(node.process):
                server.close()
        self.changed()

    def carry_request(
        self, server: MemoryServer, client: MemoryClient, number: int, request: Any
    ) -> None:
        """Pass a request to a server, or keep it while requests are held."""
        if not any(client.identity.startswith(node.process) for node in self.nodes):
            return  # Its process has crashed, and only its session does not know.
        text = self._texts[client.identity, number] = request.load_namespace
        self.took.setdefault(text, set()).add(server.identity)
        if self.holding:
            self._kept_requests.append((server, client, number, request))
        else:
            super().carry_request(server, client, number, request)

    def _carry_message(self, publish: Callable[[Any], None], message: Any) -> None:
        def arrive() -> None:
            if type(message).__name__ == REPORT_TYPE.rpartition("/")[2]:
                report = Report.read(message)
                text = self._texts[report.client, report.number]
                self.told.setdefault(text, set()).add(report.server)
            publish(message)

        self.published.append(arrive)
        if self.status == "late":
            self._kept_messages.append(arrive)
        elif self.status == "prompt":
            arrive()

    def release_requests(self) -> None:
        """Deliver the requests that were kept to the servers that are left."""
        kept, self._kept_requests = self._kept_requests, []
        for server, *request in kept:
            if server in self.servers:
                server.receive(*request)

    def release_messages(self, *, backwards: bool) -> None:
        """Deliver the status messages that were kept."""
        kept, self._kept_messages = self._kept_messages, []
        for arrive in reversed(kept) if backwards else kept:
            arrive()


class Served:
    """One server of the name, in a process of its own, and what has become of each request.

    Attributes:
        running: tells the handler of a request how to end.
        answered: the requests that it has answered.
        ended: how those ended that it will not answer.
        up: whether it has neither closed nor crashed.
    """

    def __init__(self, machine: StatusRaces, session: Session, cancel_abandoned: bool) -> None:
        self.running: dict[str, asyncio.Future[str]] = {}
        self.answered: set[str] = set()
        self.ended: dict[str, Outcome] = {}
        self.up = True
        self.session = session
        self._machine = machine
        self.server = session.serve(
            ECHO,
            "/told",
            self._handle,
            status=True,
            concurrency=2,
            backlog=2,
            on_overload=self._note_dropped,
            cancel_abandoned=cancel_abandoned,
        )
        self.identity = machine.graph.servers[-1].identity

    def _note_dropped(self, call: AnyCall) -> None:
        self.ended[call.request.load_namespace] = Outcome.DROPPED

    async def _handle(self, call: AnyCall) -> Any:
        text = call.request.load_namespace
        self._machine.on_start(text)
        self._machine.all_calls.add(call)
        told = self.running[text] = asyncio.get_running_loop().create_future()
        try:
            if await told == "fail":
                self.ended[text] = Outcome.FAILED
                raise LookupError(text)
            call.respond(echo_of(call.request))
            self.answered.add(text)
            return None
        finally:
            del self.running[text]


@dataclass
class Caller:
    """One call.

    Attributes:
        task: the call.
        client: the session that made it.
        deadline: the virtual time at which it gives up; None for never.
        cancelled: whether it was cancelled before it had ended.
        left: whether it was cancelled or has timed out, or its process has ended.
        untold: whether a server may not have learnt that it left.
        result: how it ended; None before.
    """

    task: asyncio.Task[Any]
    client: Session
    deadline: float | None
    cancelled: bool = False
    left: bool = False
    untold: bool = False
    result: Any = None


class StatusRaces(RuleBasedStateMachine):
    """Two processes with callers, up to three with servers, and what must hold at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.loop = VirtualLoop()
        self.reported: list[dict[str, Any]] = []
        self.loop.set_exception_handler(lambda _, context: self.reported.append(context))
        self.graph = Network()
        self.all_calls: weakref.WeakSet[AnyCall] = weakref.WeakSet()
        self.servers: list[Served] = []
        self.callers: dict[str, Caller] = {}
        self.wrong: list[str] = []
        self.sessions: list[Session] = []
        self.crashed: set[Session] = set()
        self.clients = [self._open(limits=LIMITS), self._open(limits=LIMITS)]
        self.come(cancel_abandoned=False)

    # Events.

    @rule(which=st.integers(0, 1), timed=st.booleans())
    def call(self, which: int, timed: bool) -> None:
        text = str(len(self.callers))
        client = self.clients[which]
        timeout = TIMEOUT if timed else None
        task = self._do(client.start, ECHO, "/told", request_of(text), timeout=timeout)
        deadline = self.loop.time() + TIMEOUT if timed else None
        self.callers[text] = Caller(task, client, deadline)
        self._settle()

    @precondition(lambda self: self.waiting())
    @rule(which=st.integers(0, 100), together=st.integers(1, 3))
    def leave(self, which: int, together: int) -> None:
        """Let callers leave in one turn of the loop."""
        waiting = self.waiting()
        for number in range(which, which + together):
            self._cancel(self.callers[waiting[number % len(waiting)]])
        self._settle()

    @precondition(lambda self: self.running())
    @rule(
        which=st.integers(0, 100),
        how=st.sampled_from(["answer", "answer", "fail"]),
        leave=st.booleans(),
    )
    def end_handler(self, which: int, how: str, leave: bool) -> None:
        """Let a handler answer or raise, and its caller leave in the same turn perhaps."""
        served, text = self.running()[which % len(self.running())]
        served.running[text].set_result(how)
        if leave:
            self._cancel(self.callers[text])
        self._settle()

    @precondition(lambda self: self.up())
    @rule(which=st.integers(0, 2), replace=st.booleans())
    def close(self, which: int, replace: bool) -> None:
        """Close a server, and serve with another in the same turn perhaps."""
        served = self.up()[which % len(self.up())]
        served.up = False
        self._run(served.server.aclose(0))
        if replace:
            self.come(cancel_abandoned=False)
        self._settle()

    @precondition(lambda self: self.up())
    @rule(which=st.integers(0, 2))
    def crash(self, which: int) -> None:
        """End the process of a server, which says nothing any more."""
        served = self.up()[which % len(self.up())]
        served.up = False
        self._crash(served.session)
        self._settle()

    @precondition(lambda self: len(self.up()) < MOST_SERVERS)
    @rule(cancel_abandoned=st.booleans())
    def come(self, cancel_abandoned: bool) -> None:
        session = self._open()
        self.servers.append(self._do(Served, self, session, cancel_abandoned))
        self._settle()

    @rule(which=st.integers(0, 1), cleanly=st.booleans())
    def recreate(self, which: int, cleanly: bool) -> None:
        """End a process with callers, and start it anew: its requests have the same numbers."""
        gone = self.clients[which]
        for caller in self.callers.values():
            if caller.client is gone and not caller.task.done():
                caller.left = True
                # A request that arrives later is of a client that may be about to be discovered.
                caller.untold = caller.untold or self.graph.holding
        if cleanly:
            self._run(gone.aclose())
        else:
            self._crash(gone)
        self.clients[which] = self._open(limits=LIMITS)
        self._settle()

    @rule(status=st.sampled_from(["prompt", "late", "lost"]), backwards=st.booleans())
    def disturb(self, status: str, backwards: bool) -> None:
        """Deliver status messages from now on, keep them on the way, or lose them."""
        self.graph.status = status
        if status == "prompt":
            self._do(self.graph.release_messages, backwards=backwards)
        self._settle()

    @precondition(lambda self: self.graph.published)
    @rule(which=st.integers(0, 100))
    def repeat_a_message(self, which: int) -> None:
        """Deliver a status message again, or one that was lost."""
        published = self.graph.published
        self._do(published[which % len(published)])
        self._settle()

    @rule()
    def hold_or_release(self) -> None:
        """Keep requests in the middleware while departures go on, or deliver them."""
        self.graph.holding = not self.graph.holding
        if not self.graph.holding:
            self._do(self.graph.release_requests)
        self._settle()

    @rule(seconds=st.sampled_from([1.0, 3.6, 6.0]))
    def pass_time(self, seconds: float) -> None:
        """Let deadlines pass, and clients that are not used be destroyed."""
        self._run(asyncio.sleep(seconds), seconds)
        self._settle()

    # What must hold.

    @invariant()
    def nothing_is_wrong(self) -> None:
        assert not self.wrong, self.wrong
        assert [context.get("exception", context) for context in self.reported] == []

    @invariant()
    def every_call_ends_once_and_rightly(self) -> None:
        for text, caller in self.callers.items():
            if caller.client in self.crashed:
                continue
            if caller.task.done() and caller.result is None:
                caller.result = _result(text, caller.task)
                allowed = self._allowed(text)
                assert caller.result in allowed, f"{text} ended with {caller.result}, not {allowed}"
            elif not caller.task.done():
                assert not self._is_decided(text), f"{text} must have ended"

    @invariant()
    def places_are_neither_lost_nor_doubled(self) -> None:
        for client in self.clients:
            pool = self._pool_of(client)
            check_places(pool, LIMITS)
            if not any(c.untold for c in self.callers.values() if c.client is client):
                # All servers have dropped the requests of the callers that have left.
                assert not any(each.window.abandoned for each in pool.clients)

    def teardown(self) -> None:
        try:
            self._end()
        finally:
            # Also after a failure: what stays open warns in another test, when it is collected.
            for session in self.sessions:
                self.loop.run_until_complete(session.aclose())
            self.loop.close()

    def _end(self) -> None:
        self.graph.holding = False
        self._do(self.graph.release_requests)
        self._settle()
        while running := self.running():
            for served, text in running:
                served.running[text].set_result("answer")
            self._settle()
        self.every_call_ends_once_and_rightly()
        for caller in self.callers.values():
            self._cancel(caller)
        self._run(asyncio.sleep(MOST), MOST)
        for client in self.clients:
            statistics = client.pool.statistics()
            assert (statistics.in_flight, statistics.waiting, statistics.abandoned) == (0, 0, 0)
            for each in self._pool_of(client).clients:
                assert (each.window.taken, each.window.sent) == (0, {})
        for served in self.up():
            served_all = served.server.statistics()
            assert (served_all.running, served_all.waiting, served_all.unanswered) == (0, 0, 0)
        for session in self.sessions:
            self._run(session.aclose())
        self.every_call_ends_once_and_rightly()
        self.nothing_is_wrong()
        assert all(caller.task.done() for caller in self.callers.values())
        assert not asyncio.all_tasks(self.loop)
        gc.collect()
        assert not self.all_calls

    # For the rules.

    def on_start(self, text: str) -> None:
        """Record that a handler starts."""
        caller = self.callers[text]
        if caller.left and not caller.untold:
            self.wrong.append(f"{text} was run although its caller had left")

    def up(self) -> list[Served]:
        return [served for served in self.servers if served.up]

    def waiting(self) -> list[str]:
        return [
            text
            for text, caller in self.callers.items()
            if caller.client in self.clients and not caller.task.done()
        ]

    def running(self) -> list[tuple[Served, str]]:
        return [(served, text) for served in self.up() for text in served.running]

    def _allowed(self, text: str) -> set[Any]:
        """Return how a call may have ended by now."""
        caller = self.callers[text]
        allowed: set[Any] = set()
        if caller.cancelled:
            allowed.add("cancelled")
        # The loop runs timers up to one clock resolution early.
        if caller.deadline is not None and caller.deadline <= self.loop.time() + 1e-6:
            allowed.add("timed out")
        if caller.client.closed:
            allowed.add(SessionClosed)
        servers = self._servers_of(text)
        if any(text in served.answered for served in servers):
            return allowed | {"answered"}
        if any(served.up and text not in served.ended for served in servers):
            return allowed  # It may still answer.
        for served in servers:
            if text in served.ended:
                allowed.add(ERRORS[served.ended[text]])
            if not served.up:
                allowed.add(ServerGone)  # What it has reported may have been lost.
        return allowed

    def _is_decided(self, text: str) -> bool:
        """Return whether the caller of a call must know by now how it has ended."""
        servers = self._servers_of(text)
        told = self.graph.told.get(text, set())
        return bool(servers) and (
            any(text in served.answered for served in servers)
            or all(not served.up or served.identity in told for served in servers)
        )

    def _servers_of(self, text: str) -> list[Served]:
        took = self.graph.took.get(text, set())
        return [served for served in self.servers if served.identity in took]

    def _pool_of(self, client: Session) -> ServicePool:
        return self._do(client.pool.service, ECHO, "/told", None)  # type: ignore[no-any-return]

    def _cancel(self, caller: Caller) -> None:
        self._note_departure(caller)
        caller.cancelled = caller.cancelled or not caller.task.done()
        caller.task.cancel()

    def _note_departure(self, caller: Caller) -> None:
        """Note whether all servers will know that a caller leaves, which it is about to do."""
        if not caller.task.done():
            servers = frozenset(served.identity for served in self.up())
            told = caller.client.core.pool.listener.hears(servers)
            caller.untold = caller.untold or not told or self.graph.status != "prompt"

    def _open(self, **options: Any) -> Session:
        session = self.graph.session(timeout=None, **options)
        self._run(session.__aenter__())
        node = session.core.node
        assert isinstance(node, MemoryNode)
        self.graph.watch(node)
        self.sessions.append(session)
        return session

    def _crash(self, session: Session) -> None:
        node = session.core.node
        assert isinstance(node, MemoryNode)
        self._do(self.graph.crash, node)
        self.crashed.add(session)

    def _settle(self) -> None:
        self._run(asyncio.sleep(SETTLE))
        for text, caller in self.callers.items():
            if caller.task.done() and _result(text, caller.task) in ("cancelled", "timed out"):
                caller.left = True

    def _do(self, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        async def work() -> Any:
            return function(*arguments, **options)

        return self._run(work())

    def _run(self, work: Any, seconds: float = 1.0) -> Any:
        """Run a coroutine that takes no more than so many virtual seconds."""
        for caller in self.callers.values():
            if caller.deadline is not None and caller.deadline <= self.loop.time() + seconds:
                self._note_departure(caller)
        return self.loop.run_until_complete(work)


def _result(text: str, task: asyncio.Task[Any]) -> Any:
    if task.cancelled():
        return "cancelled"
    error = task.exception()
    if isinstance(error, TimeoutError):
        return "timed out"
    if error is not None:
        return type(error)
    assert answer_to(task.result()) == text
    return "answered"


def _settings(examples: int) -> settings:
    return settings(
        max_examples=examples,
        stateful_step_count=40,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )


@pytest.fixture(autouse=True)
def unlogged(caplog: pytest.LogCaptureFixture) -> None:
    """Log nothing: a record that pytest keeps refers to its call, which must be collected."""
    caplog.set_level(logging.CRITICAL, "rosasync")


def test_in_any_order(full: bool) -> None:
    run_machine(
        StatusRaces,
        settings=settings(_settings(1_000 if full else 20), derandomize=not full),
    )


def _end_with_the_first_report(client: Client, report: Report) -> None:
    """As if the other servers of the name did not count."""
    sent = client.window.sent.get(report.number)
    if sent is not None:
        sent.servers = frozenset({report.server})
    _on_report(client, report)


_on_report = Client._on_report


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name", "mutant", "found"),
    [
        (Client, "_on_report", _end_with_the_first_report, "ended with|must have ended"),
        (ServerStatus, "_on_departure", lambda *_: None, "its caller had left"),
        (ServerStatus, "on_graph", lambda *_: None, "its caller had left"),
        (Reporter, "has_left", lambda *_: False, "its caller had left"),
    ],
)
def test_the_model_finds_a_mistake(
    owner: type[Any], name: str, mutant: Any, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, name, mutant)
    with pytest.raises(AssertionError, match=found):
        run_machine(StatusRaces, settings=settings(_settings(1_000), phases=[Phase.generate]))
