"""Warns if callers wait for a service whose servers all have another type."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosasync._core.ports import GraphPort, Service

__all__ = ["MISMATCH_DELAY", "MISMATCH_LOGGER", "MismatchReporter"]

MISMATCH_LOGGER = "rosasync._client.mismatch"
"""The logger of the warning, so that it can be silenced alone."""
MISMATCH_DELAY = 1.0
"""Seconds for which callers wait for a server before the warning."""


class MismatchReporter:
    """Logs one warning for each mismatch that keeps callers of a service waiting."""

    def __init__(self, service: Service, queries: GraphPort) -> None:
        self._service = service
        self._queries = queries
        # When callers began to wait for a match; None while none does.
        self._since: float | None = None
        # What the last warning said, so that it is not repeated.
        self._said: str | None = None

    def check(self, waiting: bool, now: float) -> None:
        """Warn if callers have waited for some time.

        Args:
            waiting: whether callers wait for a match now.
            now: the loop time in seconds.
        """
        if not waiting:
            self._since = None
        elif self._since is None:
            self._since = now
        elif now - self._since >= MISMATCH_DELAY:
            self.warn()

    def warn(self) -> None:
        """Warn if every server has another type and no warning has said so."""
        mismatch = self._queries.explain_mismatch(self._service)
        if mismatch is not None and mismatch != self._said:
            logging.getLogger(MISMATCH_LOGGER).warning(
                "%s: callers wait for a server of type %s, but %s: call it with the server's type, "
                "or stop that server",
                *self._service.key[:2],
                mismatch,
            )
        self._said = mismatch
