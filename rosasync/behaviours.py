"""Behaviours for py_trees that call services without ever blocking a tick (extra ``py-trees``).

Ticked in the loop, with an ``await`` between ticks, or in a thread of the tree's own, with
``tree.tick_tock``::

    root = py_trees.composites.Sequence("fetch", memory=True, children=[
        WaitForService("arm there?", SetBool, "/arm/enable", timeout=5.0),
        CallService("enable arm", SetBool, "/arm/enable", {"data": True}, timeout=2.0),
    ])
    tree = py_trees.trees.BehaviourTree(root)
    tree.setup(session=session)
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from rosasync._actions.proxy import ActionState, AsyncActionProxy
from rosasync._core.proxy import AsyncServiceProxy, ProxyState
from rosasync.errors import UsageError
from rosasync.options import Retry, check_retry, check_timeout
from rosasync.typing import (
    ActionType,
    FeedbackT,
    GoalT,
    RequestT,
    ResponseT,
    ResultT,
    ServiceType,
    Timeout,
)

try:
    from py_trees.behaviour import Behaviour
    from py_trees.common import Access, Status
except ImportError as error:
    raise ImportError(
        f"rosasync.behaviours needs py_trees, which cannot be imported here ({error}): "
        "pip install 'rosasync[py-trees]'"
    ) from error

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from rosasync.session import Session

__all__ = ["CallService", "FromBlackboard", "FromConstant", "SendGoal", "WaitForService"]

logger = logging.getLogger("rosasync")


ProxyT = TypeVar("ProxyT", bound="AsyncServiceProxy[Any, Any] | AsyncActionProxy[Any, Any, Any]")


class Leaf(Behaviour, Generic[ProxyT]):  # type: ignore[misc]
    """What the behaviours share: a proxy from `setup` to `shutdown`, and the blackboard."""

    blackboard: Any

    def __init__(self, name: str, session: Session | None) -> None:
        super().__init__(name)
        self._session = session
        self._proxy: ProxyT | None = None
        self._key_error: str | None = None
        self._on_error: Callable[[Exception], Status | None] | None = None

    def terminate(self, new_status: Status) -> None:
        """Cancel the call, the wait or the goal if the behaviour is interrupted."""
        if new_status is Status.INVALID and self._proxy is not None:
            self._stop(self._proxy)

    def shutdown(self) -> None:
        """Do what an interruption does, and drop the proxy. `setup` may be called again."""
        if self._proxy is not None:
            self._proxy.shutdown()
            self._proxy = None

    def _stop(self, proxy: ProxyT) -> None:
        """Cancel what the proxy does."""
        raise NotImplementedError

    def _find_session(self, given: Mapping[str, Any]) -> Session:
        session: Session | None = self._session or given.get("session")
        if session is None:
            raise KeyError(
                f"{self.qualified_name} has no session: call tree.setup(session=session), or give "
                "it session="
            )
        return session

    def _require_proxy(self) -> ProxyT:
        if self._proxy is None:
            raise UsageError(
                f"{self.qualified_name} is not set up: call tree.setup(session=session)"
            )
        return self._proxy

    def _register(self, access: Access, *names: str | None) -> None:
        for name in names:
            if name is not None:
                self.blackboard.register_key(key=name.split(".")[0], access=access)

    def _set(self, name: str | None, value: Any) -> None:
        if name is not None:
            self.blackboard.set(name, value)

    def _unset(self, name: str | None) -> None:
        if name is None:
            return
        if "." not in name:
            self.blackboard.unset(name)
            return
        # An attribute cannot be unset, and its object may not exist yet.
        with contextlib.suppress(KeyError):
            self.blackboard.set(name, None)

    def _take(self, given: Any, key: str | None) -> Any:
        """Return the input of a run: from the blackboard, from a function, or a constant."""
        if key is not None:
            return self.blackboard.get(key)
        return given() if callable(given) else given

    def _failed(self, error: Exception | None, aborted: str) -> Status:
        """Report the error of the run, None if it was aborted; return the status to end with."""
        status = None
        try:
            if error is not None:
                self._set(self._key_error, error)
            self._set_feedback(aborted if error is None else str(error))
            if self._on_error is not None and error is not None:
                status = self._on_error(error)
        except Exception as later:
            later.__context__ = later.__context__ or error
            self._log("the error was not handled", later)
            self.feedback_message = str(later)
            with contextlib.suppress(Exception):
                self._set(self._key_error, later)
        return Status.FAILURE if status is None else status

    def _set_feedback(self, message: str) -> None:
        self.feedback_message = message

    def _log(self, what: str, error: Exception, *, traceback: bool = True) -> None:
        shown = error if traceback else None
        logger.error("%s: %s: %r", self.qualified_name, what, error, exc_info=shown)


class ServiceBehaviour(Leaf[AsyncServiceProxy[RequestT, ResponseT]], Generic[RequestT, ResponseT]):
    """The base of the behaviours that have a service."""

    def __init__(
        self,
        name: str,
        srv_type: ServiceType[RequestT, ResponseT] | str,
        srv_name: str,
        qos: QoSProfile | None,
        session: Session | None,
        retry: Retry | None = None,
    ) -> None:
        super().__init__(name, session)
        self.srv_type = srv_type
        self.srv_name = srv_name
        self._qos = qos
        self._retry = retry

    def setup(self, **kwargs: Any) -> None:
        """Take the session from the constructor or from ``tree.setup(session=…)``; never blocks.

        Raises:
            KeyError: there is no session.
            TypeError, ValueError: the service type does not exist, or the QoS is not a
                ``QoSProfile``.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed: the session is closed.
        """
        session = self._find_session(kwargs)
        self.shutdown()
        self._proxy = AsyncServiceProxy(
            session, self.srv_type, self.srv_name, qos=self._qos, retry=self._retry
        )

    @property
    def proxy(self) -> AsyncServiceProxy[RequestT, ResponseT]:
        """The proxy, from `setup` to `shutdown`.

        Raises:
            UsageError: the behaviour is not set up.
        """
        return self._require_proxy()

    def _stop(self, proxy: AsyncServiceProxy[RequestT, ResponseT]) -> None:
        proxy.stop_call()


class CallService(ServiceBehaviour[RequestT, ResponseT]):
    """Calls a service once in each run. It is RUNNING until the response arrives.

    It ends with SUCCESS if the call is answered, and with FAILURE if the call fails or if there is
    no request. If the response has a bool field ``success``, as those of ``SetBool`` and
    ``Trigger``, the run fails unless it is true. An interruption cancels the call. Each run unsets
    the response and the error on the blackboard before it calls, so it never shows the result of an
    earlier run.

    If a function that it was given raises, or a blackboard variable cannot be read or written, the
    run ends with FAILURE, as with any other error. The tree goes on; the traceback is logged.

    Args:
        name: the name of the behaviour.
        srv_type: a service class or its name, ``"std_srvs/srv/SetBool"``.
        srv_name: the service's name.
        request: a message, a mapping of its fields, or None for an empty one; or a function that
            returns one of these, called at the beginning of each run.
        key_request: the blackboard variable to take the request from, instead of ``request``; it
            may be nested (``goal.request``).
        key_response: the blackboard variable for the response.
        key_error: the blackboard variable for the exception of a failed run.
        key_feedback_message: the blackboard variable for the feedback message.
        on_response: called with the response; it may return the status to end with, whatever the
            response's ``success`` says.
        on_error: called with the exception; it may return the status to end with.
        on_feedback: called with each new feedback message.
        timeout: seconds for the whole call; None for no deadline; if left out, the session's.
        wait: False to fail at once if there is no server.
        retry: when to send an unanswered request again; only for services that may run twice.
        qos: a ``QoSProfile``; None for the service default.
        session: the session; None to take it from ``tree.setup(session=…)``.

    Raises:
        TypeError: both a request and a key for it are given.
        TypeError, ValueError: the timeout or retry does not fit.
    """

    def __init__(
        self,
        name: str,
        srv_type: ServiceType[RequestT, ResponseT] | str,
        srv_name: str,
        request: RequestT
        | Mapping[str, Any]
        | Callable[[], RequestT | Mapping[str, Any] | None]
        | None = None,
        *,
        key_request: str | None = None,
        key_response: str | None = None,
        key_error: str | None = None,
        key_feedback_message: str | None = None,
        on_response: Callable[[ResponseT], Status | None] | None = None,
        on_error: Callable[[Exception], Status | None] | None = None,
        on_feedback: Callable[[str], object] | None = None,
        timeout: Timeout = ...,
        wait: bool | float = True,
        retry: Retry | None = None,
        qos: QoSProfile | None = None,
        session: Session | None = None,
    ) -> None:
        super().__init__(name, srv_type, srv_name, qos, session, retry)
        if request is not None and key_request is not None:
            raise TypeError("give either a request or a key_request, not both")
        check_timeout(timeout, None)
        if retry is not None:
            check_retry(retry)
        self._request: Any = request
        self._timeout = timeout
        self._wait = wait
        # Why the run has failed, if its call could not be started.
        self._start_error: Exception | None = None
        self._on_response = on_response
        self._on_error = on_error
        self._on_feedback = on_feedback
        self._key_request = key_request
        self._key_response = key_response
        self._key_error = key_error
        self._key_feedback_message = key_feedback_message
        self.blackboard = self.attach_blackboard_client()
        self._register(Access.READ, key_request)
        self._register(Access.WRITE, key_response, key_error, key_feedback_message)

    def setup(self, **kwargs: Any) -> None:
        """Take the session, and check a constant request; never blocks.

        Raises:
            KeyError: there is no session.
            TypeError, ValueError: the service type, the QoS or a constant request does not fit.
            InvalidServiceName: ROS does not allow the name.
            SessionClosed: the session is closed.
        """
        super().setup(**kwargs)
        if not callable(self._request) and self._key_request is None:
            self._request = self.proxy.make_request(self._request)

    def initialise(self) -> None:
        """Start the call."""
        proxy = self.proxy
        proxy.stop_call()
        self._start_error = None
        try:
            self._unset(self._key_response)
            self._unset(self._key_error)
            request = self._take(self._request, self._key_request)
            proxy.call_service(request, self._timeout, wait=self._wait)
            self._set_feedback(f"calling {self.srv_name}")
        except Exception as error:
            # The call may be out, if its feedback has failed.
            proxy.stop_call()
            self._start_error = error
            # That a blackboard variable does not exist yet is usual, and may recur in every tick.
            self._log("the call was not made", error, traceback=self._key_request is None)

    def update(self) -> Status:
        """Return the status of the call."""
        proxy = self.proxy
        aborted = f"{self.srv_name}: aborted"
        if self._start_error is not None:
            return self._failed(self._start_error, aborted)
        state = proxy.get_state()
        if state is ProxyState.RUNNING:
            return Status.RUNNING
        if state is ProxyState.RESPONSE_READY:
            try:
                return self._answered(proxy.get_response())
            except Exception as error:
                self._log("the response was not handled", error)
                return self._failed(error, aborted)
        errors = proxy.get_errors()
        return self._failed(errors[0] if errors else None, aborted)

    def _answered(self, response: ResponseT | None) -> Status:
        # Only a bool: a number 0 often means that there was no error.
        unsuccessful = getattr(response, "success", None) is False
        outcome = f"answered without success{_reason(response)}" if unsuccessful else "answered"
        self._set_feedback(f"{self.srv_name} {outcome}")
        self._set(self._key_response, response)
        status = None
        if self._on_response is not None and response is not None:
            status = self._on_response(response)
        if status is None:
            return Status.FAILURE if unsuccessful else Status.SUCCESS
        return status

    def _set_feedback(self, message: str) -> None:
        super()._set_feedback(message)
        self._set(self._key_feedback_message, message)
        if self._on_feedback is not None:
            self._on_feedback(message)


class FromBlackboard(CallService[RequestT, ResponseT]):
    """`CallService` with the request from the blackboard, as in ``py_trees_ros``.

    If the variable does not exist, the run ends with FAILURE.

    Args:
        name: the name of the behaviour.
        srv_type: a service class or its name.
        srv_name: the service's name.
        key_request: the blackboard variable to take the request from; it may be nested.
        key_response: the blackboard variable for the response.
        options: the other keyword arguments of `CallService`.
    """

    def __init__(
        self,
        name: str,
        srv_type: ServiceType[RequestT, ResponseT] | str,
        srv_name: str,
        key_request: str,
        key_response: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(
            name, srv_type, srv_name, key_request=key_request, key_response=key_response, **options
        )


class FromConstant(CallService[RequestT, ResponseT]):
    """`CallService` with a constant request, as in ``py_trees_ros``.

    Args:
        name: the name of the behaviour.
        srv_type: a service class or its name.
        srv_name: the service's name.
        request: a message, a mapping of its fields, or None for an empty one.
        key_response: the blackboard variable for the response.
        options: the other keyword arguments of `CallService`.
    """

    def __init__(
        self,
        name: str,
        srv_type: ServiceType[RequestT, ResponseT] | str,
        srv_name: str,
        request: RequestT
        | Mapping[str, Any]
        | Callable[[], RequestT | Mapping[str, Any] | None]
        | None,
        key_response: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(name, srv_type, srv_name, request, key_response=key_response, **options)


class WaitForService(ServiceBehaviour[Any, Any]):
    """Waits for a server: RUNNING until there is one, then SUCCESS; FAILURE at the deadline.

    Args:
        name: the name of the behaviour.
        srv_type: a service class or its name.
        srv_name: the service's name.
        timeout: seconds; None, or left out, for no deadline; ``...`` for the session's.
        qos: a ``QoSProfile``; None for the service default.
        session: the session; None to take it from ``tree.setup(session=…)``.

    Raises:
        TypeError, ValueError: the timeout does not fit.
    """

    def __init__(
        self,
        name: str,
        srv_type: ServiceType[Any, Any] | str,
        srv_name: str,
        *,
        timeout: Timeout = None,
        qos: QoSProfile | None = None,
        session: Session | None = None,
    ) -> None:
        super().__init__(name, srv_type, srv_name, qos, session)
        check_timeout(timeout, None)
        self._timeout = timeout

    def initialise(self) -> None:
        """Start the wait."""
        self.proxy.wait_for_service(self._timeout)
        self.feedback_message = f"waiting for {self.srv_name}"

    def update(self) -> Status:
        """Return the status of the wait."""
        proxy = self.proxy
        state = proxy.get_state()
        if state is ProxyState.WAITING:
            return Status.RUNNING
        if state is ProxyState.SERVICE_AVAILABLE:
            self.feedback_message = f"{self.srv_name} is there"
            return Status.SUCCESS
        self.feedback_message = "; ".join(map(str, proxy.get_errors())) or "aborted"
        return Status.FAILURE


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
        TypeError, ValueError: a timeout does not fit.
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
        check_timeout(accept_timeout, None)
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


_GOAL_OUT = (ActionState.WAITING, ActionState.ACTIVE, ActionState.CANCELING)


def _reason(response: object) -> str:
    message = getattr(response, "message", None)
    return f": {message}" if message and isinstance(message, str) else ""
