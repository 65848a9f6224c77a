"""ServerGoal: one goal of an action server, as its handler sees it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, Protocol
from uuid import UUID

from rosasync._actions.status import GoalStatus
from rosasync.errors import UsageError
from rosasync.typing import FeedbackT, GoalT

if TYPE_CHECKING:
    from rosasync._actions.goal_table import GoalRecord
    from rosasync.statistics import ActionServerStatistics

__all__ = ["AcceptingServer", "ServerGoal"]


class AcceptingServer(Protocol):
    """The server of a goal: an `ActionServer`, which this module cannot import."""

    @property
    def action_name(self) -> str:
        """The resolved name of the action."""

    @property
    def action_type(self) -> str:
        """The name of the action type."""

    @property
    def closed(self) -> bool:
        """Whether the server has been closed, or its closing has begun."""

    def statistics(self) -> ActionServerStatistics:
        """Return a snapshot."""

    async def aclose(self, timeout: float | None = ...) -> None:
        """End the server."""


class ServerGoal(Generic[GoalT, FeedbackT]):
    """A goal that an action server has accepted, for its handler.

    Attributes:
        request: the goal message that the client sent.
        server: the `ActionServer` that accepted it.
        id: its id, which the client has chosen.
    """

    __slots__ = ("__weakref__", "_publish", "_record", "id", "request", "server")

    def __init__(
        self,
        server: AcceptingServer,
        record: GoalRecord,
        request: GoalT,
        publish: Callable[[bytes, Any], None],
    ) -> None:
        self.server = server
        self.request = request
        self.id = UUID(bytes=record.id)
        self._record = record
        self._publish = publish

    def __repr__(self) -> str:
        return f"<ServerGoal {self.server.action_name} {self.id} {self.status.name}>"

    @property
    def status(self) -> GoalStatus:
        """Its status. From any thread."""
        return self._record.status

    @property
    def accepted_at(self) -> int:
        """When it was accepted, in ns of the node's clock."""
        return self._record.stamp

    @property
    def cancelling(self) -> bool:
        """Whether its cancellation was requested, and it has not ended yet. From any thread."""
        return self._record.status is GoalStatus.CANCELING

    @property
    def done(self) -> bool:
        """Whether it has ended. From any thread."""
        return self._record.ended

    def feedback(self, message: FeedbackT | Mapping[str, Any]) -> None:
        """Publish feedback. From any thread.

        Args:
            message: a message of the action's feedback type, or a mapping of its fields. It may be
                changed or reused afterwards.

        Raises:
            TypeError, ValueError: it does not fit.
            UsageError: the goal has ended.
            SessionClosed, ContextShutdown: the server has ended.
        """
        if message is None:
            raise TypeError("feedback is a message or a mapping of its fields, not None")
        if self._record.ended:
            raise UsageError(
                f"{self.server.action_name}: goal {self.id} has ended "
                f"({self.status.name}): its feedback is over"
            )
        self._publish(self._record.id, message)
