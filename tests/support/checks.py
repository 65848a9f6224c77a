"""Checks for the end of a test."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

from tests.support.echo import ECHO, answer_to, request_of
from tests.support.times import LIMIT, until

if TYPE_CHECKING:
    from rosasync import Session

__all__ = [
    "Takes",
    "assert_clean",
    "check_call",
    "count_descriptors",
    "count_takes",
    "count_threads",
    "pending_in_rclpy",
    "take_what_is_left",
]


@dataclass
class Takes:
    """The number of times clients tried to take a response, and of the responses they took."""

    attempts: int = 0
    responses: int = 0


@contextmanager
def count_takes() -> Iterator[Takes]:
    """Count the responses taken by clients of the sessions that are opened in this block.

    They distinguish responses that the middleware has lost from those that the library has lost.
    """
    takes = Takes()
    take_response = _rclpy.Client.take_response

    def counted(client: Any, response_type: Any) -> Any:
        taken = take_response(client, response_type)
        takes.attempts += 1
        takes.responses += taken[0] is not None
        return taken

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_rclpy.Client, "take_response", counted)
        yield takes


async def check_call(session: Session, name: str, text: str, **options: Any) -> None:
    """Call a service of the echoing type and check that the response is to this request."""
    response = await session.call(ECHO, name, request_of(text), **options)
    assert answer_to(response) == text


async def assert_clean(session: Session) -> None:
    """Wait until no request is outstanding, and check that nothing else is left either."""

    def settled() -> bool:
        now = session.pool.statistics()
        return now.in_flight == now.waiting == now.abandoned == 0

    # If the middleware has lost a response, its place is only freed after Limits.grace.
    await until(settled, 2 * LIMIT)
    now = session.pool.statistics()
    assert now.idle == now.clients
    # A request whose place an answer has freed is forgotten at the end of its grace period.
    await until(lambda: pending_in_rclpy(session) == 0)
    others = asyncio.all_tasks() - {asyncio.current_task()}
    assert not [task for task in others if "call" in repr(task.get_coro())]


def pending_in_rclpy(session: Session) -> int:
    """Return the number of requests that rclpy itself still keeps."""
    return sum(len(client._pending_requests) for client in session.node.clients)


def take_what_is_left(session: Session) -> int:
    """Take the responses that the clients have not taken; return how many there were."""
    found = 0
    for client in session.node.clients:
        # A take without a result does not mean that the queue is empty.
        for _ in range(100):
            found += client.handle.take_response(client.srv_type.Response)[0] is not None
    return found


def count_descriptors() -> int:
    """Return how many files this process has open."""
    return len(os.listdir("/proc/self/fd"))


def count_threads() -> int:
    """Return how many threads this process has, including the middleware's."""
    return len(os.listdir("/proc/self/task"))
