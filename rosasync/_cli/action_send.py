"""``rosasync action send``: one goal, its feedback, and its result."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

import rosasync
from rosasync._cli.actions import action_class, find_type
from rosasync._cli.documents import plain
from rosasync._cli.errors import Code
from rosasync._cli.output import note, print_value
from rosasync._cli.requests import message_from, template
from rosasync._cli.run import fail, open_session

__all__ = ["Order", "send_goal", "show_goal"]

FEEDBACK = 10_000
"""How many feedback messages wait to be printed."""
CANCEL_TIMEOUT = 5.0
"""Seconds for which an interrupted command waits for the end of its goal."""


@dataclass(frozen=True)
class Order:
    """What to send."""

    name: str
    action_type: str | None
    text: str | None
    feedback: bool
    timeout: float | None
    accept_timeout: float
    as_json: bool

    @property
    def first_timeout(self) -> float:
        """Seconds until the goal is accepted, discovery included."""
        if self.timeout is None:
            return self.accept_timeout
        return min(self.timeout, self.accept_timeout)


async def show_goal(order: Order) -> None:
    """Print the goal as a template to edit."""
    action_type = order.action_type
    if action_type is None:
        async with open_session() as session:
            action_type = await find_type(session, order.name, order.first_timeout)
    print(template(action_class(action_type).Goal))


async def send_goal(order: Order) -> int:
    """Send a goal, print what comes, and return the exit code."""
    # Before the session is opened, which takes longer than to report a mistake.
    known = None if order.action_type is None else action_class(order.action_type)
    message = None if known is None else message_from(known.Goal, order.text)
    loop = asyncio.get_running_loop()
    deadline = None if order.timeout is None else loop.time() + order.timeout
    async with open_session(order.first_timeout) as session:
        if known is None:
            known = action_class(await find_type(session, order.name, order.first_timeout))
            message = message_from(known.Goal, order.text)
        try:
            async with session.goal(known, order.name, message, feedback=FEEDBACK) as goal:
                return await _follow_until(deadline, goal, order)
        except _Interrupted as interrupted:
            raise asyncio.CancelledError from interrupted
        except asyncio.CancelledError:
            note("interrupted before the goal was accepted; if it still is, it is cancelled")
            raise


async def _follow_until(deadline: float | None, goal: rosasync.Goal[Any, Any], order: Order) -> int:
    note(f"goal {goal.id} accepted")
    try:
        async with asyncio.timeout_at(deadline):
            return await _follow(goal, order)
    except asyncio.CancelledError:
        await _cancel(goal)
        raise _Interrupted from None
    except TimeoutError as error:
        if isinstance(error, rosasync.RosasyncError):
            raise
        fail(f"{order.name}: the goal has not ended within {order.timeout:g} s")
        await _cancel(goal)
        return Code.TIMED_OUT


async def _follow(goal: rosasync.Goal[Any, Any], order: Order) -> int:
    """Print the feedback and the result of a goal."""
    printer = _Printer(goal, order)
    async for message in goal:
        if order.feedback:
            printer.print_feedback(message)
    try:
        result = await goal.result()
    except (rosasync.GoalAborted, rosasync.GoalCanceled) as error:
        printer.print_result(error.result)
        fail(error)
        return Code.FAILED
    printer.print_result(result)
    return Code.ANSWERED


async def _cancel(goal: rosasync.Goal[Any, Any]) -> None:
    """Cancel a goal, and say what became of it."""
    note("cancelling the goal; Ctrl-C again leaves it at that")
    try:
        async with asyncio.timeout(CANCEL_TIMEOUT):
            await goal.cancel()
            await goal.result()
    except rosasync.CancelRejected:
        goal.detach()
        note("the server refuses to cancel the goal, which runs on")
    except (rosasync.GoalAborted, rosasync.GoalCanceled):
        note(f"the goal has ended: {goal.status.name}")
    except rosasync.ServerGone:
        note("the server is gone, and the goal with it")
    except TimeoutError:
        goal.detach()
        note(f"the goal has not ended within {CANCEL_TIMEOUT:g} s")
    else:
        note(f"the goal had ended: {goal.status.name}")


class _Interrupted(Exception):
    """The command was interrupted, and its goal was cancelled."""


class _Printer:
    """Prints the feedback and the result of a goal."""

    def __init__(self, goal: rosasync.Goal[Any, Any], order: Order) -> None:
        self._goal = goal
        self._order = order
        self._printed = 0

    def print_feedback(self, message: Any) -> None:
        self._print({"feedback": plain(message)})

    def print_result(self, result: Any) -> None:
        fields = plain(result)
        if self._order.as_json:
            self._print(
                {
                    "goal_id": str(self._goal.id),
                    "status": self._goal.status.name,
                    "result": fields,
                }
            )
        else:
            self._print({"result": fields} if self._order.feedback else fields)

    def _print(self, value: Any) -> None:
        print_value(value, as_json=self._order.as_json, separate=self._printed > 0)
        self._printed += 1
