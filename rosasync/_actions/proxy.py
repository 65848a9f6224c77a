"""AsyncActionProxy: a tick-driven state machine for the goals of an action."""

from __future__ import annotations

import asyncio
import contextlib
import enum
from collections.abc import Mapping
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Generic, cast

from rosasync._core.operations import CurrentOperation, Operation
from rosasync.errors import CallError, GoalAborted, GoalCanceled, GoalRejected, SessionClosed
from rosasync.options import check_timeout
from rosasync.typing import ActionType, FeedbackT, GoalT, ResultT, Timeout

if TYPE_CHECKING:
    from rosasync._actions.goal import Goal
    from rosasync._actions.registry import ActArguments
    from rosasync.session import Session

__all__ = ["ActionState", "AsyncActionProxy"]


class ActionState(enum.Enum):
    """The state of the last goal of an `AsyncActionProxy`.

    Attributes:
        IDLE: there was no goal yet, or its result has been read.
        WAITING: it waits for a server, or for the acceptance.
        ACTIVE: the server has accepted the goal, which waits there or runs.
        CANCELING: it is being cancelled, and has not ended yet.
        SUCCEEDED: the result can be read.
        CANCELED: it was cancelled, by `AsyncActionProxy.cancel_goal` or by another client.
        ABORTED: the server has given up.
        REJECTED: the server did not accept it.
        TIMEOUT: a deadline passed. The goal is cancelled in the background.
        ERROR: it failed with another error; `AsyncActionProxy.get_errors` returns it.
    """

    IDLE = enum.auto()
    WAITING = enum.auto()
    ACTIVE = enum.auto()
    CANCELING = enum.auto()
    SUCCEEDED = enum.auto()
    CANCELED = enum.auto()
    ABORTED = enum.auto()
    REJECTED = enum.auto()
    TIMEOUT = enum.auto()
    ERROR = enum.auto()


PENDING = (ActionState.WAITING, ActionState.ACTIVE)
"""The states in which the loop works on a goal. CANCELING is ACTIVE with a wish to cancel."""


class AsyncActionProxy(Generic[GoalT, ResultT, FeedbackT]):
    """Sends goals to an action from the ticks of a behaviour tree.

    No method blocks, and each may be called from the loop and from any other thread. A new goal
    replaces the previous one, which is cancelled on its server if it has not ended. The states
    change by themselves as the goal goes on. Nothing that comes late shows up as the new goal's.

    Args:
        session: an open session.
        action_type: an action class or its name, ``"nav2_msgs/action/NavigateToPose"``.
        action_name: the action's name.

    Raises:
        TypeError, ValueError: the action type does not exist.
        InvalidServiceName: ROS does not allow the name.
        UsageError: the session is not open yet.
        SessionClosed: the session is closed.
    """

    __slots__ = (
        "__weakref__",
        "_action_name",
        "_action_type",
        "_actions",
        "_current",
        "_gateway",
        "_timeout",
    )

    def __init__(
        self,
        session: Session,
        action_type: ActionType[GoalT, ResultT, FeedbackT] | str,
        action_name: str,
    ) -> None:
        core = session.core
        core.gateway.check_open()
        self._gateway = core.gateway
        self._actions = core.actions
        self._timeout = core.timeout
        self._actions.describe(action_type, action_name)
        self._action_type = action_type
        self._action_name = action_name
        self._current = CurrentOperation(core.gateway, _Pursuit(ActionState.IDLE))

    def __repr__(self) -> str:
        return f"<AsyncActionProxy {self._action_name} {self.get_state().name}>"

    def send_goal(
        self,
        goal: GoalT | Mapping[str, Any] | None = None,
        timeout: float | None = None,
        *,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
    ) -> None:
        """Send a goal, which replaces the previous one. The state becomes WAITING.

        The goal is copied, so it may be changed afterwards.

        Args:
            goal: a message of the goal type, a mapping of its fields, or None for an empty one.
            timeout: seconds for all of it; None for no deadline, because a goal may run for hours.
            accept_timeout: seconds until the goal is accepted; None for no deadline; if left out,
                the session's timeout.
            wait: False to fail at once if there is no server; or the seconds to wait for one.

        Raises:
            TypeError, ValueError: an argument does not fit; the state is unchanged.
            UsageError: the proxy was shut down.
        """
        arguments = self._actions.arguments(
            self._action_type,
            self._action_name,
            goal if goal is None else deepcopy(goal),
            accept_timeout,
            wait,
        )
        seconds = check_timeout(timeout, None)
        pursuit = _Pursuit(ActionState.WAITING, arguments, seconds)
        self._current.start(self._action_name, pursuit, self._begin, stop=self.cancel_goal)

    def make_goal(self, goal: GoalT | Mapping[str, Any] | None) -> GoalT:
        """Return the message that `send_goal` sends for this argument, to prepare it in advance.

        Raises:
            TypeError, ValueError: it does not fit.
        """
        arguments = self._actions.arguments(self._action_type, self._action_name, goal, None, True)
        return cast(GoalT, arguments.message)

    def cancel_goal(self) -> None:
        """Cancel the goal, in any state.

        If it is ACTIVE, it is CANCELING until the server reports its end. If it is WAITING, it
        becomes CANCELED; if the server accepts it nevertheless, it is cancelled in the background.
        In the other states nothing changes.
        """
        pursuit = self._current.operation
        if pursuit.state is ActionState.WAITING:
            self._current.replace(_Pursuit(ActionState.CANCELED), self._begin)
        elif pursuit.state is ActionState.ACTIVE and not pursuit.cancelling:
            pursuit.cancelling = True
            with contextlib.suppress(SessionClosed):
                self._gateway.call(self._cancel, pursuit)

    def get_state(self) -> ActionState:
        """Return the state. Cheap: it only reads attributes."""
        pursuit = self._current.operation
        state = pursuit.state
        if state is ActionState.ACTIVE and pursuit.cancelling:
            return ActionState.CANCELING
        return state

    def get_feedback(self) -> FeedbackT | None:
        """Return the goal's newest feedback; None before the first."""
        return cast("FeedbackT | None", self._current.operation.feedback)

    def get_result(self) -> ResultT | None:
        """Return the result of a goal that SUCCEEDED and become IDLE; None in any other state.

        The result of an ABORTED or CANCELED goal is that of its error.
        """
        result = self._current.operation.take(ActionState.SUCCEEDED, ActionState.IDLE)
        return cast("ResultT | None", result)

    def get_errors(self) -> list[Exception]:
        """Return the error of the goal, or of its cancellation if the server refuses that."""
        return self._current.operation.errors()

    def shutdown(self) -> None:
        """Cancel the goal, and refuse further ones; idempotent."""
        self._current.closed = True
        self.cancel_goal()

    # On the loop's thread.

    def _begin(self, pursuit: _Pursuit) -> asyncio.Task[None]:
        return self._gateway.loop.create_task(self._work(pursuit))

    def _cancel(self, pursuit: _Pursuit) -> None:
        goal = pursuit.goal
        if goal is not None:
            pursuit.cancel_task = self._gateway.loop.create_task(self._cancel_goal(pursuit, goal))

    async def _cancel_goal(self, pursuit: _Pursuit, goal: Goal[Any, Any]) -> None:
        try:
            await goal.cancel()
        except CallError as error:
            # Otherwise the goal has ended meanwhile, and its own error counts.
            if pursuit.state is ActionState.ACTIVE:
                pursuit.error = error
                pursuit.cancelling = False
        except Exception as error:
            pursuit.fail(error)

    async def _work(self, pursuit: _Pursuit) -> None:
        try:
            result = await self._actions.act(
                pursuit.arguments, pursuit.time_left(), pursuit.set_feedback, pursuit.accept
            )
            pursuit.end(ActionState.SUCCEEDED, result)
        except GoalCanceled as error:
            pursuit.end(ActionState.CANCELED, error=error)
        except GoalAborted as error:
            pursuit.end(ActionState.ABORTED, error=error)
        except GoalRejected as error:
            pursuit.end(ActionState.REJECTED, error=error)
        except TimeoutError as error:
            pursuit.end(ActionState.TIMEOUT, error=error)
        except asyncio.CancelledError:
            pursuit.end(ActionState.CANCELED)
            raise
        except Exception as error:
            pursuit.fail(error)
        finally:
            pursuit.goal = None
            if pursuit.cancel_task is not None:
                pursuit.cancel_task.cancel()
            self._current.leave(pursuit)


class _Pursuit(Operation[ActionState]):
    """One goal of a proxy, from its sending to its end, or none."""

    __slots__ = ("_arguments", "cancel_task", "cancelling", "feedback", "goal")

    PENDING = PENDING
    FAILED = ActionState.ERROR

    def __init__(
        self,
        state: ActionState,
        arguments: ActArguments | None = None,
        timeout: float | None = None,
    ) -> None:
        super().__init__(state, timeout)
        self.cancelling = False
        self.feedback: Any = None
        self.goal: Goal[Any, Any] | None = None
        self.cancel_task: asyncio.Task[None] | None = None
        self._arguments = arguments

    @property
    def arguments(self) -> ActArguments:
        """The arguments of the goal."""
        assert self._arguments is not None
        return self._arguments

    def accept(self, goal: Goal[Any, Any]) -> None:
        """Go on with the goal that the server has accepted."""
        if self.state is ActionState.WAITING:
            self.goal = goal
            self.state = ActionState.ACTIVE

    def set_feedback(self, feedback: Any) -> None:
        """Keep the newest feedback."""
        self.feedback = feedback
