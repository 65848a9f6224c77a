"""Waiting for what a stub receives."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from rosasync.options import check_count, check_seconds

__all__ = ["Arrivals"]


class Arrivals:
    """Wakes those who wait for the calls or goals of a stub."""

    def __init__(self) -> None:
        self._changed = asyncio.Event()

    def notify(self) -> None:
        """Report that something has arrived."""
        self._changed.set()

    async def wait_for(self, number: int, received: Sequence[object], timeout: float) -> bool:
        """Return True as soon as so many are received; False after ``timeout`` seconds.

        Raises:
            TypeError, ValueError: one of the two is not a number, or negative.
        """
        number = check_count("number", number, 0)
        try:
            async with asyncio.timeout(check_seconds("timeout", timeout)):
                while len(received) < number:
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return False
        return True
