"""Waiting for an end that nobody may cut short."""

from __future__ import annotations

import asyncio

import anyio

__all__ = ["until_done"]


async def until_done(task: asyncio.Task[None]) -> None:
    """Wait for a task, whatever cancellation comes meanwhile, and pass that on afterwards.

    Raises:
        Exception: what the task raised.
        CancelledError: the caller was cancelled; the task is done all the same.
    """
    cancelled = None
    with anyio.CancelScope(shield=True):
        while not task.done():
            try:
                await asyncio.wait({task})
            except asyncio.CancelledError as error:
                cancelled = error
    if cancelled is not None:
        raise cancelled
    task.result()
