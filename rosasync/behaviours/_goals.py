"""The behaviour that sends a goal to an action."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic

from rosasync._actions.proxy import ActionState, AsyncActionProxy
from rosasync.behaviours._base import Access, Leaf, Status
from rosasync.options import check_hook, check_timeout, check_wait
from rosasync.typing import ActionType, FeedbackT, GoalT, ResultT, Timeout

if TYPE_CHECKING:
    from rosasync.session import Session

__all__ = ["SendGoal"]

_GOAL_OUT = (ActionState.WAITING, ActionState.ACTIVE, ActionState.CANCELING)


class SendGoal(
    Leaf[AsyncActionProxy[GoalT, ResultT, FeedbackT]], Generic[GoalT, ResultT, FeedbackT]
):
    """Sends a goal to an action once in each run. It is RUNNING until the goal has ended.

    It ends with SUCCESS if the goal has succeeded, and with FAILURE otherwise. An interruption
    cancels the goal on its server, also if it was not accepted yet; no tick waits for that. Each
    run unsets the result, feedback and error on the blackboard before it sends.

    If a function that it was given raises, or a blackboard variable cannot be read or written, the
    run ends with FAILURE, and the goal is cancelled.

    Args:
        name: the name of the behaviour.
        action_type: an action class or its name, ``"nav2_msgs/action/NavigateToPose"``.
        action_name: the action's name.
        goal: a message, a mapping of its fields, or None for an empty one; or a function that
            returns one of these, called at the beginning of each run.
        key_goal: the blackboard variable to take the goal from, instead of ``goal``; it may be
            nested.
        key_result: the blackboard variable for the result of a goal that has succeeded.
        key_feedback: the blackboard variable for the newest feedback of the goal.
        key_error: the blackboard variable for the exception of a failed run.
        on_result: called with the result; it may return the status to end with.
        on_feedback: called with the newest feedback, in the tick that finds it.
        on_error: called with the exception; it may return the status to end with.
        timeout: seconds for all of it; None for no deadline.
        accept_timeout: seconds until the goal is accepted; if left out, the session's timeout.
        wait: False to fail at once if there is no server; or the seconds to wait for one.
        session: the session; None to take it from ``tree.setup(session=…)``.

    Raises:
        TypeError: both a goal and a key for it are given.
        TypeError, ValueError: a timeout, ``wait`` or a function does not fit.
    """

    def __init__(
        self,
        name: str,
        action_type: ActionType[GoalT, ResultT, FeedbackT] | str,
        action_name: str,
        goal: GoalT
        | Mapping[str, Any]
        | Callable[[], GoalT | Mapping[str, Any] | None]
        | None = None,
        *,
        key_goal: str | None = None,
        key_result: str | None = None,
        key_feedback: str | None = None,
        key_error: str | None = None,
        on_result: Callable[[ResultT], Status | None] | None = None,
        on_feedback: Callable[[FeedbackT], object] | None = None,
        on_error: Callable[[Exception], Status | None] | None = None,
        timeout: float | None = None,
        accept_timeout: Timeout = ...,
        wait: bool | float = True,
        session: Session | None = None,
    ) -> None:
        super().__init__(name, session)
        if goal is not None and key_goal is not None:
            raise TypeError("give either a goal or a key_goal, not both")
        check_timeout(timeout, None)
        check_timeout(accept_timeout, None, "accept_timeout")
        check_wait(wait)
        check_hook("on_result", on_result, "result")
        check_hook("on_feedback", on_feedback, "feedback")
        check_hook("on_error", on_error, "error")
        self.action_type = action_type
        self.action_name = action_name
        self._goal: Any = goal
        self._timeout = timeout
        self._accept_timeout = accept_timeout
        self._wait = wait
        # Why the run has failed, if its goal could not be sent.
        self._start_error: Exception | None = None
        self._shown: FeedbackT | None = None
        self._on_result = on_result
        self._on_feedback = on_feedback
        self._on_error = on_error
        self._key_goal = key_goal
        self._key_result = key_result
        self._key_feedback = key_feedback
        self._key_error = key_error
        self.blackboard = self.attach_blackboard_client()
        self._register(Access.READ, key_goal)
        self._register(Access.WRITE, key_result, key_feedback, key_error)

    @property
    def proxy(self) -> AsyncActionProxy[GoalT, ResultT, FeedbackT]:
        """The proxy, from `setup` to `shutdown`.

        Raises:
            UsageError: the behaviour is not set up.
        """
        return self._require_proxy()

    def setup(self, **kwargs: Any) -> None:
        """Take the session, and check a constant goal; never blocks.

        Raises:
            KeyError: there is no session.
            TypeError, ValueError: the action type or a constant goal does not fit.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed: the session is closed.
        """
        session = self._find_session(kwargs)
        self.shutdown()
        self._proxy = AsyncActionProxy(session, self.action_type, self.action_name)
        if not callable(self._goal) and self._key_goal is None:
            self._goal = self._proxy.make_goal(self._goal)

    def initialise(self) -> None:
        """Send the goal."""
        proxy = self.proxy
        proxy.cancel_goal()
        self._start_error = self._shown = None
        try:
            for key in (self._key_result, self._key_feedback, self._key_error):
                self._unset(key)
            proxy.send_goal(
                self._take(self._goal, self._key_goal),
                self._timeout,
                accept_timeout=self._accept_timeout,
                wait=self._wait,
            )
            self._set_feedback(f"sending a goal to {self.action_name}")
        except Exception as error:
            self._start_error = error
            # As in `CallService`: a missing variable is usual.
            self._log("the goal was not sent", error, traceback=self._key_goal is None)

    def update(self) -> Status:
        """Return the status of the goal."""
        aborted = f"{self.action_name}: cancelled"
        if self._start_error is not None:
            return self._failed(self._start_error, aborted)
        proxy = self.proxy
        state = proxy.get_state()
        try:
            self._show_feedback(proxy.get_feedback())
            if state in _GOAL_OUT:
                self._set_feedback(f"{self.action_name}: {state.name.lower()}")
                return Status.RUNNING
            if state is ActionState.SUCCEEDED:
                return self._succeeded(proxy.get_result())
        except Exception as error:
            proxy.cancel_goal()
            self._log("the goal was not handled", error)
            return self._failed(error, aborted)
        errors = proxy.get_errors()
        return self._failed(errors[0] if errors else None, aborted)

    def _stop(self, proxy: AsyncActionProxy[GoalT, ResultT, FeedbackT]) -> None:
        proxy.cancel_goal()

    def _show_feedback(self, feedback: FeedbackT | None) -> None:
        if feedback is not None and feedback is not self._shown:
            self._shown = feedback
            self._set(self._key_feedback, feedback)
            if self._on_feedback is not None:
                self._on_feedback(feedback)

    def _succeeded(self, result: ResultT | None) -> Status:
        self._set_feedback(f"{self.action_name} succeeded")
        self._set(self._key_result, result)
        status = None
        if self._on_result is not None and result is not None:
            status = self._on_result(result)
        return Status.SUCCESS if status is None else status
