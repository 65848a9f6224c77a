"""Transitions of lifecycle nodes, over the session's pool.

::

    camera = LifecycleClient(session, "/camera")
    await camera.configure()
    await camera.activate()
    assert await camera.state() == "active"
"""

from __future__ import annotations

import asyncio
import enum
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from rosasync import CallError, ResponseTimeout, Retry, RosasyncError
from rosasync._core.node_client import NodeClient
from rosasync._core.text import duration
from rosasync.options import check_retry

if TYPE_CHECKING:
    from rosasync import Session
    from rosasync.typing import Timeout

__all__ = [
    "LifecycleClient",
    "LifecycleState",
    "LifecycleTransition",
    "TransitionError",
    "TransitionFailed",
    "TransitionTimeout",
]

Outcome: TypeAlias = Literal["not done", "unknown"]

POLL = 0.1
"""Seconds between two looks at the state of a node that is in a transition."""


class LifecycleState(enum.StrEnum):
    """The state of a lifecycle node. A member equals its label: ``state == "active"``.

    Attributes:
        id: the number of ``lifecycle_msgs/msg/State``.
    """

    UNKNOWN = "unknown", 0
    UNCONFIGURED = "unconfigured", 1
    INACTIVE = "inactive", 2
    ACTIVE = "active", 3
    FINALIZED = "finalized", 4
    CONFIGURING = "configuring", 10
    CLEANINGUP = "cleaningup", 11
    SHUTTINGDOWN = "shuttingdown", 12
    ACTIVATING = "activating", 13
    DEACTIVATING = "deactivating", 14
    ERRORPROCESSING = "errorprocessing", 15

    id: int

    def __new__(cls, label: str, id: int) -> LifecycleState:
        """Create a member from its label and number."""
        member = str.__new__(cls, label)
        member._value_ = label
        member.id = id
        return member

    @property
    def in_transition(self) -> bool:
        """Whether a transition is going on: the node leaves this state by itself."""
        return self.id >= LifecycleState.CONFIGURING.id


BY_ID = {state.id: state for state in LifecycleState}


@dataclass(frozen=True, slots=True)
class LifecycleTransition:
    """A transition that a node can make.

    Attributes:
        id: the number of ``lifecycle_msgs/msg/Transition``.
        label: its name, ``"configure"``.
        start: the state it begins in.
        goal: the state in which the node is during the transition, ``configuring``.
    """

    id: int
    label: str
    start: LifecycleState
    goal: LifecycleState


class TransitionError(RosasyncError):
    """A transition that was not made, or is not known to be. It can be copied and pickled.

    Attributes:
        node_name: the node's full name.
        transition: the transition's label, ``"configure"``.
        state: the state of the node, read afterwards; None if it could not be read.
    """

    def __init__(
        self, message: str, *, node_name: str, transition: str, state: LifecycleState | None
    ) -> None:
        super().__init__(message)
        self.node_name = node_name
        self.transition = transition
        self.state = state

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are copied from their positional arguments, and these are keywords.
        make = partial(
            type(self), node_name=self.node_name, transition=self.transition, state=self.state
        )
        return make, self.args, self.__dict__


class TransitionFailed(TransitionError):
    """The node answered that the transition failed, or its state does not allow it.

    After a failure of its callback, the node is in the state where it was. After an error, it is
    unconfigured or finalized.
    """


class TransitionTimeout(TransitionError, TimeoutError):
    """The transition was not answered in time, and the node is not known to have made it."""

    @property
    def outcome(self) -> Outcome:
        """``"not done"``, or ``"unknown"`` if the state is not known, or is one of a transition.

        Even a transition that is not done may be made later, when the node gets to it.
        """
        return "unknown" if self.state is None or _is_undecided(self.state) else "not done"


@dataclass(frozen=True, slots=True)
class _Kind:
    """A transition by its label.

    Attributes:
        goal: the state that it leads to.
        ids: its number in each state that it may start in.
    """

    goal: LifecycleState
    ids: dict[LifecycleState, int]


TRANSITIONS = {
    "configure": _Kind(LifecycleState.INACTIVE, {LifecycleState.UNCONFIGURED: 1}),
    "cleanup": _Kind(LifecycleState.UNCONFIGURED, {LifecycleState.INACTIVE: 2}),
    "activate": _Kind(LifecycleState.ACTIVE, {LifecycleState.INACTIVE: 3}),
    "deactivate": _Kind(LifecycleState.INACTIVE, {LifecycleState.ACTIVE: 4}),
    "shutdown": _Kind(
        LifecycleState.FINALIZED,
        {LifecycleState.UNCONFIGURED: 5, LifecycleState.INACTIVE: 6, LifecycleState.ACTIVE: 7},
    ),
}


class LifecycleClient(NodeClient):
    """Reads the state of a lifecycle node, and changes it.

    It owns nothing: its calls share the clients of the session's pool. So many nodes may be
    changed at a time, with ``asyncio.gather``.

    Each method also raises what `Session.call` raises, such as `ServiceUnavailable` if there is no
    such node, or if it is not a lifecycle node.

    A transition that is not answered in time has not failed: the node may still work on it. So the
    client reads the state then, for at most ``timeout`` seconds more. If the node is in the state
    that the transition leads to, the method returns as usual. Otherwise it raises
    `TransitionTimeout`, whose ``outcome`` is ``"not done"`` or ``"unknown"``.

    A transition is sent once, unless there is a ``retry``. Then an unanswered one is sent again,
    but only after the node has said that it is in the state in which the transition starts. While
    the node is in a transition, the client waits for its end, within the timeout. So no transition
    is made twice. One whose callback failed leaves the state as it was: if its response was lost,
    it is sent again, and the callback runs again.

    Args:
        session: an open session.
        node_name: the node's name, ``"/camera"``. Relative names are resolved as service names are.
        timeout: seconds for each call, None for no deadline; if left out, the session's. Each
            method takes a ``timeout`` of its own, and the client's is used if that is left out.
        retry: when to send an unanswered request again; None for never. It has no ``verify``,
            because the client asks the node itself.

    Raises:
        InvalidServiceName: ROS does not allow the name.
        TypeError, ValueError: the timeout or the retry does not fit.
        UsageError: the session is not open, or belongs to another loop or thread.
        SessionClosed, ContextShutdown: the session has ended.
    """

    def __init__(
        self,
        session: Session,
        node_name: str,
        *,
        timeout: Timeout = ...,
        retry: Retry | None = None,
    ) -> None:
        check_retry(retry)
        if retry is not None and retry.verify is not None:
            raise ValueError(
                "retry: a LifecycleClient asks the node for its state before it sends a transition "
                "again: leave out verify"
            )
        super().__init__(session, node_name, timeout, "lifecycle_msgs/srv/GetState", "get_state")
        self._retry = retry

    async def state(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Return the node's state.

        Args:
            timeout: seconds, None for no deadline; if left out, the client's.
        """
        response = await self._call("GetState", "get_state", {}, timeout, self._retry)
        return _state(response.current_state)

    async def transitions(self, *, timeout: Timeout = ...) -> list[LifecycleTransition]:
        """Return the transitions that the node can make in its state.

        Args:
            timeout: seconds, None for no deadline; if left out, the client's.
        """
        response = await self._call(
            "GetAvailableTransitions", "get_available_transitions", {}, timeout, self._retry
        )
        return [
            LifecycleTransition(
                id=found.transition.id,
                label=found.transition.label,
                start=_state(found.start_state),
                goal=_state(found.goal_state),
            )
            for found in response.available_transitions
        ]

    async def configure(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Go from unconfigured to inactive, and return the state reached.

        Args:
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            TransitionFailed: the node refused, or its callback failed.
            TransitionTimeout: not answered in time, and not known to be done.
        """
        return await self._change("configure", timeout)

    async def cleanup(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Go from inactive to unconfigured; as `configure`."""
        return await self._change("cleanup", timeout)

    async def activate(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Go from inactive to active; as `configure`."""
        return await self._change("activate", timeout)

    async def deactivate(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Go from active to inactive; as `configure`."""
        return await self._change("deactivate", timeout)

    async def shutdown(self, *, timeout: Timeout = ...) -> LifecycleState:
        """Go from unconfigured, inactive or active to finalized; as `configure`."""
        return await self._change("shutdown", timeout)

    async def _change(self, label: str, timeout: Timeout) -> LifecycleState:
        kind = TRANSITIONS[label]
        number, *others = kind.ids.values()
        if others:
            start = await self.state(timeout=timeout)
            if start not in kind.ids:
                raise self._failed(label, start)
            number = kind.ids[start]
        # A stock node whose state does not allow the transition raises an exception, and ends, if
        # it is asked by the number alone. micro-ROS reads the number only.
        request = {"transition": {"id": number, "label": label}}
        retry = self._retry
        if retry is not None:
            retry = replace(retry, verify=partial(self._find_out, label, number))
        try:
            response = await self._call("ChangeState", "change_state", request, timeout, retry)
        except ResponseTimeout as error:
            return await self._settle(label, error, timeout)
        if response.success:
            return kind.goal
        raise self._failed(label, await self._state_if_known(timeout))

    async def _find_out(self, label: str, number: int) -> dict[str, Any] | None:
        """Return the response to a transition by the node's state; None if it was not made.

        The end of the call that may be sent again cancels this.
        """
        state = await self.state(timeout=None)
        while _is_undecided(state):
            await asyncio.sleep(POLL)
            state = await self.state(timeout=None)
        kind = TRANSITIONS[label]
        return None if kind.ids.get(state) == number else {"success": state is kind.goal}

    async def _settle(self, label: str, error: ResponseTimeout, timeout: Timeout) -> LifecycleState:
        """Return the goal if the node is there now; otherwise raise what is known."""
        state = await self._state_if_known(timeout)
        if state is TRANSITIONS[label].goal:
            return state
        found = "the state could not be read either" if state is None else f"the node is {state}"
        raise self._error(
            TransitionTimeout,
            label,
            state,
            f"not answered within {duration(error.elapsed)}; {found}",
        ) from error

    def _failed(self, label: str, state: LifecycleState | None) -> TransitionError:
        starts = TRANSITIONS[label].ids
        if state is None:
            details = "refused, or its callback failed; its state could not be read"
        elif state in starts:
            details = f"its callback failed; it is {state} as before"
        else:
            # Also after an error in a callback, which leads to unconfigured or finalized.
            allowed = " or ".join(starts)
            details = (
                f"refused, or its callback failed; it is {state}, and {label} starts from {allowed}"
            )
        return self._error(TransitionFailed, label, state, details)

    def _error(
        self, kind: type[TransitionError], label: str, state: LifecycleState | None, details: str
    ) -> TransitionError:
        return kind(
            f"{self._node_name}: {label}: {details}",
            node_name=self._node_name,
            transition=label,
            state=state,
        )

    async def _state_if_known(self, timeout: Timeout) -> LifecycleState | None:
        try:
            return await self.state(timeout=timeout)
        except CallError:
            return None

    async def _call(
        self,
        service: str,
        name: str,
        request: dict[str, Any],
        timeout: Timeout,
        retry: Retry | None,
    ) -> Any:
        return await self._call_node(f"lifecycle_msgs/srv/{service}", name, request, timeout, retry)


def _is_undecided(state: LifecycleState) -> bool:
    """Return whether a state does not show if a transition is made."""
    return state is LifecycleState.UNKNOWN or state.in_transition


def _state(message: Any) -> LifecycleState:
    return BY_ID.get(message.id, LifecycleState.UNKNOWN)
