"""Behaviours that call a service, or wait for one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic

from rosasync._core.proxy import AsyncServiceProxy, ProxyState
from rosasync.behaviours._base import Access, Leaf, Status
from rosasync.options import Retry, check_retry, check_timeout
from rosasync.typing import RequestT, ResponseT, ServiceType, Timeout

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

    from rosasync.session import Session

__all__ = ["CallService", "FromBlackboard", "FromConstant", "WaitForService"]


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


def _reason(response: object) -> str:
    message = getattr(response, "message", None)
    return f": {message}" if message and isinstance(message, str) else ""
