"""The methods of a session for actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, overload

from rosasync.options import check_hook, check_timeout
from rosasync.typing import ActionType, FeedbackT, GoalT, ResultT, Timeout

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from contextlib import AbstractAsyncContextManager
    from uuid import UUID

    from rosasync._actions.goal import Goal
    from rosasync._actions.goal_runner import GoalErrorHook, GoalHandler, OnBusy
    from rosasync._actions.intake import CancelHook, GoalHook
    from rosasync._actions.server import ActionServer, ServeService
    from rosasync._core.opening import Opening

__all__ = ["ActionMethods"]


class ActionMethods:
    """What a session does with actions; `rosasync.Session` inherits it."""

    # The session's own.
    _opening: Opening
    serve: ServeService

    @overload
    def serve_action(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        handler: GoalHandler[GoalT, FeedbackT, ResultT],
        *,
        on_goal: GoalHook[GoalT] | None = None,
        on_cancel: CancelHook[GoalT, FeedbackT] | None = None,
        on_busy: OnBusy = "queue",
        concurrency: int = 1,
        backlog: int = 10,
        result_timeout: float | None = 900.0,
        on_error: GoalErrorHook[GoalT, FeedbackT, ResultT] | None = None,
    ) -> ActionServer[GoalT, ResultT, FeedbackT]: ...

    @overload
    def serve_action(
        self,
        action_type: str,
        action_name: str,
        handler: GoalHandler[Any, Any, Any],
        *,
        on_goal: GoalHook[Any] | None = None,
        on_cancel: CancelHook[Any, Any] | None = None,
        on_busy: OnBusy = "queue",
        concurrency: int = 1,
        backlog: int = 10,
        result_timeout: float | None = 900.0,
        on_error: GoalErrorHook[Any, Any, Any] | None = None,
    ) -> ActionServer[Any, Any, Any]: ...

    def serve_action(
        self,
        action_type: Any,
        action_name: str,
        handler: GoalHandler[Any, Any, Any],
        *,
        on_goal: GoalHook[Any] | None = None,
        on_cancel: CancelHook[Any, Any] | None = None,
        on_busy: OnBusy = "queue",
        concurrency: int = 1,
        backlog: int = 10,
        result_timeout: float | None = 900.0,
        on_error: GoalErrorHook[Any, Any, Any] | None = None,
    ) -> ActionServer[Any, Any, Any]:
        """Serve an action from now until the server or the session is closed.

        ::

            async def drive(goal):
                for distance in range(10):
                    await base.step()
                    goal.feedback({"distance": distance})
                return {"total": 10}

            async with session.serve_action(Drive, "/drive", drive):
                ...

        Args:
            action_type: an action class or its name, ``"test_msgs/action/Fibonacci"``.
            action_name: the action's name.
            handler: ``handler(goal)`` with a `ServerGoal`, async. It returns the result, a message
                or a mapping of its fields, and the goal has SUCCEEDED. If it raises an exception,
                the goal is ABORTED, with the result of a `GoalAborted` if it is one. A cancellation
                arrives as ``CancelledError``: if it passes, or if the handler then returns a
                result, the goal is CANCELED.
            on_goal: ``on_goal(request)`` with the goal's message, plain or async, which returns
                whether to accept the goal. None to accept each.
            on_cancel: ``on_cancel(goal)``, plain or async, which returns whether to cancel a goal
                that a client wants to cancel. None to cancel it.
            on_busy: what happens to a goal that comes while ``concurrency`` goals run. ``"queue"``:
                it is accepted, and waits for its turn, unless ``backlog`` goals wait already.
                ``"reject"``: it is rejected. ``"replace"``: it is accepted, the oldest goal is
                cancelled, and it starts when that has ended.
            concurrency: the maximum number of handlers that run at a time.
            backlog: the maximum number of goals that wait, with ``"queue"``.
            result_timeout: seconds for which the result of a goal is kept after its end, for
                clients that ask for it then; None to keep it until the server ends.
            on_error: ``on_error(goal, error)``, plain or async, called when the handler has raised
                an exception, or returned something other than a result. It may return the result of
                the goal, which is ABORTED.

        Raises:
            TypeError: the handler is not an async function of one argument, a hook is not
                callable, or the type does not fit.
            ValueError: a limit is out of range; the action type does not exist.
            InvalidServiceName: ROS does not allow the name.
            UsageError: this process serves or calls another type under this name.
            SessionClosed, ContextShutdown: the session has ended, or has begun to.
        """
        return self._opening.use().serve_action(
            self.serve,
            action_type,
            action_name,
            handler,
            on_goal=on_goal,
            on_cancel=on_cancel,
            on_busy=on_busy,
            concurrency=concurrency,
            backlog=backlog,
            result_timeout=result_timeout,
            on_error=on_error,
        )

    @overload
    async def act(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        goal: GoalT | Mapping[str, Any] | None = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[FeedbackT], Any] | None = None,
    ) -> ResultT: ...

    @overload
    async def act(
        self,
        action_type: str,
        action_name: str,
        goal: Any = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[Any], Any] | None = None,
    ) -> Any: ...

    async def act(
        self,
        action_type: Any,
        action_name: str,
        goal: Any = None,
        *,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        on_feedback: Callable[[Any], Any] | None = None,
    ) -> Any:
        """Send a goal to an action, wait until it has ended, and return its result.

        If this is cancelled, or the timeout passes, the goal is cancelled on its server, whether it
        was accepted by then or not. The caller does not wait for that.

        Args:
            action_type: an action class or its name, ``"nav2_msgs/action/NavigateToPose"``. With a
                class, type checkers know the result.
            action_name: the action's name. Relative and private (``~/name``) names work.
            goal: a message of the goal type, a mapping of its fields, or None for an empty one.
            timeout: seconds for all of it; None for no deadline, because a goal may run for hours.
            accept_timeout: seconds until the goal is accepted, with the time to find the server;
                None for no deadline; if left out, the session's timeout.
            wait: False to fail at once if there is no server; or the number of seconds to wait for
                one within ``accept_timeout``.
            on_feedback: ``on_feedback(feedback)``, plain or async, called for each feedback
                message. If it raises, the goal is cancelled. While it runs, up to 1,000 messages
                wait; then the oldest are dropped, and a warning is logged.

        Raises:
            GoalRejected: the server did not accept the goal.
            GoalAborted, GoalCanceled: it has ended without success; ``error.result`` is its result.
            GoalTimeout: it was not accepted, or has not ended, in time.
            ServiceUnavailable: there was no server in time.
            ServerGone: every server vanished while the goal was out.
            SessionClosed, ContextShutdown: the session ended, before or during the goal.
            InvalidServiceName: ROS does not allow the name.
            TypeError, ValueError: an argument does not fit; nothing was sent.
            UsageError: called from another loop or thread.
        """
        core = self._opening.use()
        seconds = check_timeout(timeout, None)
        arguments = core.actions.arguments(action_type, action_name, goal, accept_timeout, wait)
        hook = check_hook("on_feedback", on_feedback, "feedback")
        return await core.actions.act(arguments, seconds, hook)

    @overload
    def goal(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        goal: GoalT | Mapping[str, Any] | None = None,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
        cancel_timeout: float = 5.0,
    ) -> AbstractAsyncContextManager[Goal[ResultT, FeedbackT]]: ...

    @overload
    def goal(
        self,
        action_type: str,
        action_name: str,
        goal: Any = None,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
        cancel_timeout: float = 5.0,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]: ...

    def goal(
        self,
        action_type: Any,
        action_name: str,
        goal: Any = None,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
        cancel_timeout: float = 5.0,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]:
        """Send a goal for a block, which reads its feedback and its result.

        ::

            async with session.goal(Fibonacci, "/fibonacci", {"order": 8}) as goal:
                async for feedback in goal:
                    print(feedback.sequence)
                result = await goal.result()

        Entering the block sends the goal and waits for its acceptance. A goal that is unfinished at
        the end of the block is cancelled on its server, whatever ends the block, unless
        ``goal.detach()`` was called. The block's end then waits for the goal's end, for
        ``cancel_timeout`` seconds at most; if the task was cancelled, it does not wait, and the
        session sees to the rest in the background.

        Args:
            action_type: an action class or its name.
            action_name: the action's name.
            goal: as for `act`.
            accept_timeout: as for `act`.
            wait: as for `act`.
            feedback: how many feedback messages are kept until they are read. Then the oldest is
                dropped, and counted in ``goal.feedback_dropped``.
            cancel_timeout: seconds to wait for the goal's end at the end of the block.

        Raises:
            Exception: entering raises as `act`, except `GoalAborted` and `GoalCanceled`.
        """
        core = self._opening.use()
        arguments = core.actions.arguments(action_type, action_name, goal, accept_timeout, wait)
        return core.actions.goal(arguments, feedback, cancel_timeout)

    @overload
    def attach(
        self,
        action_type: ActionType[GoalT, ResultT, FeedbackT],
        action_name: str,
        goal_id: UUID,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
    ) -> AbstractAsyncContextManager[Goal[ResultT, FeedbackT]]: ...

    @overload
    def attach(
        self,
        action_type: str,
        action_name: str,
        goal_id: UUID,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]: ...

    def attach(
        self,
        action_type: Any,
        action_name: str,
        goal_id: UUID,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        feedback: int = 10,
    ) -> AbstractAsyncContextManager[Goal[Any, Any]]:
        """Follow a goal that runs already, from any client. Leaving the block cancels nothing.

        Args:
            action_type: an action class or its name.
            action_name: the action's name.
            goal_id: the goal's identifier, such as ``goal.id`` of another session.
            accept_timeout: seconds until a server is found; as for `act`.
            wait: as for `act`.
            feedback: as for `goal`.

        Raises:
            TypeError: ``goal_id`` is not a ``uuid.UUID``.
            ValueError: ``goal_id`` has only zeros.
            Exception: entering raises as `act` if there is no server. If the server does not know
                the goal, ``goal.result()`` raises `GoalRejected`.
        """
        core = self._opening.use()
        return core.actions.attach(
            action_type, action_name, goal_id, accept_timeout, wait, feedback
        )
