"""Graph: one interface for tests, on a graph in memory or on real ROS."""

from __future__ import annotations

import asyncio
import inspect
import json
from collections.abc import Callable, Iterable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self, overload

from rosasync.errors import UsageError
from rosasync.testing._hooks import GraphSession, Hooks
from rosasync.testing._memory.graph import MemoryGraph
from rosasync.testing.stub import STUB, Answer, StubServer
from rosasync.testing.stub_action import STUB as STUB_ACTION
from rosasync.testing.stub_action import GoalAnswer, StubActionServer
from rosasync.typing import (
    ActionType,
    FeedbackT,
    GoalT,
    RequestT,
    ResponseT,
    ResultT,
    ServiceType,
)

if TYPE_CHECKING:
    from rosasync._actions.goal_runner import GoalHandler
    from rosasync._actions.server import ActionServer
    from rosasync._core.ports import Service
    from rosasync._server.handlers import Handler
    from rosasync._server.server import ServiceServer
    from rosasync.session import Session
    from rosasync.testing.recording import Recording

__all__ = ["Graph"]


class Graph:
    """A ROS graph for one test: servers to call, and sessions that call them.

    ::

        async with Graph() as graph:
            arm = graph.stub(SetBool, "/arm/enable", {"success": True})
            async with graph.session() as session:
                await enable_arm(session)
            arm.assert_called_with(data=True)

    The fixture ``ros_graph`` is an open one. Confined to the loop's thread.

    Both kinds behave alike, but for what only a middleware has: in memory there is no QoS and no
    introspection, and ``session.node`` is not an rclpy node. On real ROS, servers and sessions
    share one process, where the middleware allows one type for each service name: a call of another
    type is a `UsageError`, in memory `ServiceUnavailable`.

    Args:
        kind: ``"memory"``, which needs no rclpy; or ``"real"``, for real ROS in a domain that only
            this process uses. It sets ``ROS_DOMAIN_ID`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE`` in
            ``os.environ``, for child processes too.
        strict: whether the end of the block raises ``AssertionError`` if a call found no server, a
            stub had no answer left, or a server was never called.

    Attributes:
        kind: as given.
        strict: as given; may be changed until the end.
        servers: the servers, in the order of their creation.
        action_servers: the action servers, in the order of their creation.
        unexpected: what the code under test called without an answer for it, as sentences.
    """

    def __init__(self, kind: Literal["memory", "real"] = "memory", *, strict: bool = False) -> None:
        if kind not in ("memory", "real"):
            raise ValueError(f"kind must be 'memory' or 'real', not {kind!r}")
        self.kind = kind
        self.strict = strict
        self.servers: list[StubServer[Any, Any]] = []
        self.action_servers: list[StubActionServer[Any, Any, Any]] = []
        self.unexpected: list[str] = []
        self._memory = MemoryGraph() if kind == "memory" else None
        self._hooks = Hooks()
        self._stubs: Session | None = None

    async def __aenter__(self) -> Self:
        """Open the graph in the running loop.

        Raises:
            ImportError: rclpy is not installed, for real ROS.
            RuntimeError: all ROS domains are taken.
        """
        if self._memory is None:
            from rosasync._ros.domain import isolate_once

            isolate_once()
        self._stubs = await GraphSession(self._hooks, self._memory, "stubs").__aenter__()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the servers, and check what was called if the graph is strict.

        Raises:
            AssertionError: the graph is strict, and something was wrong.
        """
        for action_server in self.action_servers:
            await action_server.vanish()
        for server in self.servers:
            await server.vanish()
        await self._open().aclose()
        if self.strict and exc is None:
            self.check()

    def session(
        self, node: Any = "test", *, recording: Recording | None = None, **options: Any
    ) -> Session:
        """Create a session in this graph, for the code under test.

        Args:
            node: as for `rosasync.Session`.
            recording: records the calls of the session.
            options: those of `rosasync.Session`.
        """
        if self._memory is None and isinstance(node, str):
            # One participant of the middleware: its clients and servers match at once.
            options.setdefault("context", self._open().node.context)
        hooks = Hooks(on_missing=self._missing)
        if recording is not None:
            hooks.wrap_client = recording.wrap_client
        return GraphSession(hooks, self._memory, node, **options)

    @overload
    def serve(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        handler: Handler[RequestT, ResponseT] | None = None,
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubServer[RequestT, ResponseT]: ...

    @overload
    def serve(
        self,
        srv_type: str,
        srv_name: str,
        handler: Handler[Any, Any] | None = None,
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubServer[Any, Any]: ...

    def serve(
        self,
        srv_type: Any,
        srv_name: str,
        handler: Any = None,
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubServer[Any, Any]:
        """Serve a service with a handler.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            handler: every kind that `rosasync.Session.serve` takes, and it behaves as there. None
                for ``async for call in server:``.
            optional: whether a strict graph accepts that it is never called.
            options: those of `rosasync.Session.serve`.

        Raises:
            TypeError, ValueError, InvalidServiceName: as `rosasync.Session.serve`.
            UsageError: the graph is not open, or this runs outside its loop.
        """
        return self._serve(srv_type, srv_name, handler, optional, options)

    @overload
    def stub(
        self,
        srv_type: ServiceType[RequestT, ResponseT],
        srv_name: str,
        *answers: Answer,
        optional: bool = False,
        **options: Any,
    ) -> StubServer[RequestT, ResponseT]: ...

    @overload
    def stub(
        self, srv_type: str, srv_name: str, *answers: Answer, optional: bool = False, **options: Any
    ) -> StubServer[Any, Any]: ...

    def stub(
        self, srv_type: Any, srv_name: str, *answers: Answer, optional: bool = False, **options: Any
    ) -> StubServer[Any, Any]:
        """Serve a service with fixed answers; further ones by `StubServer.answer`.

        Args:
            srv_type: a service class or its name.
            srv_name: the service's name.
            answers: the answers to all requests, as for `StubServer.answer`.
            optional: whether a strict graph accepts that it is never called.
            options: those of `rosasync.Session.serve`.

        Raises:
            TypeError, ValueError, InvalidServiceName: an argument does not fit.
            UsageError: the graph is not open, or this runs outside its loop.
        """
        server = self._serve(srv_type, srv_name, STUB, optional, options)
        return server.answer(*answers) if answers else server

    @overload
    def serve_action(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        handler: GoalHandler[GoalT, FeedbackT, ResultT],
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[GoalT, ResultT, FeedbackT]: ...

    @overload
    def serve_action(
        self,
        action_type: str,
        action_name: str,
        handler: GoalHandler[Any, Any, Any],
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[Any, Any, Any]: ...

    def serve_action(
        self,
        action_type: Any,
        action_name: str,
        handler: Any,
        *,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[Any, Any, Any]:
        """Serve an action with a handler.

        Args:
            action_type: an action class or its name.
            action_name: the action's name.
            handler: ``handler(goal)``, async, as for `rosasync.Session.serve_action`.
            optional: whether a strict graph accepts that it never gets a goal.
            options: those of `rosasync.Session.serve_action`.

        Raises:
            TypeError, ValueError, InvalidServiceName: as `rosasync.Session.serve_action`.
            UsageError: the graph is not open, or this runs outside its loop.
        """
        return self._serve_action(action_type, action_name, handler, optional, options)

    @overload
    def stub_action(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        *answers: GoalAnswer,
        feedback: Iterable[FeedbackT | Mapping[str, Any]] = (),
        delay: float = 0.0,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[GoalT, ResultT, FeedbackT]: ...

    @overload
    def stub_action(
        self,
        action_type: str,
        action_name: str,
        *answers: GoalAnswer,
        feedback: Iterable[Any] = (),
        delay: float = 0.0,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[Any, Any, Any]: ...

    def stub_action(
        self,
        action_type: Any,
        action_name: str,
        *answers: GoalAnswer,
        feedback: Iterable[Any] = (),
        delay: float = 0.0,
        optional: bool = False,
        **options: Any,
    ) -> StubActionServer[Any, Any, Any]:
        """Serve an action with fixed answers; further ones by `StubActionServer.answer`.

        ::

            drive = graph.stub_action(Drive, "/drive", {"driven": 2.0}, feedback=[{"driven": 1.0}])

        Args:
            action_type: an action class or its name.
            action_name: the action's name.
            answers: the answers to all goals, as for `StubActionServer.answer`.
            feedback: the feedback of each goal, messages or mappings.
            delay: seconds before each feedback message, and before the end of a goal.
            optional: whether a strict graph accepts that it never gets a goal.
            options: those of `rosasync.Session.serve_action`; ``concurrency`` is 100 if left out.

        Raises:
            TypeError, ValueError, InvalidServiceName: an argument does not fit.
            UsageError: the graph is not open, or this runs outside its loop.
        """
        server = self._serve_action(action_type, action_name, STUB_ACTION, optional, options)
        if answers or feedback or delay:
            server.answer(*answers, feedback=feedback, delay=delay)
        return server

    def replay(
        self, recording: Recording, *, optional: bool = False
    ) -> dict[str, StubServer[Any, Any]]:
        """Serve each service of a recording with its responses.

        The same request gets its recorded responses in turn, and then the last one again. A
        request that was not recorded stays unanswered, and a strict graph fails the test.

        Args:
            recording: the calls to replay.
            optional: whether a strict graph accepts that a service is never called.

        Returns:
            The server of each service name.
        """
        servers: dict[str, StubServer[Any, Any]] = {}
        answers: dict[tuple[str, str], list[Answer]] = {}
        requests: dict[tuple[str, str], Any] = {}
        for call in recording.calls:
            if call.srv_name not in servers:
                servers[call.srv_name] = self.stub(call.srv_type, call.srv_name, optional=optional)
            key = call.srv_name, json.dumps(call.request, sort_keys=True, default=repr)
            answers.setdefault(key, []).append(call.response)
            requests[key] = call.request
        for key, responses in answers.items():
            server = servers[key[0]]
            if len(responses) > 1:
                server.answer(*responses, match=requests[key])
            server.answer(responses[-1], match=requests[key])
        return servers

    def check(self) -> None:
        """Check that every call had its answer, and every server a call.

        Raises:
            AssertionError: not so; the message lists what was wrong.
        """
        __tracebackhide__ = True
        uncalled = [
            f"{server.srv_name} was never called"
            for server in self.servers
            if not (server.calls or server.lost_requests or server.optional)
        ]
        uncalled += [
            f"{action_server.action_name} never got a goal"
            for action_server in self.action_servers
            if not (action_server.goals or action_server.lost_requests or action_server.optional)
        ]
        if problems := [*dict.fromkeys(self.unexpected), *uncalled]:
            raise AssertionError("\n".join(["the graph is strict, and", *problems]))

    def _serve(
        self, srv_type: Any, srv_name: str, handler: Any, optional: bool, options: dict[str, Any]
    ) -> StubServer[Any, Any]:
        self._open()
        _check_loop(srv_name)
        server = StubServer[Any, Any](
            srv_type,
            srv_name,
            handler,
            options,
            optional,
            self._open_server,
            self.unexpected.append,
        )
        self.servers.append(server)
        return server

    def _serve_action(
        self,
        action_type: Any,
        action_name: str,
        handler: Any,
        optional: bool,
        options: dict[str, Any],
    ) -> StubActionServer[Any, Any, Any]:
        self._open()
        _check_loop(action_name)
        server = StubActionServer[Any, Any, Any](
            action_type,
            action_name,
            handler,
            options,
            optional,
            self._open_action_server,
            self.unexpected.append,
        )
        self.action_servers.append(server)
        return server

    def _open(self) -> Session:
        if self._stubs is None:
            raise UsageError("the graph is not open: use `async with Graph() as graph:`")
        return self._stubs

    def _open_server(
        self, wrap: Callable[..., Any], *args: Any, **options: Any
    ) -> ServiceServer[Any, Any]:
        self._hooks.wrap_service = wrap
        try:
            return self._open().serve(*args, **options)
        finally:
            self._hooks.wrap_service = None

    def _open_action_server(
        self, wrap: Callable[..., Any], *args: Any, **options: Any
    ) -> ActionServer[Any, Any, Any]:
        session = self._open()
        self._hooks.wrap_service = wrap
        try:
            return session.core.serve_action(session.serve, *args, **options)
        finally:
            self._hooks.wrap_service = None

    def _missing(self, service: Service) -> None:
        name, kind, _ = service.key
        known = {server.srv_name for server in self.servers}
        action, _, part = name.partition("/_action/")
        if part:
            known.update(server.action_name for server in self.action_servers)
            name, kind = action, kind.rpartition("_")[0]
        if name not in known:
            self.unexpected.append(f"{name} ({kind}) was called, and has no server")


def _check_loop(srv_name: str) -> None:
    """Raise `UsageError` in a function that no loop runs: a plain fixture, or a plain test."""
    if asyncio._get_running_loop() is not None:
        return
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").startswith("rosasync.testing"):
        frame = frame.f_back
    name = "the caller" if frame is None else frame.f_code.co_name
    raise UsageError(
        f"{srv_name} cannot be served by {name}, which no event loop runs: make it async "
        f"(async def {name}), in pytest's strict mode with @pytest_asyncio.fixture for a fixture"
    )
