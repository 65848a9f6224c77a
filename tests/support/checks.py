"""What a test checks when the calls are over."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING, Any

from tests.support.echo import ECHO, answer_to, request_of
from tests.support.times import until

if TYPE_CHECKING:
    from rosasync import Session

__all__ = ["assert_clean", "check_call", "count_descriptors", "count_threads", "pending_in_rclpy"]


async def check_call(session: Session, name: str, text: str, **options: Any) -> None:
    """Call a service of the echoing type and check that the response is to this request."""
    response = await session.call(ECHO, name, request_of(text), **options)
    assert answer_to(response) == text


async def assert_clean(session: Session) -> None:
    """Wait until no request is outstanding, and check that nothing else is left either."""

    def settled() -> bool:
        now = session.pool.statistics()
        return now.in_flight == now.waiting == now.abandoned == 0

    await until(settled)
    now = session.pool.statistics()
    assert now.idle == now.clients
    assert pending_in_rclpy(session) == 0
    others = asyncio.all_tasks() - {asyncio.current_task()}
    assert not [task for task in others if "call" in repr(task.get_coro())]


def pending_in_rclpy(session: Session) -> int:
    """Return how many requests rclpy itself still keeps an entry for."""
    return sum(len(client._pending_requests) for client in session.node.clients)


def count_descriptors() -> int:
    """Return how many files this process has open."""
    return len(os.listdir("/proc/self/fd"))


def count_threads() -> int:
    """Return how many threads this process has, including the middleware's."""
    return len(os.listdir("/proc/self/task"))
