"""What the behaviours share, and the import of py_trees."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from rosasync.errors import UsageError

try:
    from py_trees.behaviour import Behaviour
    from py_trees.common import Access, Status
except ImportError as error:
    raise ImportError(
        f"rosasync.behaviours needs py_trees, which cannot be imported here ({error}): "
        "pip install 'rosasync[py-trees]'"
    ) from error

if TYPE_CHECKING:
    from rosasync._actions.proxy import AsyncActionProxy
    from rosasync._core.proxy import AsyncServiceProxy
    from rosasync.session import Session

# The others import these two from here, because the import here says how to install py_trees.
__all__ = ["Access", "Leaf", "Status"]

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
